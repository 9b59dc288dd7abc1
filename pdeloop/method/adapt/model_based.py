# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The optimiser `model_based`: a law is improved on a model of the whole field, and judged by rollouts.

    stage       rollouts                                    afterwards
    renewing    the current law, each on a fresh field      a model is fitted to all rollouts and the
                                                            law improved on it (`improve`)
    judging     the final law, each on a fresh field        the best of all measured laws (`verdict`)

Laws where no model predicts the rollouts, or about the target: `replay`. Sources and equations:
docs/optimizers.md.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import astuple, dataclass, field, fields, replace
from functools import partial
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pdeloop.messages.array_files import checked_array
from pdeloop.messages.arrays import Array
from pdeloop.method.adapt import improve, replay, verdict
from pdeloop.method.adapt.base import (
    Context,
    Optimizer,
    Record,
    Rollout,
    RolloutResult,
    Row,
    State,
    by_law,
    checked_theta,
    numbers_of,
    of_law,
    require_positive,
    require_results,
)
from pdeloop.method.adapt.belief import Belief, believe
from pdeloop.method.adapt.improve import ModelBasedSettings
from pdeloop.method.adapt.sensed_loop import can_be_sensed
from pdeloop.method.adapt.trajectories import Records
from pdeloop.method.adapt.verdict import ADAPTED, FIRST, NONE, ZERO, Estimate
from pdeloop.method.laws.neural import Neural
from pdeloop.method.laws.predictive import Predictive, PredictiveKalman
from pdeloop.method.models.noise import cleaned_states
from pdeloop.method.seeds import field_seed
from pdeloop.process.one_thread import one_thread

__all__ = ["ModelBased"]

RENEWING, JUDGING, ENDED = "renewing", "judging", "ended"
_STAGES = (RENEWING, JUDGING, ENDED)
FIRST_RENEWAL = 6
"""Rollouts before the first improvement, explorations included; then at least twice as many each
time."""
CLOSE = 0.2
"""Share by which no control may cost more than a law on the model, to be rolled out as well."""
_LARGEST = 1e150
"""Largest change on fields that were left out."""
_REACH = 3.0
"""Magnitude of the states that a model must describe, in terms of the largest one measured before."""
_NONE_ROLLOUTS = 2
"""Rollouts without control on fields of the first law, where no model tells what they cost."""
_FAR_OFF = 0.1
"""Share of measured costs by which predicted ones miss them where the law is renewed at once."""
_REPEATS = 1e-9
"""Relative difference of the costs of one law up to which its rollouts are the same one."""
_TRIES = 8
"""Laws about the target after which no further one is tried if none of them costs less."""
_AGAIN = 2
"""First laws that are designed again whatever the one before cost."""
WELL_KNOWN = "more than {} fields would not change the law"
"""Why rollouts are left."""
_MIXTURE_STREAM = 0x4D4958  # "MIX"


