# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The fit of an equation of products of neighbours, for states that are values of cells, not fields.

    dz_i/dt = sum_f C_f m_f(z_{i-r} .. z_{i+r}) + (B a + c)_i,

with all monomials m_f of a few neighbours to begin with (`neighbour_features`). Three things differ
from `finite_difference_fit`, as the plants are often chaotic, so that a small error of a step is a
large one of a rollout:

- After two passes, others regress what the model's own steps miss. The error of the means along its
  paths has no effect on where they end: of a plant without noise the coefficients are exact.
- Monomials that explain nothing are then left out, one by one, as long as the residual stays what it
  is. A simulation takes as long as there are monomials, and what is left out cannot mislead a law that
  goes beyond the data.
- Plants of other kinds, of which these products do not explain nearly all of a step, end the fit after
  the first passes, which take a hundredth of the work.

References
----------
Brunton, Proctor, Kutz, "Discovering governing equations from data by sparse identification of
nonlinear dynamical systems", PNAS 113(15), 2016. Miller, "Subset Selection in Regression", 2nd ed.,
Chapman & Hall 2002, chapter 3 (backward elimination).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from pdeloop.method.models.base import Samples
from pdeloop.method.models.finite_difference import FiniteDifferenceModel, neighbour_features
from pdeloop.method.models.finite_difference_fit import (
    Columns,
    Regression,
    coefficients,
    largest_of,
    nothing,
    substeps_of,
)
from pdeloop.method.models.settings import COEFFICIENT_RIDGE, FieldModelSettings

_NEAR_SCREENED = 0.1
"""Share of the change that may be unexplained along straight paths between samples."""
_NEAR_HOPELESS = 0.05
"""Share of the change that may be unexplained along the paths of the first fit."""
_NEAR_SUBSTEPS = 8
"""Maximum number of internal steps of the paths of a fit."""
_NEAR_PASSES = 8
"""Further passes of a model of neighbours, on what its steps miss."""
_NEAR_SETTLED = 0.1
"""Relative change of what its steps miss at which the passes end."""
_NEAR_DROPPED = 0.5
"""Share by which its residual may grow when products are left out."""
_NEAR_NEGLIGIBLE = 1e-12
"""Squared error that counts as none, as a share of the squared change."""


def fit_neighbours(
    samples: Samples,
    *,
    kind: str,
    settings: FieldModelSettings,
    components: int = 1,
    ridge: float | None = None,
) -> FiniteDifferenceModel | None:
    """The equation, or None where the plant is of another kind.

    Of several components second neighbours, with half as many terms again, are tried where the first
    ones do not describe the plant.

    ridge: of the points' own parts in normalised columns; None: all points share their coefficients.
    """
    samples = samples.thinned(settings.near_samples)
    for reach in (1, 2) if components > 1 else (2,):
        features = neighbour_features(components, reach)
        empty = replace(nothing(kind, features, samples, components), substeps=1)
        found = fitted(empty, samples, ridge, settings)
        if found is not None:
            return found
    return None


def fitted(
    model: FiniteDifferenceModel,
    samples: Samples,
    ridge: float | None,
    settings: FieldModelSettings,
) -> FiniteDifferenceModel | None:
    """The equation of the terms of an empty one, which has substeps of its own then, or None."""
    size = largest_of(samples)
    for most in (_NEAR_SCREENED, _NEAR_HOPELESS):
        data = Regression.along(model, samples)
        if data is None:
            return None
        columns = data.columns()
        C = coefficients(columns, ridge)
        found = data.solved(C, model)
        if found is None or not columns.unexplained(C) <= most**2:
            return None  # the plant is of another kind
        # Means that are roughly right are enough for what follows.
        substeps = substeps_of(found, size, settings.near_reach, settings)
        model = replace(found, substeps=min(substeps, _NEAR_SUBSTEPS))
    every = _passes(model, samples, ridge, settings)
    if every is None:
        return None
    missed = Regression.along(every, samples, missed=True)
    if missed is None:
        return every
    kept = explaining(missed.columns(), ridge is None)
    fewer = replace(
        every,
        features=tuple(every.features[f] for f in kept),
        coefficients=np.ascontiguousarray(every.coefficients[kept]),
    )
    return _passes(fewer, samples, ridge, settings) or every


def _passes(
    model: FiniteDifferenceModel,
    samples: Samples,
    ridge: float | None,
    settings: FieldModelSettings,
) -> FiniteDifferenceModel | None:
    """The best equation of passes that regress what steps miss."""
    size = largest_of(samples)
    best, least = None, np.inf
    for _ in range(_NEAR_PASSES + 1):
        data = Regression.along(model, samples, missed=True)
        if data is None or not data.miss < least:
            break
        settled = data.miss > (1.0 - _NEAR_SETTLED) * least
        best, least = model, data.miss
        if settled:
            break
        found = data.solved(coefficients(data.columns(), ridge), model)
        if found is None:
            break
        substeps = substeps_of(found, size, settings.near_reach, settings)
        model = replace(found, substeps=substeps)
    return best


def explaining(columns: Columns, shared: bool) -> list[int]:
    """The features without which the residual is clearly larger, left out one by one."""
    gram, moment = columns.gram, columns.moment
    if shared:
        gram, moment = gram.sum(axis=0)[None], moment.sum(axis=0)[None]
    size = COEFFICIENT_RIDGE * np.trace(gram, axis1=1, axis2=2)[:, None, None]
    inverse = np.linalg.inv(gram + size * np.eye(gram.shape[1]))
    w = inverse @ moment
    residual = max(columns.square - float(np.sum(moment * w)), 0.0)
    most = _NEAR_DROPPED * residual + _NEAR_NEGLIGIBLE * columns.square
    kept = list(range(gram.shape[1]))
    lost = 0.0
    while len(kept) > 1:
        diagonal = np.diagonal(inverse, axis1=1, axis2=2)
        own = np.sum(np.sum(w**2, axis=2) / diagonal, axis=0)
        f = int(np.argmin(own))
        if lost + own[f] > most:
            break
        lost += float(own[f])
        ratio = inverse[:, :, f] / diagonal[:, f, None]
        w = np.delete(w - ratio[:, :, None] * w[:, f, None, :], f, axis=1)
        inverse = inverse - ratio[:, :, None] * inverse[:, f, None, :]
        inverse = np.delete(np.delete(inverse, f, axis=1), f, axis=2)
        del kept[f]
    return kept
