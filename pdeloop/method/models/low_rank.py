# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A linear model in POD modes of the whole field, for states of which a matrix would be too large."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pdeloop.messages.arrays import Array, read_only
from pdeloop.method.models.base import Arrays, Samples, numbers_of, text_of
from pdeloop.method.models.linear import add_products

_LOW_RANK_RIDGE = 1e-12
"""Ridge of low-rank models."""
_SNAPSHOTS = 400
"""Maximum number of states that POD modes are computed from."""
_ENERGY = 1e-12
"""Share of the energy below which a POD mode is left out."""
_SAMPLES_PER_MODE = 4
"""Data steps per unknown in a row of a low-rank model."""


@dataclass(frozen=True, eq=False)
class LowRankModel:
    """z_{k+1} = V (A V^T z_k + B a_k + c), with orthonormal V.

    Attributes
    ----------
    kind : str
    V : (n_z, r) array
    A : (r, r) array
    B : (r, n_a) array
    constant : (r,) array
        c.
    """

    kind: str
    V: Array
    A: Array
    B: Array
    constant: Array

    @property
    def n_z(self) -> int:
        return len(self.V)

    @property
    def n_a(self) -> int:
        return int(self.B.shape[1])

    def step(self, states: Array, actions: Array) -> Array:
        x = _products(states, self.V)
        after = np.tile(self.constant, (len(states), 1))
        after += _products(x, self.A.T) + _products(actions, self.B.T)
        return _products(after, self.V.T)

    def pull_back(self, states: Array, actions: Array, covectors: Array) -> tuple[Array, Array]:
        y = _products(covectors, self.V)
        return _products(_products(y, self.A), self.V.T), _products(y, self.B)

    def linearise(self, state: Array, action: Array) -> tuple[Array, Array]:
        return self.V @ self.A @ self.V.T, self.V @ self.B

    def arrays(self) -> Arrays:
        names = ("V", "A", "B", "constant")
        texts = {"form": np.array("low-rank"), "kind": np.array(self.kind)}
        return texts | {name: getattr(self, name) for name in names}

    @staticmethod
    def from_arrays(arrays: Arrays) -> LowRankModel:
        """The model of `arrays`."""
        constant = numbers_of(arrays, "constant", None)
        r = len(constant)
        V, A = numbers_of(arrays, "V", None, r), numbers_of(arrays, "A", r, r)
        return LowRankModel(
            text_of(arrays, "kind"), V, A, numbers_of(arrays, "B", r, None), constant
        )


def _products(rows: Array, matrix: Array) -> Array:
    """rows @ matrix, one row after the other."""
    totals = np.zeros((len(rows), matrix.shape[1]))
    add_products(read_only(rows), read_only(matrix), totals)
    return totals


def fit_low_rank(samples: Samples, *, kind: str, most: int) -> LowRankModel | None:
    """Least squares in at most `most` POD modes of the data, as many as the data determine."""
    n_a = samples.actions.shape[1]
    few = samples.thinned(_SNAPSHOTS).before
    largest = min(most, len(few), len(samples) // _SAMPLES_PER_MODE - n_a - 1)
    if largest < 1:
        return None
    energies, mixtures = np.linalg.eigh(few @ few.T)
    energies, mixtures = energies[::-1], mixtures[:, ::-1]
    kept = int(np.count_nonzero(energies > _ENERGY * max(energies[0], 0.0)))
    if not kept:
        return None
    V = np.linalg.qr(few.T @ mixtures[:, : min(kept, largest)])[0]
    x, after = samples.before @ V, samples.after @ V
    columns = np.hstack([x, samples.actions, np.ones((len(x), 1))])
    scale = np.sqrt(np.mean(columns**2, axis=0))
    scale = np.where(scale > 0.0, scale, 1.0)
    columns = columns / scale
    gram = columns.T @ columns / len(x) + _LOW_RANK_RIDGE * np.eye(len(scale))
    found = np.linalg.solve(gram, columns.T @ after / len(x)) / scale[:, None]
    if not np.isfinite(found).all():
        return None
    r = V.shape[1]
    parts = (V, found[:r].T, found[r : r + n_a].T, found[-1])
    return LowRankModel(kind, *(np.ascontiguousarray(part) for part in parts))
