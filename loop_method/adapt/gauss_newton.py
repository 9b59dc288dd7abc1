# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Gauss-Newton on measured trajectories.

The cost is a sum of squares of measured quantities; only its sensitivity to the gains needs a
model, and that is fitted to the rollouts as they come in. So a model error affects the direction of a
step, never the cost, and every step is judged by rollouts.

The law is a = K_a s + b, s = U^T z, theta = [K_a b]: K_b acts only through b = K_b s_r. A step

1. fits local models to the remembered trajectories (`fit`) and keeps those that predict measured
   differences of trajectories (`selection`),
2. solves (H + lambda D) d = -g with the averaged Gauss-Newton curvature (`sensitivity`),
3. rolls out theta + d on the current M fields, one by one, giving up as soon as the mean is
   clearly above the incumbent's, accepts it if the mean over all fields fell, and adapts lambda;
   an incumbent that diverges is halved instead,
4. after an acceptance replaces the oldest field, so that the policy does not fit M fields, or adds one
   if the step was small,

and the last rollouts decide what is returned (`final_comparison`). Sources: docs/optimizers.md.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from loop_interfaces.arrays import Array
from loop_interfaces.one_thread import one_thread
from loop_method.adapt.base import (
    Context,
    Optimizer,
    Record,
    Rollout,
    RolloutResult,
    Row,
    State,
    checked_policy,
    part_of,
    require_positive,
    require_results,
)
from loop_method.adapt.estimate import Estimate
from loop_method.adapt.final_comparison import (
    Comparison,
    gain_is_clear,
    gain_of_steps,
    none_is_close,
    on_same_fields,
    rollouts_to_keep,
)
from loop_method.adapt.proposer import Proposer
from loop_method.adapt.search_state import NONE, SearchState, Stamps
from loop_method.adapt.settings import GaussNewtonSettings
from loop_method.adapt.trajectories import Records
from loop_method.adapt.verdict import ADAPTED, FIRST, Verdict
from loop_method.adapt.verdict import NONE as NO_CONTROL
from loop_method.seeds import field_seed

__all__ = ["GaussNewton"]

_LAST = "last."
_CONFIRMING = 0x434F4E46  # "CONF": of the fields that are drawn for the verdict


