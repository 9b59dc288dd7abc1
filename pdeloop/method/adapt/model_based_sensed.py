# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""`model_based` for a law that estimates the state, on a model of the field between few sensors.

Where one equation reproduces the readings (`pdeloop.method.models.sensed`), laws are designed and
improved on it, from the initial fields estimated from the readings and draws from their distribution,
and compared on other draws. In simulations of the filter's own equation what trusts it looks too good,
and it may be wrong where no sensor is: the filter of the cheapest law trusts it less where that costs
hardly more, and pairs of rollouts from the same fields decide.

A linear model of the readings (`ModelBasedReadings`) describes the plant near the fields of one law,
and its innovations change with the law. So a step stays close to the law that measured best.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from pdeloop.messages.arrays import Array
from pdeloop.method.adapt import verdict
from pdeloop.method.adapt.base import Record, Rollout, Row, of_law
from pdeloop.method.adapt.belief import Belief, believe
from pdeloop.method.adapt.improve import (
    FIRST_GAIN,
    curvature_of,
    improve,
    mixtures,
    weighted,
)
from pdeloop.method.adapt.model_based import FIRST_RENEWAL, JUDGING, RENEWING, ModelBased
from pdeloop.method.adapt.replay import FEWEST, best_measured, costs_by_field, step
from pdeloop.method.adapt.sensed_loop import (
    estimated_laws,
    least_trusting,
    sensed_from,
    sensed_loop,
    to_be_fitted,
)
from pdeloop.method.adapt.verdict import (
    ADAPTED,
    Estimate,
    cheapest,
    index_of_cheapest,
    mean_of,
)
from pdeloop.method.laws.extended_kalman import ExtendedKalman
from pdeloop.method.models.sensed import SensedModel
from pdeloop.method.models.sensed_fit import SENSED_REPRODUCED

READINGS_TRUST = 1.0
"""Weight of the distance from the start of a step on a model of readings: for a linear plant the step
is 1/(1 + weight) of the full one."""


class ModelBasedReadings(ModelBased):
    """`ModelBased` on a model of the readings (`ReplayedLoop`)."""

    _unpredicted = "no model of the readings predicts the rollouts"
    _model_compares = False

    @property
    def _sensed(self) -> SensedModel | None:
        """The model of the field that is believed."""
        belief = self._progress.belief
        model = None if belief is None else belief.model
        return model if isinstance(model, SensedModel) else None

    def _scheduled(self, own: int) -> int:
        """A law is rolled out no more often than judges it: steps are short."""
        schedule, every = self._schedule, self._settings.judging
        first = max(FIRST_RENEWAL - schedule.known, 1)
        following = first if own < first else own + every - (own - first) % every
        return min(following, schedule.last)

    def _data(self) -> list[Record]:
        """All rollouts as they were measured: the model's filter knows their noise."""
        return self._measurements()

    @property
    def fields(self) -> Array:
        """Initial states of rollouts, with their innovations."""
        if self._progress.belief is None:
            return super().fields
        return self._progress.belief.loop(self._context).beginnings(self._data())

    def _renew(self, row: Row) -> None:
        """Where laws run too far away to be fitted, rollouts without control come next."""
        super()._renew(row)
        if self._progress.stage != RENEWING or not self._none_tells():
            return
        fitted = to_be_fitted(self._context, self._measurements())
        if not any(own.policy.any() for own in fitted):
            self._progress.policy = self._none.copy()
            for name in OF_A_LAW:
                row.pop(name, None)
            row["reason"] = "every law runs away: no control is rolled out next"

    def _none_tells(self) -> bool:
        """True if rollouts without control would say something new."""
        return not self._of(self._none)

    def _of(self, law: Array) -> list[Record]:
        """The rollouts of a law."""
        return of_law(self._records.all(), law)

    def _replay(self, model: Belief | None, row: Row, final: bool, why: str = "") -> None:
        """More rollouts may determine a model."""
        row["reason"] = f"{why or self._unpredicted}; the law is kept"

    def _improve(self, belief: Belief, row: Row, final: bool) -> None:
        """A step from the law that measured best."""
        own = [record for record in self._records.all() if self._is_linear(record.policy)]
        best = best_measured(own, self._first)
        if not self._is_linear(self._progress.policy):
            self._progress.policy = best.copy()
        loop = belief.loop(self._context)
        fields = loop.beginnings(own)
        found = step(loop, fields, best, self._settings, READINGS_TRUST)
        if found is None:
            row["reason"] = "the improved law does not stay finite on the model; the law is kept"
        else:
            self._progress.policy, row["steps"] = found

    def _judge(self, row: Row) -> None:
        """Judge the law that measured best in place of the last one, if that is on these models."""
        if self._sensed is None:
            others = [
                record
                for record in self._records.all()
                if self._is_linear(record.policy) and not np.array_equal(record.policy, self._first)
            ]
            self._progress.policy = best_measured(others, self._progress.policy).copy()
        super()._judge(row)

    def _replays(self) -> verdict.Replays | None:
        """Of few sensors there are none: the plant's cost is not that of the readings alone."""
        belief = self._progress.belief
        if self._context.sensors or belief is None or belief.error > self._settings.believed:
            return None
        loop = belief.loop(self._context)
        return verdict.Replays(loop, loop.beginnings(self._rollouts()), belief.error)

    def _is_linear(self, policy: Array) -> bool:
        """False of a law on an estimate of the field, which a model of the readings does not have."""
        law = self._context.law
        return not (isinstance(law, ExtendedKalman) and law.estimates(policy))


