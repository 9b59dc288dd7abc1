# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Which model of the whole field to believe: the first that reproduces the measured rollouts."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import numpy as np

from loop_interfaces.arrays import Array
from loop_method.adapt.base import Record
from loop_method.adapt.simulation import Loop, mismatch, mismatch_of_pieces
from loop_method.field_models import FieldModel
from loop_method.field_models.convolution import fit_convolutions
from loop_method.field_models.differential import fit_differential

# A model has to reproduce the last rollouts up to this share of their error energy. With noise the
# local models are further from the plant, and so may these be.
REPRODUCED = 0.05
REPRODUCED_NOISY = 0.3
# Powers and ridges of the convolution models.
_DEGREES = (2, 3)
_RIDGES = (1e-7, 1e-6, 1e-5, 1e-4)
# Pieces of each rollout: a model may reproduce these where whole rollouts are chaotic.
_PIECES = 8


def reproducing_model(
    loop: Loop,
    steps: Sequence[Array],
    measured: Sequence[tuple[Array, Array]],
    reproduced: float,
) -> tuple[FieldModel | None, float, bool]:
    """A model that reproduces the measured rollouts, how well, and whether it does as a whole.

    Else in pieces, if there is one.

    Parameters
    ----------
    loop : Loop
        The closed loop.
    steps : tuple of arrays
        From `steps_of`; what the models are fitted to.
    measured : sequence of tuple
        theta and the states of the rollouts to be reproduced (`Loop.measured`).
    reproduced : float
        The largest error.
    """
    fitted: list[FieldModel] = []
    for models in _fitted(steps) if measured else ():
        fitted += models
        error, best = _best(models, lambda m: mismatch(loop, m, measured, reproduced))
        if error <= reproduced:
            return best, error, True
    length = max(loop.horizon // _PIECES, 1)
    error, best = _best(fitted, lambda m: mismatch_of_pieces(loop, m, measured, length))
    return (best if error <= reproduced else None), error, False


def ranks(model: FieldModel, loop: Loop, rejected: Sequence[tuple[Record, Record]]) -> bool:
    """Whether the rejected candidate also costs more than the incumbent on the model.

    rejected: rollouts of the incumbent and of the candidate on the same fields.
    """
    fields = np.stack([incumbent.states[0] for incumbent, _ in rejected])
    incumbent, candidate = (
        loop.simulate(model, loop.theta(record.policy), fields).cost for record in rejected[0]
    )
    return bool(candidate > incumbent)


def steps_of(
    data: Sequence[Record], weights: Sequence[float], V: Array | None = None
) -> tuple[Array, ...]:
    """Of all steps z, a, z after, and the weights of their rollouts; V^T z where there is a V."""
    parts = []
    for record, weight in zip(data, weights, strict=True):
        states = record.states if V is None else record.states @ V
        n = min(len(record.actions), len(states) - 1)
        parts.append((states[:n], record.actions[:n], states[1 : n + 1], np.full(n, weight)))
    return tuple(np.concatenate(columns) for columns in zip(*parts, strict=True))


def _fitted(steps: Sequence[Array]) -> Iterator[Sequence[FieldModel]]:
    """The models of each kind, the simpler kind first."""
    z, a, after, weights = steps

    def convolutions(degrees: Sequence[int], components: int) -> Sequence[FieldModel]:
        return fit_convolutions(
            *(z, a, after, weights), degrees=degrees, ridges=_RIDGES, components=components
        )

    yield convolutions(_DEGREES, 1)
    yield [fit_differential(z, a, after)]
    if z.shape[1] % 2 == 0:
        yield convolutions((1,), 2)


def _best(
    models: Sequence[FieldModel], error_of: Callable[[FieldModel], float]
) -> tuple[float, FieldModel | None]:
    """The least error, and the first model that has it."""
    judged: list[tuple[float, FieldModel | None]] = [(error_of(m), m) for m in models]
    return min(judged, key=lambda pair: pair[0], default=(np.inf, None))