class GaussNewton(Optimizer):
    """Gauss-Newton policy optimisation on measured trajectories.

    Parameters
    ----------
    policy0 : (n_a, 2 n_s) array
        Where to start, [K_a K_b]; the warm start.
    seed : int
        Determines the initial fields.
    rollouts : int
        The budget. A step takes up to M of them, and the start another M.
    context : Context
        Basis, target, weights, horizon and the exploratory trajectory.
    settings : GaussNewtonSettings
        `fields`: more fit the distribution better, at M rollouts a step.
    first_field : int
        Number of the first of these fields: a law can have been made on those before.
    verdict : bool
        Compare the law found with the first one, where a model of the whole field can.
    """

    name = "gauss_newton"
    Settings = GaussNewtonSettings
    needs_trajectories = True
    needs_affine_law = True
    in_coordinates = True
    compares_first_law = True
    preferences: ClassVar[Mapping[str, Any]] = {"identification": "regression"}  # as it was tuned

    def __init__(
        self,
        policy0: ArrayLike,
        *,
        seed: int,
        rollouts: int,
        settings: GaussNewtonSettings | None = None,
        context: Context | None = None,
        first_field: int = 0,
        verdict: bool = True,
    ) -> None:
        require_positive(rollouts=rollouts)
        if context is None:
            raise ValueError("Gauss-Newton needs a context with trajectories, got none")
        self._settings = settings = settings or GaussNewtonSettings()
        self._first = checked_policy(policy0 if context.refused is None else context.refused)
        self._now = SearchState.begin(
            self._first, settings.fields, first_field, settings.first_damping
        )
        self._proposer = Proposer(context, self._now.policy, settings)
        self._sensors, self._context = context.sensors, context
        self._verdict = verdict
        # One field says little, above all with few sensors or of a chaotic plant: where it spoke
        # against the first law, that law has to beat no control on all of them.
        contested = bool(context.sensors) or context.refused is not None
        self._contested = contested and bool(self._first.any())
        if self._contested:
            self._now.policy[:] = 0.0
            self._now.proposed = True
        self._comparison: Comparison | None = None
        self._seed = seed
        self._budget = rollouts
        largest = 3.0 * float(np.abs(context.exploration.states).max())
        self._records = Records(settings.remembered, largest)

    @classmethod
    def first_step(cls, settings: GaussNewtonSettings) -> int:
        """To change the policy once it measures the one that it begins with and a candidate."""
        return 2 * settings.fields

    @property
    def policy(self) -> Array:
        """The incumbent: the best policy so far."""
        return self._now.policy.copy()

    @property
    def tells(self) -> int:
        """Number of calls of `tell`."""
        return self._now.tells

    @property
    def used(self) -> int:
        """Rollouts so far."""
        return self._records.count

    @property
    def early(self) -> str:
        """Why rollouts are left over at the end."""
        return self._now.reason or "too few are left for a step and its verdict"

    @property
    def next_field(self) -> int:
        """Number of the first initial field after those of its rollouts."""
        return int(self._now.fields.max()) + 1

    @property
    def done(self) -> bool:
        """True if the rollouts that are left make no step."""
        return not self.ask()

    def ask(self) -> list[Rollout]:
        """The incumbent on fields that are new to it, the candidate on the next, or the last ones."""
        now = self._now
        if self._comparison is not None:
            return self._comparison.rollouts(self._laws, self._seed)
        left = 0 if now.ended else self._left
        missing = now.missing
        if missing.size:
            new = [self._rollout(now.policy, int(i)) for i in missing]
            return new if left >= missing.size else []
        if not now.proposed or left <= 0:
            return []
        return [self._rollout(now.candidate, now.next_trial)]

    def tell(self, results: Sequence[RolloutResult]) -> Row:
        """Take the rollouts in, and when they decide about a candidate, propose the next."""
        now = self._now
        require_results(results, len(self.ask()))
        for result in results:
            self._records.validated_samples(result)
        now.tells += 1
        row: Row = {"diverged": sum(not r.usable for r in results)}
        if self._comparison is not None:
            self._decide(results, row)
            return row
        missing = now.missing
        if missing.size:
            first = self._records.count == 0
            for i, result in zip(missing, results, strict=True):
                record = self._add(now.policy, result)
                now.incumbents[i] = record.stamp
                if first and record.usable:
                    self._records.raise_limit(record.states)
            row["role"] = "incumbent"
            decided = True
        else:
            now.trials[now.next_trial] = self._add(now.candidate, results[0]).stamp
            row["role"] = "candidate"
            decided = self._judge(row)
        cost = self._mean_cost(now.incumbents[now.incumbents != NONE])
        if np.isfinite(cost):
            row["cost"] = cost
        row["rollouts"] = self._records.count
        row["damping"] = now.damping
        if decided and not now.missing.size and not now.proposed:
            self._propose(row)
        if self._verdict and self.done:
            self._finish(row)
        if self._proposer.found:
            row["noise"] = self._proposer.found
        return row

    def state(self) -> State:
        """The policies, the decisions that are pending, and the remembered trajectories."""
        last = self._comparison.state() if self._comparison is not None else {}
        return {
            **self._now.arrays(),
            **self._proposer.state(),
            **self._records.state(),
            **{_LAST + name: array for name, array in last.items()},
        }

    def restore(self, state: Mapping[str, NDArray[np.generic]]) -> None:
        """Continue from a checkpoint of an optimiser with the same arguments."""
        now = self._now.later(state)
        last = Comparison.of(part_of(state, _LAST), self._first.shape, self._context)
        self._records.restore(state, len(self._proposer.loop.U), self._now.policy.shape)
        if missing := now.referred - {record.stamp for record in self._records.all()}:
            raise ValueError(f"the checkpoint refers to rollouts that it lacks: {sorted(missing)}.")
        self._proposer.restore(state)
        self._now, self._comparison = now, last

    def _rollout(self, policy: Array, slot: int) -> Rollout:
        return Rollout(policy.copy(), field_seed(self._seed, int(self._now.fields[slot])))

    def _add(self, policy: Array, result: RolloutResult) -> Record:
        rollout = Rollout(policy, -1)
        return self._records.add(rollout, result, self._now.referred)

    def _mean_cost(self, stamps: Stamps) -> float:
        return float(np.mean([self._records[int(stamp)].cost for stamp in stamps]))

    def _judge(self, row: Row) -> bool:
        """Accept or reject the candidate, or let it run on; whether the decision has fallen."""
        now, settings = self._now, self._settings
        ran = now.trials != NONE
        trial = self._mean_cost(now.trials[ran])
        incumbent = self._mean_cost(now.incumbents[ran])
        # The cost of the first law carries no information about the models.
        contest = self._contested and np.array_equal(now.candidate, self._first)
        if self._sensors or contest:
            lost = ran.sum() * trial >= ran.size * self._mean_cost(now.incumbents)
        else:
            lost = trial >= settings.abort * incumbent or (ran.all() and trial >= incumbent)
        if lost:
            now.from_none = now.from_none or contest
            if not contest:
                now.damping = min(settings.damping_rejected * now.damping, settings.largest_damping)
            now.compared = now.trials.copy()
            now.accepted = False
        elif ran.all():
            fall = incumbent - trial
            if not contest:
                now.damp(fall, settings)
            now.accept()
            most = 2 * settings.fields if fall < settings.small_gain * incumbent else 0
            now.renew_fields(self._left, most)
        else:
            return False
        row["accepted"] = now.accepted
        if np.isfinite(trial) and np.isfinite(incumbent) and incumbent:
            row["relative_cost"] = trial / incumbent
        now.trials[:] = NONE
        now.proposed = False
        return True

    @property
    def _laws(self) -> dict[str, Array]:
        none = np.zeros_like(self._first)
        return {FIRST: self._first, ADAPTED: self._now.policy, NO_CONTROL: none}

    @property
    def _base(self) -> str:
        """The law that the search began with."""
        return FIRST if self._first.any() and not self._now.from_none else NO_CONTROL

    @property
    def _left(self) -> int:
        """Rollouts that are left for the search."""
        kept = 0
        clear = self._sensors and gain_is_clear(self._gain, self._settings)
        if self._verdict and not clear:
            known = self._context.measured
            opposed = self._base == FIRST and not self._contested
            close = opposed and none_is_close(known, self._first, self._settings.close)
            step, whole = 2 * self._settings.fields, self._now.whole
            kept = rollouts_to_keep(self._budget, step, whole, 2 + close, self._settings)
        return self._budget - kept - self._records.count

    @property
    def _gain(self) -> Estimate | None:
        return gain_of_steps(self._records.all(), self._laws, self._base)

    def _finish(self, row: Row) -> None:
        """After the last step: the rollouts that decide which law is returned."""
        now, known, comparison = self._now, self._records.all(), None
        left = max(self._budget - self._records.count, 0)
        fresh = (self.next_field + np.arange(left)).tolist()
        if now.believed:
            rng = np.random.default_rng([self._seed, _CONFIRMING])
            with one_thread():
                judging = fresh[: self._settings.judging]
                comparison = self._proposer.comparison(
                    self._laws, known, now.believed, judging, rng
                )
        if comparison is None:
            base, measured = self._base, [*self._context.measured, *known]
            close = base == FIRST and none_is_close(measured, self._first, self._settings.close)
            comparison = on_same_fields(self._laws, base, close, fresh, self._settings)
        else:
            row["fraction"] = comparison.fraction
        if comparison.names:
            self._comparison = comparison
        elif np.array_equal(now.policy, self._laws[comparison.base]):
            reason = "no step improved on the law with which they began"
            self._end(row, Verdict(comparison.base, 0.0, 0.0, reason))
        else:
            now.policy = comparison.law
            self._end(row, comparison.without_rollouts(self._laws, self._gain))

    def _decide(self, results: Sequence[RolloutResult], row: Row) -> None:
        """Choose between first law, found law and no control."""
        now, comparison = self._now, self._comparison
        assert comparison is not None
        before = self._records.all()
        asked = comparison.rollouts(self._laws, self._seed)
        fresh = [
            self._add(rollout.policy, result)
            for rollout, result in zip(asked, results, strict=True)
        ]
        row["role"] = "judging"
        costs = [r.cost for r, name in zip(fresh, comparison.names, strict=True) if name == ADAPTED]
        if costs and np.isfinite(costs).all():
            row["cost"] = float(np.mean(costs))
        row["rollouts"] = self._records.count
        with one_thread():
            verdict = self._proposer.verdict(comparison, self._laws, before, fresh)
        now.policy = comparison.law
        self._comparison = None
        self._end(row, verdict)

    def _end(self, row: Row, verdict: Verdict) -> None:
        now = self._now
        now.policy, now.ended = self._laws[verdict.chosen].copy(), True
        row["chosen"] = verdict.chosen
        row["reason"] = f"{now.reason}; {verdict.reason}" if now.reason else verdict.reason
        if self._records.count < self._budget:
            row["early"] = self.early
        if verdict.change:
            row["predicted_change"], row["deviation"] = verdict.change, verdict.deviation

    def _propose(self, row: Row) -> None:
        now = self._now
        if self._left < len(now.fields):
            return
        if not np.isfinite(self._mean_cost(now.incumbents)):
            # Nothing to improve on: halve the gains until the rollouts come to their end.
            start = now.policy if now.accepted else now.candidate
            now.candidate, now.fall, now.proposed = 0.5 * start, 0.0, bool(start.any())
            if not now.proposed:
                now.reason = row["reason"] = "no control diverges, and no step starts from it"
            return
        # One thread: a threaded LAPACK rounds differently for another number of threads.
        count = self._records.count
        # To find that no model of the whole field is good enough takes long.
        again = bool(now.believed) or count >= 2 * now.tried
        with one_thread():
            proposal = self._proposer.propose(
                self._records.all(),
                [self._records[int(stamp)] for stamp in now.incumbents],
                [None if stamp == NONE else self._records[int(stamp)] for stamp in now.compared],
                damping=now.damping,
                accepted=now.accepted,
                first=now.believed if again else None,
            )
        if proposal is None:
            now.reason = row["reason"] = "no model gives a finite step that lowers the cost"
            return
        if again:
            now.believed, now.tried, now.whole = proposal.believed, count, proposal.whole
            if self._left < len(now.fields):  # without such a model the comparison takes more
                return
        now.candidate, now.fall, now.proposed = proposal.policy, proposal.fall, True
        row.update(proposal.row())
