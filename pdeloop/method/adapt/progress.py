# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""How far an optimisation with `model_based` has come: its stage, laws and model, for checkpoints.

And the numbers of rollouts after which it renews its law and judges the final one.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import astuple, dataclass, field, fields

import numpy as np
from numpy.typing import NDArray

from pdeloop.messages.array_files import checked_array
from pdeloop.messages.arrays import Array
from pdeloop.method.adapt.base import State, numbers_of
from pdeloop.method.adapt.belief import Belief
from pdeloop.method.adapt.estimate import ZERO, Estimate
from pdeloop.method.adapt.settings import FIRST_RENEWAL, ModelBasedSettings

RENEWING, JUDGING, ENDED = "renewing", "judging", "ended"
LARGEST = 1e150
"""Largest change on fields that were left out."""
_STAGES = (RENEWING, JUDGING, ENDED)


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
        if (np.abs(known[np.isfinite(known)]) > LARGEST).any() or not known[2] > 0.0:
            raise ValueError(
                f"'held_out' is {known.tolist()}; expected numbers up to {LARGEST:g} and more than 0 "
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

    def often(self, own: int) -> int:
        """The next renewal where a law is rolled out no more often than judges it."""
        first = max(FIRST_RENEWAL - self.known, 1)
        every = range(first, max(self.last, first) + 1, self.settings.judging)
        return next((n for n in every if own < n <= self.last), self.last)