_ATTEMPTS = 5
"""Maximum number of times that an equation is looked for in vain."""
# A law with memory has many parameters, and simulations cost no rollout.
_LONGER, _LEAST_GAIN, _DRAWS = 4, 3e-4, 2
"""Times `iterations`, `least_gain`, and sets of drawn initial fields, each of at most `mixtures`, of
the last improvement of a linear law."""

DRAWN_STREAM = 0x44524157  # "DRAW"
OF_A_LAW = ("fraction", "steps", "predicted_change", "deviation")
"""Entries of a row that describe the law that follows."""


class ModelBasedSensed(ModelBasedReadings):
    """`ModelBasedReadings`, on a model of the field as long as one reproduces the readings."""

    def _scheduled(self, own: int) -> int:
        """After as many rollouts as judge a law; on a model of the field later after twice as many."""
        last = self._schedule.last
        if self._sensed is None:
            return min(own + self._settings.judging, last)
        return 2 * own if 4 * own <= last else last

    def _none_tells(self) -> bool:
        """Until an equation is found, as long as one is looked for."""
        return self._sensed is None and self._attempts_left(
            self._records.count + self._settings.judging
        )

    def _attempts_left(self, own: int) -> bool:
        """True if an equation is looked for after so many own rollouts."""
        return own // self._settings.judging < _ATTEMPTS

    def _believe(self) -> Belief | None:
        """In an equation where one reproduces the readings, else in a model of the readings."""
        measured, model = self._measurements(), self._sensed
        if model is not None or self._attempts_left(self._records.count):
            found = sensed_from(self._context, measured, model)
            if found is not None:
                return Belief(*found)
        return believe(self._context, measured, self._settings.believed)

    @property
    def fields(self) -> Array:
        """Initial fields of the rollouts whose readings the equation reproduces; of all if of none."""
        if self._sensed is None:
            return super().fields
        loop = sensed_loop(self._context, self._sensed)
        found = [loop.smoothed(record) for record in self._data()]
        good = [field for field, error in found if error <= SENSED_REPRODUCED]
        return np.stack(good or [field for field, _ in found])

    def _improve(self, belief: Belief, row: Row, final: bool) -> None:
        """The law of least cost on the model, among the current one and those that it designs."""
        if not isinstance(belief.model, SensedModel):
            super()._improve(belief, row, final)
            return
        loop, fields = sensed_loop(self._context, belief.model), self.fields
        progress, settings, law = self._progress, self._settings, self._context.law
        drawn, others = (self._drawn(fields, _DRAWS if final else 1, n) for n in range(2))
        every, weights = weighted(fields, drawn)
        now = loop.theta(progress.policy)
        # A linear estimate depends less on the equation.
        linear = now if now.ndim > 1 else loop.theta(self._first)
        longer = replace(settings, iterations=_LONGER * settings.iterations) if final else settings
        gain = _LEAST_GAIN if final else FIRST_GAIN
        found = improve(loop, linear, every, weights, curvature_of(loop), longer, gain)
        laws, steps = ([found.theta], found.steps) if found else ([], 0)
        if isinstance(law, ExtendedKalman):
            further, more = estimated_laws(loop, every, weights, settings)
            laws, steps = [*laws, *further], steps + more
        if not laws:
            row["reason"] = "no improved law stays finite on the model; the law is kept"
            return
        held_out = others if len(others) else fields
        equal = np.full(len(held_out), 1.0 / len(held_out))
        theta = cheapest(loop, [now, *laws], held_out, equal)
        if theta is not now:
            if isinstance(law, ExtendedKalman) and theta.ndim == 1:
                theta = least_trusting(loop, theta, held_out, settings)
            progress.policy = loop.policy(theta, self._first)
        first = loop.costs(loop.theta(self._first), held_out)
        none = loop.costs(loop.no_control, held_out)
        progress.safe = index_of_cheapest(np.stack([none, first]), equal) == 1
        with np.errstate(invalid="ignore"):
            changes = loop.costs(theta, held_out) - (first if progress.safe else none)
        known, row["steps"] = changes[np.isfinite(changes)], steps
        progress.change = change = mean_of(known) if len(known) else Estimate(np.nan, np.nan)
        if len(known):
            row["predicted_change"], row["deviation"] = change.value, change.error

    def _drawn(self, fields: Array, sets: int, which: int) -> Array:
        """Draws from the distribution of the fields, as often as there are sets."""
        rng = np.random.default_rng([self._seed, DRAWN_STREAM, self._records.count, which])
        most, periodic = self._settings.mixtures, self._context.periodic
        drawn = [mixtures(fields, most, rng, periodic=periodic) for _ in range(sets)]
        return np.concatenate(drawn)

    def ask(self) -> list[Rollout]:
        """No control where it may stay, and the final law on the fields of the one that may stay."""
        asked = super().ask()
        if self._sensed is None or self._progress.stage not in (RENEWING, JUDGING):
            return asked
        first = self._of(self._first)
        if self._progress.stage == JUDGING:
            known = self._of(self._first if self._progress.safe else self._none) or first
            numbers = [record.stamp for record in known]
            return [
                self._rollout(own.policy, numbers[i % len(numbers)]) for i, own in enumerate(asked)
            ]
        if self._progress.safe or self._of(self._none):
            return asked
        return [replace(own, policy=self._none) for own in asked[: len(first)]] + asked[
            len(first) :
        ]

    def _begin_judging(self) -> None:
        super()._begin_judging()
        self._progress.none_is_close &= self._sensed is None or not self._of(self._none)

    def _decide(self, row: Row, laws: Mapping[str, Array]) -> str:
        """As on a model of the whole field, where there is one, if pairs of rollouts agree."""
        base = super()._decide(row, laws)
        pair, known = {base: laws[base], ADAPTED: laws[ADAPTED]}, self._records.all()
        of_base, of_final = (costs_by_field(known, law).keys() for law in pair.values())
        decided = row["chosen"] not in pair or np.array_equal(pair[base], pair[ADAPTED])
        if self._sensed is None or decided or len(of_base & of_final) < FEWEST:
            return base
        evidence = verdict.evidence_of_rollouts(pair, base, known)
        evidence[ADAPTED] = replace(evidence[ADAPTED], also=[self._progress.change])
        found = verdict.choose(evidence, base, self._settings.confidence)
        self._progress.policy = pair[found.chosen].copy()
        row |= found.row
        return base
