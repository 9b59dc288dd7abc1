# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Simulations of the equation of `pdeloop.method.models.sensed`, and of equations next to it.

Finite differences need the same rollouts from many fields, and with each of the unknowns a little less.
All that share the terms of the equation are one batch of the compiled solver: what an action does is
linear in the supports and their strengths, so that each row has inputs of its own.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from pdeloop.messages.arrays import Array
from pdeloop.method.models.sensed import WAVES, Actuators, SensedEquation
from pdeloop.method.models.sensed_unknowns import COEFFICIENTS, EQUATION, SHARED
from pdeloop.method.models.settings import FieldModelSettings
from pdeloop.solver.polynomial_step import PolynomialStep, PolynomialSteps

# A rate per sampling time beyond which no coefficient of a step can be computed.
_FASTEST = 1e50


class SensedFlow:
    """The equation with the unknowns (44 + n_a,), and with some of them less by a difference each.

    Parameters
    ----------
    shared : (44 + n_a,) array
        The unknowns.
    n : int
        Number of grid points.
    actuators : Actuators
        What is declared of them.
    sizes : (T,) array
        How large the fields are at the time steps, which the internal steps follow.
    settings : FieldModelSettings
        How they do.
    clip : float
        As for `SensedEquation.compiled`.
    varied : sequence of int
        Which unknowns, in their order.
    difference : float
        By how much.
    """

    def __init__(
        self,
        shared: Array,
        n: int,
        actuators: Actuators,
        sizes: Array,
        settings: FieldModelSettings,
        clip: float,
        varied: Sequence[int] = (),
        difference: float = 0.0,
    ) -> None:
        changes = np.zeros((1 + len(varied), shared.size))
        changes[1 + np.arange(len(varied)), list(varied)] = difference
        equations = [SensedEquation(shared - own, n, actuators, settings) for own in changes]
        first, self._terms = (
            equations[0],
            [own for i, own in zip(varied, equations[1:], strict=True) if i < EQUATION],
        )
        self.finite = all(
            bool(np.abs(each.symbols[0]).max() < _FASTEST) for each in [first, *self._terms]
        )
        """False where the unknowns are so far off that nothing can be simulated."""
        self._modes, self._clip, self._first = n // 2 + 1, clip, first
        self._substeps = _few(first.substeps(sizes)) if self.finite else np.ones(0, np.int64)
        # Shift, spacing and width of the actuators change the supports; the others only strengths.
        moved = [k for k, i in enumerate(varied, start=1) if COEFFICIENTS < i < SHARED]
        self._supports = np.hstack([equations[i].supports for i in (0, *moved)])
        n_a, self._blocks = len(actuators.centres), 1 + len(moved)
        self._gains = np.zeros((len(equations), self._blocks * n_a + 1))
        for i, equation in enumerate(equations):
            block = 1 + moved.index(i) if i in moved else 0
            self._gains[i, block * n_a : (block + 1) * n_a] = equation.strengths
            self._gains[i, -1] = equation.constant
        self._made: dict[int, tuple[PolynomialStep, PolynomialSteps | None]] = {}

    def path(self, fields: Array, actions: Array, steps: int) -> Iterator[Array]:
        """The spectra (F + unknowns, R, 2, modes), step by step, in one array that changes.

        fields (F, R, 33): initial ones of R rollouts, of which the first also begin the rollouts with
        other unknowns; actions (R, T, n_a).
        """
        count = len(fields)
        start = np.concatenate([fields, np.repeat(fields[:1], len(self._gains) - 1, axis=0)])
        z = np.zeros((*start.shape[:2], 2, self._modes))
        z[:, :, 0, : WAVES + 1] = start[..., : WAVES + 1]
        z[:, :, 1, 1 : WAVES + 1] = start[..., WAVES + 1 :]
        gains = np.concatenate([np.repeat(self._gains[:1], count, axis=0), self._gains[1:]])
        acted = np.concatenate(
            [np.tile(actions, self._blocks), np.ones((*actions.shape[:2], 1))], axis=2
        )
        with_terms = slice(count, count + len(self._terms))
        alike = slice(count), slice(with_terms.stop, len(z))
        for k in range(steps):
            yield z
            inputs = gains[:, None] * acted[None, :, k]
            step, others = self._steps(int(self._substeps[k]))
            for rows in alike:
                step.advance(_rows(z[rows]), _rows(inputs[rows]))
            if others is not None:
                others.advance(_rows(z[with_terms]), _rows(inputs[with_terms]))

    def _steps(self, substeps: int) -> tuple[PolynomialStep, PolynomialSteps | None]:
        """Of the equation, and of those with other terms."""
        if substeps not in self._made:
            first, *others = (
                equation.compiled(substeps, self._supports, self._clip)
                for equation in (self._first, *self._terms)
            )
            self._made[substeps] = first, PolynomialSteps(others) if others else None
        return self._made[substeps]


def _rows(batch: Array) -> Array:
    """As one batch: (a, b, ...) to (a b, ...)."""
    return batch.reshape(-1, *batch.shape[2:])


def _few(substeps: NDArray[np.int64]) -> NDArray[np.int64]:
    """At least as many, of few different numbers: each is half as much again as the one before."""
    levels = [1]
    while levels[-1] < substeps.max():
        levels.append(levels[-1] + max(levels[-1] // 2, 1))
    found: NDArray[np.int64] = np.array(levels)[np.searchsorted(levels, substeps)]
    return found
