# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The last rollouts of `gauss_newton`: they decide between the first law, the one found and none.

A search judges its steps on the few fields from which it computes them, so its result is compared on
others:

- where a model of the whole field predicts rollouts, as in `model_based`: the law moves from the first
  one by the fraction that held-out fields confirm, and rollouts from fresh fields correct the model's
  errors (`on_model`);
- elsewhere the laws are rolled out from the same fresh fields (`on_same_fields`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from loop_interfaces.array_files import checked_array
from loop_interfaces.arrays import Array
from loop_method.adapt.base import Context, Record, Rollout, State
from loop_method.adapt.belief import Belief
from loop_method.adapt.estimate import ZERO, Estimate, mean_of
from loop_method.adapt.initial_fields import any_state_serves, initial_fields, measured_states
from loop_method.adapt.progress import fraction_and_change, held_out
from loop_method.adapt.renewal import confirmed_fraction
from loop_method.adapt.settings import GaussNewtonSettings, ImprovementSettings
from loop_method.adapt.verdict import (
    ADAPTED,
    FIRST,
    NO_OTHER,
    NONE,
    Evidence,
    Verdict,
    beats_no_control,
    choose,
    evidence_against_none,
    evidence_of,
    evidence_of_pairs,
    size_of,
)
from loop_method.seeds import field_seed

LEAST = 2
"""Fields on which laws are compared without a model: one tells nothing of chance."""
Laws = Mapping[str, Array]
"""First law, found law and no control by their names."""


@dataclass(frozen=True, eq=False)
class Comparison:
    """The deciding rollouts, and what is known before them.

    Attributes
    ----------
    law : (n_a, 2 n_s) array
        The law that was found, as far as it is confirmed.
    base : str
        Name of the law to stay with.
    names, numbers : (k,) sequences of str and int
        The laws to roll out, and the numbers of the initial fields.
    fraction : float
        How far the law moved from `base`.
    change : Estimate
        What it costs more than `base` on a model, on fields that did not make it.
    belief : Belief or None
        The model; None: rollouts alone decide.
    """

    law: Array
    base: str
    names: Sequence[str]
    numbers: Sequence[int]
    fraction: float = 1.0
    change: Estimate = ZERO
    belief: Belief | None = None

    def rollouts(self, laws: Laws, seed: int) -> list[Rollout]:
        """What to roll out."""
        compared = {**laws, ADAPTED: self.law}
        return [
            Rollout(compared[name].copy(), field_seed(seed, number))
            for name, number in zip(self.names, self.numbers, strict=True)
        ]

    def verdict(
        self,
        context: Context,
        laws: Laws,
        known: Sequence[Record],
        fresh: Sequence[Record],
        confidence: float,
    ) -> Verdict:
        """The law to return.

        Parameters
        ----------
        context : Context
            The problem.
        laws : mapping
            First law, found law and no control.
        known, fresh : sequences of Record
            Rollouts before, and those of `names`.
        confidence : float
            Standard errors by which another law has to be better than `base`.
        """
        laws = {**laws, ADAPTED: self.law}
        if self.belief is None:
            return choose(self._rolled_out(laws, known, fresh), self.base, confidence)
        others = [r for r in known if r.usable or r.stamp >= 0]  # without the exploration
        if not np.array_equal(self.law, laws[self.base]):
            # Rollouts that the law was chosen by are no evidence for it.
            others = [r for r in others if not np.array_equal(r.policy, self.law)]
        evidence = evidence_of(
            self.belief.loop(context),
            laws,
            self.base,
            [*others, *fresh],
            initial_fields([*known, *fresh]),
            self.change,
        )
        return choose(evidence, self.base, confidence)

    def without_rollouts(self, laws: Laws, gain: Estimate | None) -> Verdict:
        """The law to return where there is nothing to roll out, or nothing left for it.

        gain: that of the steps.
        """
        if np.array_equal(self.law, laws[self.base]):
            return Verdict(self.base, 0.0, 0.0, NO_OTHER)
        if self.belief is None and gain is not None and gain.value < 0.0:
            size = gain.value, gain.error
            words = f"{size_of(ADAPTED, self.base, *size)}, on the fields of the steps"
            return Verdict(ADAPTED, *size, words)
        if self.belief is None:
            return Verdict(
                ADAPTED,
                0.0,
                0.0,
                "too few rollouts are left to compare the adapted law on other fields",
            )
        change = self.change.value, self.change.error
        return Verdict(ADAPTED, *change, size_of(ADAPTED, self.base, *change))

    def _rolled_out(
        self, laws: Laws, known: Sequence[Record], fresh: Sequence[Record]
    ) -> dict[str, Evidence]:
        """The evidence of rollouts alone."""
        costs = {
            name: np.array(
                [r.cost for own, r in zip(self.names, fresh, strict=True) if own == name]
            )
            for name in dict.fromkeys(self.names)
        }
        known = [r for r in known if r.usable or r.stamp >= 0]  # without the exploration
        before = np.array([r.cost for r in known if np.array_equal(r.policy, laws[self.base])])
        gain = gain_of_steps(known, laws, self.base)
        also = {} if gain is None else {ADAPTED: [gain]}
        if self.base in costs and self.base == NONE:
            return evidence_against_none(costs, before, also)
        if self.base in costs:
            return evidence_of_pairs(costs, self.base)
        costs[self.base] = before
        return {name: Evidence(ZERO, own, also.get(name, ())) for name, own in costs.items()}

    def state(self) -> State:
        """The arrays of a checkpoint."""
        arrays: State = {
            "law": self.law.copy(),
            "base": np.array(self.base),
            "names": np.array(list(self.names), dtype=str),
            "numbers": np.array(list(self.numbers), dtype=np.int64),
            "held_out": held_out(self.fraction, self.change),
        }
        return arrays if self.belief is None else arrays | self.belief.state()

    @classmethod
    def of(
        cls,
        arrays: Mapping[str, NDArray[np.generic]],
        shape: tuple[int, ...],
        context: Context,
    ) -> Comparison | None:
        """The comparison in a checkpoint, None if it has none; ValueError if it is not one."""
        if not arrays:
            return None
        names = [str(name) for name in checked_array(arrays, "names", "U", (None,))]
        base = str(checked_array(arrays, "base", "U", ()))
        numbers = checked_array(arrays, "numbers", "i", (len(names),)).tolist()
        if unknown := {base, *names} - {FIRST, ADAPTED, NONE}:
            raise ValueError(f"it compares unknown laws: {', '.join(sorted(unknown))}")
        law = checked_array(arrays, "law", "f", shape).copy()
        fraction, change = fraction_and_change(arrays)
        belief = Belief.of(arrays)
        if belief is not None:
            belief.check(context)
        return cls(law, base, names, numbers, fraction, change, belief)


def on_model(
    context: Context,
    belief: Belief,
    laws: Laws,
    known: Sequence[Record],
    numbers: Sequence[int],
    rng: np.random.Generator,
    settings: ImprovementSettings,
) -> Comparison:
    """The comparison where a model predicts rollouts; a law that is not better by then is not run.

    Parameters
    ----------
    context : Context
        The problem.
    belief : Belief
        The model.
    laws : mapping
        First law, found law and no control.
    known : sequence of Record
        All rollouts, denoised.
    numbers : sequence of int
        Fresh fields for which there are rollouts.
    rng : numpy.random.Generator
        Of the fields that are drawn.
    settings : ImprovementSettings
        Constants.
    """
    loop, fields = belief.loop(context), initial_fields(known)
    theta = {name: loop.theta(law) for name, law in laws.items()}
    base = FIRST if beats_no_control(loop, theta[FIRST], fields) else NONE
    law, fraction, change = laws[ADAPTED], 0.0, ZERO
    if not np.array_equal(law, laws[base]):
        left_out, states = fields, measured_states(known, settings.chaotic_fields)
        if any_state_serves(loop, theta[base], fields, states):
            left_out, settings = states, replace(settings, mixtures=0)
        fraction, change = confirmed_fraction(
            loop,
            theta[base],
            left_out,
            rng,
            settings,
            components=belief.components,
            periodic=context.periodic,
        )
        if fraction < 1.0:
            moved = theta[base] + fraction * (theta[ADAPTED] - theta[base])
            law = loop.policy(moved, laws[base]) if fraction else laws[base].copy()
    none, own = (loop.costs(loop.theta(one), fields).mean() for one in (laws[NONE], law))
    close = base == FIRST and bool(none <= (1.0 + settings.close) * own)
    count = len(numbers)
    names = [ADAPTED if fraction else base] * (count - close) + [NONE] * close
    if (not fraction and not close) or count <= close:
        names = []  # nothing is left to be decided
    return Comparison(law, base, names, numbers[: len(names)], fraction, change, belief)


def on_same_fields(
    laws: Laws,
    base: str,
    close: bool,
    numbers: Sequence[int],
    settings: ImprovementSettings,
) -> Comparison:
    """The comparison by rollouts alone, from the same fields where there are enough for all laws.

    Parameters
    ----------
    laws : mapping
        First law, found law and no control.
    base : str
        Name of the law to stay with.
    close : bool
        Whether no control may be as good.
    numbers : sequence of int
        As many fresh fields as there are rollouts.
    settings : ImprovementSettings
        Constants.
    """
    moved = not np.array_equal(laws[ADAPTED], laws[base])
    names = [base] * (moved or close) + [ADAPTED] * moved + [NONE] * close
    if close and moved and len(numbers) < LEAST * len(names):
        names.remove(NONE)
    count = min(settings.pairs, len(numbers) // max(len(names), 1))
    if count < LEAST and moved:  # rollouts of `base` from other fields have to do
        names, count = [ADAPTED], min(settings.pairs, len(numbers))
    if count < LEAST:
        names, count = [], 0
    every = [name for name in names for _ in range(count)]
    fields = list(numbers[:count]) * len(names)
    if base == NONE and NONE in names:  # all of its rollouts count, also one on a field of its own
        rest = list(numbers[count:])[: len(numbers) % len(names)]
        every, fields = every + [NONE] * len(rest), fields + rest
    return Comparison(laws[ADAPTED], base, every, fields)


def rollouts_to_keep(
    budget: int, first_step: int, whole: bool, laws: int, settings: ImprovementSettings
) -> int:
    """How many rollouts of a budget a search leaves for the comparison.

    whole: whether a model predicts rollouts; laws: how many are rolled out where none does.
    """
    spare = max(budget - first_step, 0)
    if whole:
        return min(settings.judging, spare)
    # Of what the first step leaves, half at most.
    count = min(settings.judging, spare // (2 * laws))
    if count < LEAST:
        count, laws = min(settings.judging, spare // 4), 2
    return count * laws if count >= LEAST else 0


def gain_of_steps(records: Sequence[Record], laws: Laws, base: str) -> Estimate | None:
    """What the found law costs more than `base` by the rollouts of a search; None of too few."""
    own, before = (
        np.array([r.cost for r in records if np.array_equal(r.policy, laws[name])])
        for name in (ADAPTED, base)
    )
    few = min(len(own), len(before)) < LEAST or np.array_equal(laws[ADAPTED], laws[base])
    if few or not np.isfinite([*own, *before]).all():
        return None
    return mean_of(own) - mean_of(before)


def gain_is_clear(gain: Estimate | None, settings: GaussNewtonSettings) -> bool:
    """True if a gain is beyond doubt although the steps were chosen by the same rollouts."""
    return gain is not None and gain.is_negative(settings.confidence, settings.clearly)


def none_is_close(records: Sequence[Record], first: Array, close: float) -> bool:
    """True if the rollouts allow that no control is as good as the first law.

    Rollouts from the same fields are compared if there are any; true if nothing is known.

    close: largest share by which no control then costs more.
    """
    found: list[dict[bytes, float]] = []
    for law in (np.zeros_like(first), first):
        own = [r for r in records if np.array_equal(r.policy, law) and len(r.states)]
        found.append({record.states[0].tobytes(): record.cost for record in own})
    none, own_costs = found
    if not (none and own_costs):
        return True
    common = none.keys() & own_costs.keys()
    before, after = (
        float(np.mean([cost for name, cost in costs.items() if name in common or not common]))
        for costs in found
    )
    return not before > (1.0 + close) * after