@dataclass(eq=False)
class Progress:
    """State of an optimisation that changes over time, apart from its rollouts.

    policy: the present law, and at the end the chosen one; belief: the model that it was improved on
    last; improved, parts: the law after the last descent, and that of each part of the fields from the
    other parts, with which the next descents begin; change: what it cost more than the first one on
    fields that did not make it; replayed: whether it was last improved along measured rollouts, and
    trust: the weight of the distance from a law in such a step; none_is_close: whether no control is
    judged as well; safe: whether the first law is better than no control on the model; noise: what was
    found in place of the declared one, or 0; rested: rollouts after which laws about the target began,
    or 0.
    """

    policy: Array
    stage: str = RENEWING
    tells: int = 0
    belief: Belief | None = None
    improved: Array | None = None
    parts: list[Array] = field(default_factory=list)
    change: Estimate = ZERO
    replayed: bool = False
    trust: float = 0.0
    none_is_close: bool = False
    safe: bool = True
    noise: float = 0.0
    rested: int = 0

    def state(self) -> State:
        """All of it, as the arrays of a checkpoint."""
        arrays: State = {name: np.array(getattr(self, name)) for name in _NUMBERS}
        arrays["policy"] = self.policy.copy()
        arrays["held_out"] = np.array(astuple(self.change))
        if self.improved is not None:
            arrays["laws"] = np.stack([self.improved, *self.parts])
        if self.belief is not None:
            arrays |= self.belief.state()
        return arrays

    @classmethod
    def of(cls, state: Mapping[str, NDArray[np.generic]], shape: tuple[int, ...]) -> Progress:
        """The progress in a checkpoint, whose laws have this shape; ValueError if there is none."""
        numbers = numbers_of(state, _NUMBERS)
        if (stage := numbers["stage"]) not in _STAGES:
            raise ValueError(f"its stage is {stage!r}; expected one of {', '.join(_STAGES)}")
        if (noise := numbers["noise"]) < 0.0:
            raise ValueError(f"its noise is {noise:g}; expected 0 or more")
        laws: list[Array] = []
        if "laws" in state:
            laws = [a.copy() for a in checked_array(state, "laws", "f", (None, None, None))]
        known = checked_array(state, "held_out", "f", (3,), finite=False)
        if (np.abs(known[np.isfinite(known)]) > _LARGEST).any() or not known[2] > 0.0:
            raise ValueError(
                f"'held_out' is {known.tolist()}; expected numbers up to {_LARGEST:g} and more than 0 "
                "degrees of freedom"
            )
        return cls(
            checked_array(state, "policy", "f", shape).copy(),
            belief=Belief.of(state),
            improved=laws[0] if laws else None,
            parts=laws[1:],
            change=Estimate(*known.tolist()),
            **numbers,
        )


_KINDS = {"str": "U", "int": "i", "bool": "b", "float": "f"}
_NUMBERS = {own.name: _KINDS[str(own.type)] for own in fields(Progress) if own.type in _KINDS}
"""What is one number or text of a checkpoint, and its NumPy kind."""


