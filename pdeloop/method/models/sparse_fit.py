# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The fit of an equation of few products of any numbers of a state, where they are no fields.

    dz_i/dt = sum_j A_ij z_j + sum_m C_im m(z) + (B a + c)_i,

m(z) being products of two or three numbers, as of networks whose parts act on each other in no order.
There are far too many to be fitted together. So for each number those are chosen, one by one, that
explain most of what a model linear in states and actions leaves over of its change, as long as each
halves that (orthogonal matching pursuit). The equation of all that were chosen is then fitted as one
of neighbours is.

No differential equation keeps what happened some samples ago, such as inputs that act late. Of a state
that holds it, the map z_{k+1} - z_k of the same terms is fitted.

References
----------
Pati, Rezaiifar, Krishnaprasad, "Orthogonal matching pursuit", Asilomar Conference, 1993. Brunton,
Proctor, Kutz, PNAS 113(15), 2016.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations_with_replacement

import numpy as np

from pdeloop.messages.arrays import Array
from pdeloop.method.models.base import Samples
from pdeloop.method.models.columns import orthonormal
from pdeloop.method.models.finite_difference import Feature, FiniteDifferenceModel
from pdeloop.method.models.finite_difference_fit import nothing
from pdeloop.method.models.neighbour_fit import fitted
from pdeloop.method.models.settings import SPARSE_TERMS, FieldModelSettings

_SPARSE_PRODUCTS = 2500
"""Number of products above which products of three different numbers are not tried."""
_SPARSE_LEFT = 0.5
"""Share of the remaining squared change that another product may leave."""

Product = tuple[int, ...]
"""The numbers of a state that are multiplied."""
_ROUNDING = 1e-7
"""Size of what a linear model leaves over of a product that is one itself, relative to the product."""


def fit_sparse(
    samples: Samples, *, kind: str, settings: FieldModelSettings, is_map: bool
) -> FiniteDifferenceModel | None:
    """The equation or the map, or None where no product is found, or the plant is of another kind."""
    samples = samples.thinned(settings.near_samples)
    found = chosen(samples)
    if not found:
        return None
    n_z = samples.before.shape[1]
    features = tuple(Feature(factors) for factors in [*((i,) for i in range(n_z)), *found])
    empty = nothing(kind, features, samples, n_z)
    return fitted(replace(empty, substeps=0 if is_map else 1), samples, None, settings)


def products(n_z: int, most: int) -> list[Product]:
    """Those of two numbers and of three, or if they are more than `most`, of three with a square."""
    two: list[Product] = list(combinations_with_replacement(range(n_z), 2))
    three: list[Product] = list(combinations_with_replacement(range(n_z), 3))
    if len(two) + len(three) > most:
        three = [own for own in three if len(set(own)) < 3]
    return two + three


def chosen(samples: Samples) -> list[Product]:
    """The products that some number's change is explained by, in the order of `products`."""
    candidates = products(samples.before.shape[1], _SPARSE_PRODUCTS)
    size = np.sqrt(np.mean(samples.before**2, axis=0))
    z = samples.before / np.where(size > 0.0, size, 1.0)
    root = samples.weights()[:, None]
    linear = orthonormal(np.hstack([np.ones((len(z), 1)), z, samples.actions]) * root)
    X = np.stack([np.prod(z[:, own], axis=1) for own in candidates], axis=1) * root
    before = np.linalg.norm(X, axis=0)
    X, y = (
        values - linear @ (linear.T @ values)
        for values in (X, (samples.after - samples.before) * root)
    )
    left = np.linalg.norm(X, axis=0)
    X = X / np.where(left > _ROUNDING * before, left, np.inf)
    found = {p for change in y.T for p in _pursued(X, change)}
    return [candidates[p] for p in sorted(found)]


def _pursued(X: Array, y: Array) -> list[int]:
    """The columns of X, each of length 1 or 0, that explain y."""
    kept: list[int] = []
    rest = y
    while len(kept) < SPARSE_TERMS:
        likely = int(np.argmax(np.abs(rest @ X)))
        together = X[:, [*kept, likely]]
        left = y - together @ np.linalg.lstsq(together, y)[0]
        if likely in kept or not left @ left < _SPARSE_LEFT * (rest @ rest):
            break
        kept.append(likely)
        rest = left
    return kept
