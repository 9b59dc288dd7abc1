"""Gauss-Newton on measured trajectories.

The cost is a sum of squares of measured quantities; only its sensitivity to the gains needs a
model, and that is fitted to the rollouts as they come in. So a model error bends the direction of a
step, never the cost, and every step is judged by rollouts.

The law is a = K_a s + b with s = U^T z and theta = [K_a b]: K_b acts only through b = K_b s_r. A
step

1. fits local models to the remembered trajectories (`fit`) and keeps those that predict measured
   differences of trajectories (`selection`),
2. solves (H + lambda D) d = -g with the averaged Gauss-Newton curvature (`sensitivity`),
3. rolls out theta + d on the M fields of the moment, one by one, giving up as soon as the mean is
   clearly above the incumbent's, accepts it if the mean over all fields fell, and adapts lambda,
   An incumbent that diverges is halved instead,
4. after an acceptance replaces the oldest field, so that the policy does not fit M fields, or adds one
   if the step was small.

Sources and equations: docs/optimizers.md.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray
from threadpoolctl import threadpool_limits

from tuner_node import oracle
from tuner_node.optimizers.base import (
    Array,
    Context,
    Rollout,
    RolloutResult,
    Row,
    State,
    checked_policy,
    require_positive,
    require_results,
    require_state,
)
from tuner_node.optimizers.proposal import Proposer
from tuner_node.optimizers.trajectories import GROWING, Record, Records

__all__ = ["GaussNewton"]

FIELDS = 3
"""M, initial fields that judge a policy in the beginning."""
_DAMPING = (1e-4, 1.0, 100.0)  # smallest, first, largest after a rejection
_ABORT = 1.05
_MODES = 32
_MEMORY = 40
# An accepted step that gains less than this share of the cost is small: what is left to gain is less
# than how much fields differ, so more of them have to judge.
_SMALL = 0.02
_NONE = -1
# Attributes that a checkpoint holds besides the policies and the records.
_STAMPS = ("fields", "incumbents", "trials", "others")
_NUMBERS = ("fall", "damping", "accepted", "proposed", "tells")


class GaussNewton:
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
    fields : int
        M, initial fields that judge a policy: more fit the distribution better, at M rollouts a
        step.
    most_fields : int
        Up to how many they grow, one after each accepted step that gains less than 2 % of the cost:
        a short step needs more of them to be judged. At or below `fields` they stay M.
    modes : int, optional
        Coordinates of the fitted model, at least n_s; 32 by default, or n_s where that is more.
    cubic_modes : int
        How many of them, at most, its cubic part acts on; 0 leaves it out.
    learning_rate, smoothing_radius : float, optional
        Not used; every optimiser takes them.
    """

    name = "gauss_newton"
    needs_trajectories = True

    def __init__(
        self,
        policy0: ArrayLike,
        *,
        seed: int,
        rollouts: int,
        context: Context,
        fields: int = FIELDS,
        most_fields: int = 6,
        modes: int | None = None,
        cubic_modes: int = 12,
        learning_rate: float | None = None,
        smoothing_radius: float | None = None,
    ) -> None:
        require_positive(rollouts=rollouts, fields=fields)
        n_s = context.U.shape[1]
        self._policy = checked_policy(policy0)
        modes = max(_MODES, n_s) if modes is None else modes
        self._proposer = Proposer(context, self._policy, modes, min(cubic_modes, modes))
        self._seed = seed
        self._budget = rollouts
        self._field_count, self._most_fields = fields, max(fields, most_fields)
        self._fields = np.arange(fields, dtype=np.int64)
        # Stamps of the records of the incumbent, the candidate, and what the incumbent is compared
        # to.
        self._incumbents, self._trials, self._others = np.full((3, fields), _NONE, dtype=np.int64)
        self._records = Records(_MEMORY, 3.0 * float(np.abs(context.exploration.states).max()))
        self._candidate = self._policy.copy()
        self._fall = 0.0
        self._damping = _DAMPING[1]
        self._accepted = True
        self._proposed = False
        self._tells = 0

    @property
    def policy(self) -> Array:
        """The incumbent: the best policy so far."""
        return self._policy.copy()

    best_policy = policy

    @property
    def tells(self) -> int:
        """How many times `tell` was called."""
        return self._tells

    @property
    def done(self) -> bool:
        """Whether the rollouts that are left make no step."""
        return not self.ask()

    def ask(self) -> list[Rollout]:
        """The incumbent on fields that are new to it, or the candidate on the next field."""
        left = self._budget - self._records.count
        missing = np.flatnonzero(self._incumbents == _NONE)
        if missing.size:
            new = [self._rollout(self._policy, int(i)) for i in missing]
            return new if left >= missing.size else []
        if not self._proposed or left <= 0:
            return []
        return [self._rollout(self._candidate, int(np.argmax(self._trials == _NONE)))]

    def tell(self, results: Sequence[RolloutResult]) -> Row:
        """Take the rollouts in, and when they decide about a candidate, propose the next."""
        require_results(results, len(self.ask()))
        for result in results:
            self._records.sound(result)
        self._tells += 1
        row: Row = {"diverged": sum(not r.usable for r in results)}
        missing = np.flatnonzero(self._incumbents == _NONE)
        if missing.size:
            first = self._records.count == 0
            for i, result in zip(missing, results, strict=True):
                record = self._add(self._policy, result)
                self._incumbents[i] = record.stamp
                if first and record.usable:
                    self._records.raise_limit(record.states)
            row["role"] = "incumbent"
            decided = True
        else:
            slot = int(np.argmax(self._trials == _NONE))
            self._trials[slot] = self._add(self._candidate, results[0]).stamp
            row["role"] = "candidate"
            decided = self._judge(row)
        cost = self._mean_cost(self._incumbents[self._incumbents != _NONE])
        if np.isfinite(cost):
            row["cost"] = cost
        row["rollouts"] = self._records.count
        row["damping"] = self._damping
        if decided and not (self._incumbents == _NONE).any():
            self._propose(row)
        return row

    def state(self) -> State:
        """The policies, the decisions that are pending, and the remembered trajectories."""
        n_a, gains = self._policy.shape
        return {
            "policy": self._policy.copy(),
            "candidate": self._candidate.copy(),
            **{name: getattr(self, f"_{name}").copy() for name in _STAMPS},
            **{name: np.array(getattr(self, f"_{name}")) for name in _NUMBERS},
            "seed": np.array(self._seed),
            "field_count": np.array(self._field_count),
            **self._records.state(self._proposer.n_z, n_a, gains),
        }

    def restore(self, state: Mapping[str, NDArray[np.generic]]) -> None:
        """Continue from a checkpoint with the same seed and number of fields."""
        require_state(state, self.state(), ("seed", "field_count"), (*_STAMPS, *GROWING))
        if len({state[name].shape for name in _STAMPS}) > 1:
            raise ValueError("the fields of the checkpoint do not add up.")
        self._policy, self._candidate = (
            checked_policy(state[name]) for name in ("policy", "candidate")
        )
        for name in _STAMPS:
            setattr(self, f"_{name}", state[name].astype(np.int64))
        for name in _NUMBERS:
            setattr(self, f"_{name}", state[name].item())
        require_positive(damping=self._damping)
        self._records.restore(state)
        referred = {int(s) for s in (*self._incumbents, *self._trials, *self._others)} - {_NONE}
        if missing := referred - {record.stamp for record in self._records.all()}:
            raise ValueError(f"the checkpoint refers to rollouts that it lacks: {sorted(missing)}.")

    def _rollout(self, policy: Array, slot: int) -> Rollout:
        return Rollout(policy.copy(), oracle.field_seed(self._seed, int(self._fields[slot])))

    def _add(self, policy: Array, result: RolloutResult) -> Record:
        keep = {int(s) for s in (*self._incumbents, *self._trials, *self._others)}
        return self._records.add(policy, result, keep)

    def _mean_cost(self, stamps: NDArray[np.int64]) -> float:
        return float(np.mean([self._records[int(stamp)].cost for stamp in stamps]))

    def _judge(self, row: Row) -> bool:
        """Accept or reject the candidate, or let it run on; whether the decision has fallen."""
        ran = self._trials != _NONE
        trial = self._mean_cost(self._trials[ran])
        incumbent = self._mean_cost(self._incumbents[ran])
        if trial >= _ABORT * incumbent or (ran.all() and trial >= incumbent):
            self._damping = min(4.0 * self._damping, _DAMPING[2])
            self._others = self._trials.copy()
            self._accepted = False
        elif ran.all():
            fall = incumbent - trial
            if fall > 0.5 * self._fall:
                self._damping = max(self._damping / 3.0, _DAMPING[0])
            elif fall <= 0.2 * self._fall:
                self._damping *= 2.0
            self._policy = self._candidate.copy()
            self._others, self._incumbents = self._incumbents, self._trials.copy()
            self._accepted = True
            self._renew_fields(fall < _SMALL * incumbent)
        else:
            return False
        row["accepted"] = self._accepted
        if np.isfinite(trial) and np.isfinite(incumbent):
            row["relative_cost"] = trial / incumbent
        self._trials[:] = _NONE
        self._proposed = False
        return True

    def _renew_fields(self, small: bool) -> None:
        """A fresh field in place of the oldest, or besides it after a small step."""
        grow = small and len(self._fields) < self._most_fields
        if self._budget - self._records.count <= len(self._fields) + grow:
            return
        if grow:
            self._fields = np.append(self._fields, self._fields.max() + 1)
            for name in ("incumbents", "trials", "others"):
                setattr(self, f"_{name}", np.append(getattr(self, f"_{name}"), _NONE))
        else:
            oldest = int(np.argmin(self._fields))
            self._fields[oldest] = self._fields.max() + 1
            self._others[oldest] = self._incumbents[oldest] = _NONE

    def _propose(self, row: Row) -> None:
        if self._budget - self._records.count < len(self._fields):
            return
        if not np.isfinite(self._mean_cost(self._incumbents)):
            # Nothing to improve on: halve the gains until the rollouts come to their end.
            start = self._policy if self._accepted else self._candidate
            self._candidate, self._fall, self._proposed = 0.5 * start, 0.0, True
            return
        # One thread: a threaded LAPACK rounds differently for another number of threads.
        with threadpool_limits(limits=1):
            proposal = self._proposer.propose(
                self._records.all(),
                [self._records[int(stamp)] for stamp in self._incumbents],
                [None if stamp == _NONE else self._records[int(stamp)] for stamp in self._others],
                damping=self._damping,
                accepted=self._accepted,
            )
        if proposal is not None:
            self._candidate, self._fall, self._proposed = proposal.policy, proposal.fall, True
            row.update(proposal.row())