@dataclass(frozen=True)
class Schedule:
    """When a law is renewed, in own rollouts; known: those before; budget: all without those."""

    known: int
    budget: int
    settings: ModelBasedSettings

    @property
    def judging(self) -> int:
        """Rollouts that judge the final law."""
        return max(1, min(self.settings.judging, self.budget // 2))

    @property
    def last(self) -> int:
        """Rollouts after which the law is renewed for the last time."""
        enough = max(self.settings.enough_fields - self.known, 1)
        return min(self.budget - self.judging, enough)

    def doubled(self, own: int) -> int:
        """The next renewal where each one comes after twice as many rollouts, known ones included."""
        at = FIRST_RENEWAL
        while at - self.known <= own:
            at *= 2
        # One is only worth it if as many rollouts again come before the last one.
        return at - self.known if 2 * at - self.known <= self.last else self.last


class ModelBased(Optimizer):
    """Policy optimisation on a model; parameters as of `Optimizer`, its context with trajectories."""

    name = "model_based"
    Settings = ModelBasedSettings
    needs_trajectories = True
    any_cost = True
    needs_affine_law = True
    also_improves = (
        "observer",
        "extended_kalman",
        "feedforward",
        "predictive",
        "auto",
        "neural",
        "predictive_kalman",
        "auto_kalman",
    )
    in_coordinates = True
    judges_first_law = True
    explorations = 2
    law_with_constants = "feedforward"
    law_with_actions = "observer"
    law_of_sensors = "extended_kalman"  # measured: python -m benchmarks few_sensors
    laws_of_sensors: ClassVar = {"predictive": "predictive_kalman", "auto": "auto_kalman"}

    def __init__(
        self,
        policy0: ArrayLike,
        *,
        seed: int,
        rollouts: int,
        settings: ModelBasedSettings | None = None,
        context: Context | None = None,
    ) -> None:
        require_positive(rollouts=rollouts)
        if context is None:
            raise ValueError("this optimiser needs a context with trajectories, got none")
        self._settings = settings or ModelBasedSettings()
        self._context, self._seed, self._budget = context, seed, rollouts
        self._declared = context.noise
        self._first = checked_theta(policy0)
        self._none = np.zeros_like(self._first)
        explored = [
            Record(self._none, np.inf, known.states, known.actions)
            for known in context.every_exploration
        ]
        self._before = [*explored, *context.measured]
        self._schedule = Schedule(len(self._before), rollouts, self._settings)
        self._records = Records(
            _REACH * max(float(np.abs(own.states).max()) for own in self._before)
        )
        self._progress = Progress(self._first.copy())

    @classmethod
    def for_context(cls, context: Context) -> type[Optimizer]:
        """Another one for a law that plans, has a network, or estimates the state from few readings."""
        # Not at the top: they know this class.
        from pdeloop.method.adapt import model_based_predictive as plans
        from pdeloop.method.adapt import model_based_sensed as sensed
        from pdeloop.method.adapt import network

        if isinstance(context.law, Neural):
            return network.ModelBasedNeural
        if isinstance(context.law, Predictive):
            few = isinstance(context.law, PredictiveKalman)
            return plans.ModelBasedPredictiveSensed if few else plans.ModelBasedPredictive
        if not context.of_readings:
            return cls
        return sensed.ModelBasedSensed if can_be_sensed(context) else sensed.ModelBasedReadings

    @classmethod
    def first_step(cls, settings: ModelBasedSettings) -> int:
        """A rollout of the first law, and those that judge the next one."""
        return 1 + settings.judging

    @property
    def policy(self) -> Array:
        """The present law, and at the end the chosen one."""
        return self._progress.policy.copy()

    @property
    def belief(self) -> Belief | None:
        """The model that the law was improved on last; None: there is none."""
        return self._progress.belief

    @property
    def records(self) -> list[Record]:
        """The rollouts that it was told of."""
        return self._records.all()

    @property
    def count(self) -> int:
        """Number of rollouts that it was told of."""
        return self._records.count

    @property
    def tells(self) -> int:
        """Number of calls of `tell`."""
        return self._progress.tells

    @property
    def done(self) -> bool:
        """True once no further rollouts are needed."""
        return self._progress.stage == ENDED

    def can_spare(self, rollouts: int) -> bool:
        """Whether a model is there, and would be renewed once more with so many rollouts fewer."""
        progress, budget = self._progress, self._budget - rollouts
        schedule = Schedule(len(self._before), budget, self._settings)
        renews = progress.stage == RENEWING and schedule.last > self._records.count
        return renews and progress.belief is not None and not progress.replayed

    def last_law(self) -> Array:
        """The law that the last update would give on the present model; nothing changes."""
        known = replace(self._progress)
        try:
            if known.belief is not None:
                self._improve(known.belief, {}, final=True)
            return self.policy
        finally:
            self._progress = known

    def ask(self) -> list[Rollout]:
        """The rollouts of the current stage, at once where they do not depend on each other."""
        own, progress = self._records.count, self._progress
        if progress.stage == ENDED:
            return []
        if progress.replayed:
            return self._on_known_fields()
        if progress.stage == RENEWING:
            count = self._next_renewal() - own
            made = progress.belief is not None and self._model_compares
            if made and not of_law(self._records.all(), progress.policy):
                count = min(count, self._schedule.judging)  # does it cost what the model says?
            laws = [progress.policy] * count
        else:
            laws = [progress.policy] * (self._schedule.judging - progress.none_is_close)
            laws += [self._none] * progress.none_is_close
        return [self._rollout(law, own + i) for i, law in enumerate(laws)]

    def _on_known_fields(self) -> list[Rollout]:
        """Rollouts of a step along measured ones, on fields of the first law, and once of no control.

        The final law comes to fresh fields together with the first one, or with no control if that is
        lost.
        """
        progress, judging = self._progress, self._schedule.judging
        known = list(replay.costs_by_field(self._records.all(), self._first))
        if progress.stage == RENEWING:
            left = self._schedule.last - self._records.count
            count = min(judging, left, len(known))
            asked = self._on_new(known, progress.policy)[:count]
            numbers = range(self._records.count, self._records.count + count - len(asked))
            asked += [self._rollout(progress.policy, number) for number in numbers]
            if not replay.costs_by_field(self._records.all(), self._none):
                free = max(min(_NONE_ROLLOUTS, left - count), 0)
                asked += [Rollout(self._none.copy(), seed) for seed in known[:free]]
            return asked
        asked, fresh = self._on_new(known, progress.policy)[:judging], self._records.count
        lost = not any(own.usable for own in of_law(self._records.all(), self._first))
        other = self._none if lost else self._first
        while len(asked) < judging:
            asked.append(self._rollout(progress.policy, fresh))
            if len(asked) < judging and not np.array_equal(progress.policy, other):
                asked.append(self._rollout(other, fresh))
            fresh += 1
        return asked

    def _on_new(self, known: Sequence[int], policy: Array) -> list[Rollout]:
        """Rollouts of a law on those of these fields that it was not measured on."""
        own = replay.costs_by_field(self._records.all(), policy)
        return [Rollout(policy.copy(), seed) for seed in known if seed not in own]

    def tell(self, results: Sequence[RolloutResult]) -> Row:
        """Take the rollouts, and carry out the next stage."""
        asked, due = self.ask(), self._next_renewal()
        require_results(results, len(asked))
        added = self._records.add(asked, results)
        self._progress.tells += 1
        # One thread: a threaded LAPACK rounds differently for another number of threads.
        with one_thread():
            row = self._measured(added)
            if self._progress.stage != RENEWING:
                self._judge(row)
            elif self._progress.replayed or self._records.count >= due or _is_mispredicted(row):
                self._renew(row)
        diverged = sum(not result.usable for result in results)
        return row | {"rollouts": self._records.count, "diverged": diverged}

    def _next_renewal(self) -> int:
        """Own rollouts after which the law is renewed next, unless its costs were mispredicted."""
        own, known = self._records.count, self._measurements()
        if self._repeats:
            return min(own + 1, self._schedule.last)
        if own == 0 and len(known) > 1 and not self._context.noise and improve.begin_alike(known):
            return min(2, self._schedule.last)  # whether they are the same
        return self._scheduled(own)

    def _scheduled(self, own: int) -> int:
        """The same where rollouts of a law differ."""
        return self._schedule.doubled(own)

    @property
    def _repeats(self) -> bool:
        """True if a law's rollouts are all the same one: every episode begins alike, without noise."""
        laws = [[record.cost for record in own] for own in by_law(self._records.all())]
        pairs = [own for own in laws if len(own) > 1 and np.isfinite(own).all()]
        if self._context.noise or not pairs or not improve.begin_alike(self._measurements()):
            return False
        return all(np.ptp(own) <= _REPEATS * abs(own[0]) for own in pairs)

    @property
    def _rests(self) -> bool:
        """True if the last two laws cost hardly less than one before them, each rolled out once."""
        costs = [own[-1].cost for own in by_law(self._records.all())]
        least = (1.0 - self._settings.least_gain) * min(costs[:-2], default=np.inf)
        return self._repeats and len(costs) > 2 and min(costs[-2:]) >= least

    def _law_about_target(self) -> Array | None:
        """One of all that was measured, while rollouts are left; else None."""
        affine = self._context.with_constants is None
        left = self._records.count < self._schedule.last
        if not (affine and left and self._repeats) or self._progress.replayed:
            return None
        return replay.law_about_target(self._context, self._measurements())

    def _turns_to_target(self, row: Row) -> bool:
        """Take the next law about the target, or the cheapest of all laws where none is left to try."""
        progress = self._progress
        laws = [own[-1] for own in by_law(self._records.all())]
        best = min(range(len(laws)), key=lambda i: laws[i].cost)
        before = sum(own.stamp < progress.rested for own in laws)
        law = None
        if len(laws) - max(best + 1, before) < _TRIES:
            law = self._law_about_target()
        progress.policy = laws[best].policy.copy()
        if law is None or any(np.array_equal(law, own.policy) for own in laws):
            return False
        progress.belief, progress.policy = None, law
        row["reason"] = "improved laws gain nothing more: a law about the target follows"
        return True

    def _rollout(self, policy: Array, number: int) -> Rollout:
        return Rollout(policy.copy(), field_seed(self._seed, number))

    def _measured(self, added: Sequence[Record]) -> Row:
        """The mean cost of some rollouts, and the model's earlier prediction of it.

        And the root mean square by which it missed each of them, if it predicts them.
        """
        row: Row = {"role": self._progress.stage}
        if self._progress.replayed:
            added = of_law(added, self._progress.policy)
        if all(record.usable for record in added):
            row["cost"] = float(np.mean([record.cost for record in added]))
        predicted = self._predicted(added)
        if predicted and np.isfinite(predicted).all():
            row["predicted"] = float(np.mean(predicted))
            if "cost" in row and not self._predicts_means:
                missed = np.array([record.cost for record in added]) - predicted
                row["missed"] = float(np.sqrt(np.mean(missed**2)))
        return row

    def _predicted(self, added: Sequence[Record]) -> list[float]:
        """The costs of rollouts on the last model; none without one, or where it replays them."""
        if self._progress.belief is None or not self._model_compares:
            return []
        loop = self._progress.belief.loop(self._context)
        return [loop.predicted(record) for record in added]

    @property
    def _predicts_means(self) -> bool:
        """True if the model predicts no single costs: the plant is chaotic, or readings are few."""
        belief = self._progress.belief
        if belief is None or not belief.whole or self._context.of_readings:
            return True
        return improve.is_chaotic(belief.loop(self._context), self.fields)

    def _data(self) -> list[Record]:
        """All rollouts, denoised."""
        noise, measured = self._context.noise, self._measurements()
        if not noise:
            return measured
        clean = cleaned_states([r.states for r in measured], noise, line=self._context.line)
        return [replace(own, states=states) for own, states in zip(measured, clean, strict=True)]

    def _measurements(self) -> list[Record]:
        """All rollouts as they were measured."""
        return [r for r in (*self._before, *self._records.all()) if len(r.states)]

    def _begin_judging(self) -> None:
        """Also without control, if that may be as good as the law."""
        self._progress.stage = JUDGING
        belief, policy = self._progress.belief, self._progress.policy
        if belief is not None and self._schedule.judging > 1 and policy.any():
            loop, fields = belief.loop(self._context), self.fields
            none, own = (loop.costs(loop.theta(law), fields).mean() for law in (self._none, policy))
            self._progress.none_is_close = bool(none <= (1.0 + CLOSE) * own)

    @property
    def fields(self) -> Array:
        """The initial fields of all rollouts, (n, n_z)."""
        fields = improve.initial_fields(self._data())
        return fields[:1] if self._repeats else fields

    def _renew(self, row: Row) -> None:
        """Improve the law on the model that predicts the rollouts, or go on without one."""
        if self._progress.rested:
            if not self._turns_to_target(row):
                self._begin_judging()
            return
        final = self._records.count >= self._schedule.last or self._rests
        belief = self._believe()
        if belief is not None:
            row["model"] = belief.model.kind
            if np.isfinite(belief.error):
                row["mismatch"] = belief.error
            if belief.noise:
                row["noise"] = belief.noise
                self._take_noise(belief.noise)
        if belief is not None and belief.accepted:
            self._progress.belief, self._progress.replayed = belief, False
            self._improve(belief, row, final)
        else:
            self._replay(belief, row, final)
        if final and self._progress.stage == RENEWING:
            if self._law_about_target() is None:
                self._begin_judging()
            else:  # once this law is measured
                self._progress.rested = self._records.count + 1

    def _believe(self) -> Belief | None:
        """The model that predicts the rollouts; the kind selected before is tried first."""
        before = self._progress.belief
        kind = "" if before is None else before.model.kind
        return believe(self._context, self._measurements(), self._settings.believed, kind)

    def _take_noise(self, noise: float) -> None:
        """Go on as if this measurement noise had been declared; 0: it was as declared."""
        self._progress.noise = noise
        self._context = replace(self._context, noise=noise or self._declared)

    _unpredicted = "no model of the whole field predicts the rollouts"

    def _replay(self, model: Belief | None, row: Row, final: bool, why: str = "") -> None:
        """A step along measured rollouts from the law that is best on fields of the first one."""
        why = why or self._unpredicted
        progress, records = self._progress, self._records.all()
        best = replay.best_on_same_fields(records, self._first)
        progress.replayed = True
        if progress.trust:
            good = np.array_equal(best, progress.policy)
            progress.trust = min(
                progress.trust * (replay.GROWS if good else replay.SHRINKS), replay.LARGEST_TRUST
            )
        else:
            progress.trust = replay.FIRST_TRUST
        progress.policy = best.copy()
        row["reason"] = f"{why}: {replay.ALONG}"
        if final:
            return
        again = self._designed_again(best)
        if again is not None:
            row["reason"] = (
                f"{why}, and the first law diverged: a law designed on all of them follows"
            )
            progress.policy, progress.trust = again, 0.0
            return
        found = None
        if model is not None:
            loop = model.loop(self._context)
            usable = [record for record in records if record.usable]
            if usable:
                found = replay.step(
                    loop, loop.replays_of(usable), best, self._settings, progress.trust
                )
        if found is None:
            row["reason"] = f"{why}, and no step along them stays finite"
        else:
            progress.policy, row["steps"] = found

    def _designed_again(self, best: Array) -> Array | None:
        """A first law of all that was measured, while each one diverged or cost less than the last."""
        laws = by_law(self._records.all())
        own = [rolled for rolled in laws if not np.array_equal(rolled[0].policy, self._none)]
        costs = [float(np.mean([record.cost for record in rolled])) for rolled in own]
        affine = self._context.with_constants is None
        lost = affine and len(costs) > 0 and not np.isfinite(costs[0])
        if not lost or (best.any() and not np.array_equal(best, self._first)):
            return None
        if len(costs) > _AGAIN and not costs[-1] < costs[-2]:
            return None
        return replay.designed_again(self._context, self._measurements())

    def _improve(self, belief: Belief, row: Row, final: bool) -> None:
        """Take the law of least cost on a model; final: by the last update."""
        loop, fields = belief.loop(self._context), self.fields
        first, none = loop.theta(self._first), loop.theta(self._none)
        safe = verdict.beats_no_control(loop, first, fields)
        base, near = (first, self._first) if safe else (none, self._none)
        self._progress.safe = safe
        improved = base if self._progress.improved is None else self._progress.improved
        rng = np.random.default_rng([self._seed, _MIXTURE_STREAM, self._records.count])
        draw: improve.Draw = partial(
            improve.mixtures, rng=rng, components=belief.components, periodic=self._context.periodic
        )
        data, settings, parts = self._data(), self._settings, self._progress.parts
        states = improve.measured_states(data, improve.CHAOTIC_TESTED)
        if belief.whole:
            chaotic = improve.any_state_serves(loop, base, fields, states)
        else:  # of pieces, as also where it is wrong
            chaotic = improve.is_chaotic(loop, states)
        if chaotic or not belief.whole:
            row["chaotic" if chaotic else "pieces"] = True
            fields = improve.measured_states(data, improve.CHAOTIC_FIELDS)
            # Others than last time, so that the laws of the parts may know those of their own part.
            parts, settings = [], replace(settings, mixtures=0, most_mixtures=0)
        found = improve.renew(loop, base, improved, parts, fields, draw, settings, final=final)
        if found is None:
            self._replay(belief, row, final, "no improved law stays finite on the model")
            return
        self._progress.trust = 0.0
        self._progress.improved, self._progress.parts = found.improved, found.parts
        self._progress.change = found.change
        self._progress.policy = loop.policy(found.theta, near) if found.fraction else near.copy()
        row["fraction"], row["steps"] = found.fraction, found.steps
        if np.isfinite(found.change.value):
            row["predicted_change"], row["deviation"] = found.change.value, found.change.error

    def _judge(self, row: Row) -> None:
        """Choose between the first law, the final one, no control and all others that were measured."""
        laws = {FIRST: self._first, NONE: self._none, ADAPTED: self._progress.policy}
        base = self._decide(row, laws)
        self._look_back(row, laws[base])
        early = "" if self._progress.replayed else WELL_KNOWN.format(len(self.fields))
        if self._repeats:
            early = "every episode begins alike, and the last two laws gained nothing"
        self._progress.stage = ENDED
        if self._records.count < self._budget:
            row["early"] = early or row["reason"]

    def _decide(self, row: Row, laws: Mapping[str, Array]) -> str:
        """Choose between the first law, the final one and no control; the name of that to stay with."""
        progress, known = self._progress, self._rollouts()
        base = FIRST if progress.safe or progress.replayed else NONE
        evidence = None
        if progress.belief is not None and not progress.replayed:
            loop, fields = progress.belief.loop(self._context), self.fields
            evidence = verdict.evidence_of(loop, laws, base, known, fields, progress.change)
        if evidence is None:
            base = base if of_law(known, laws[base]) else FIRST  # there is nothing to compare
            evidence = verdict.evidence_of_rollouts(laws, base, known, self._replays())
        found = verdict.choose(evidence, base, self._settings.confidence)
        progress.policy = laws[found.chosen].copy()
        row |= found.row
        return base

    _model_compares = True
    """Whether laws of earlier rollouts are compared on the model as well."""

    def _look_back(self, row: Row, base: Array) -> None:
        """Return another measured law in place of the chosen one where it is better beyond chance."""
        progress, loop, known = self._progress, None, self._rollouts()
        if progress.belief is not None and self._model_compares and not progress.replayed:
            loop = progress.belief.loop(self._context)
        confidence, fields = self._settings.confidence, self.fields
        replays = self._replays()
        found = verdict.cheaper_law(loop, progress.policy, known, fields, confidence, replays)
        if found is None:
            return
        law, saved = found
        name = FIRST if np.array_equal(law, self._first) else ADAPTED
        chosen = str(row["chosen"])
        other = verdict.NAMES[FIRST] if name == FIRST else "an earlier adapted law"
        than = verdict.LAST if chosen == ADAPTED else verdict.NAMES[chosen]
        reason = f"{verdict.size_of(other, saved, than)} and is returned"
        if chosen != ADAPTED:
            missed = str(row["reason"]).removeprefix(f"{verdict.NO_OTHER}: ")
            within = " (within chance)" if missed != row["reason"] else ""
            reason = f"{missed}{within}; {reason}"
        change = verdict.measured_change(known, law, base, replays)
        if change is None:
            change = saved + Estimate(float(row["predicted_change"]), float(row["deviation"]))
        row |= verdict.Verdict(name, change.value, change.error, reason).row
        progress.policy = law.copy()

    def _replays(self) -> verdict.Replays | None:
        """Rollouts as a model replays them; None where it cannot."""
        return None

    def _rollouts(self) -> list[Record]:
        """The rollouts of laws, denoised."""
        return self._data()[len(self._context.every_exploration) :]

    def state(self) -> State:
        """The progress and all rollouts."""
        return self._progress.state() | self._records.state()

    def restore(self, state: Mapping[str, NDArray[np.generic]]) -> None:
        """Continue from a checkpoint of an optimiser with the same arguments."""
        sizes, shape = (len(self._context.U), self._before[0].actions.shape[1]), self._first.shape
        self._progress = Progress.of(state, shape)
        self._take_noise(self._progress.noise)
        if self._progress.belief is not None:
            self._progress.belief.check(self._context)
        self._records.restore(state, *sizes, shape)


def _is_mispredicted(row: Row) -> bool:
    """True if rollouts diverged, or cost far else than the model said, or more, of means."""
    cost = float(row.get("cost", np.inf))
    off = float(row.get("missed", cost - float(row.get("predicted", cost))))
    return not off <= _FAR_OFF * abs(cost)
