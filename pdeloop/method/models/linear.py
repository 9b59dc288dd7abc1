# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Linear models, for plants that are not equations on a grid, and their fits.

A matrix of the whole state, or, where that would be too large, one of POD modes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from pdeloop.jit.cache import cached_njit
from pdeloop.messages.arrays import Array, read_only
from pdeloop.method.models.base import Samples, StoredModel


@dataclass(frozen=True, eq=False)
class LinearModel(StoredModel):
    """z_{k+1} = A z_k + B a_k + c.

    Attributes
    ----------
    kind : str
    A : (n_z, n_z) array
    B : (n_z, n_a) array
    constant : (n_z,) array
        c.
    """

    FORM = "linear"
    SHAPES: ClassVar = {"constant": "n", "A": "n n", "B": "n a"}
    kind: str
    A: Array
    B: Array
    constant: Array

    def step(self, states: Array, actions: Array) -> Array:
        after = np.tile(self.constant, (len(states), 1))
        add_products(read_only(states), read_only(self.A.T), after)
        add_products(read_only(actions), read_only(self.B.T), after)
        return after

    def pull_back(self, states: Array, actions: Array, covectors: Array) -> tuple[Array, Array]:
        on_states, on_actions = np.zeros(states.shape), np.zeros(actions.shape)
        y = read_only(covectors)
        add_products(y, read_only(self.A), on_states)
        add_products(y, read_only(self.B), on_actions)
        return on_states, on_actions

    def linearise(self, state: Array, action: Array) -> tuple[Array, Array]:
        return self.A.copy(), self.B.copy()


@cached_njit()
def add_products(rows: Array, matrix: Array, totals: Array) -> None:
    """totals += rows @ matrix, one row after the other: BLAS rounds by how many there are."""
    for m in range(len(rows)):
        for i in range(rows.shape[1]):
            value = rows[m, i]
            for j in range(matrix.shape[1]):
                totals[m, j] += value * matrix[i, j]


def fit_linear(samples: Samples, *, kind: str, ridge: float) -> LinearModel | None:
    """Least squares on the change of the state, about the mean state and action.

    ridge: of normalised columns; those of the state have one unit, each input its own.
    """
    n_z, change = samples.before.shape[1], samples.after - samples.before
    columns = np.hstack([samples.before, samples.actions])
    mean, moved = columns.mean(axis=0), change.mean(axis=0)  # an offset is nothing to hold at zero
    columns = columns - mean
    scale = np.sqrt(np.mean(columns**2, axis=0))
    scale[:n_z] = np.sqrt(np.mean(scale[:n_z] ** 2))
    scale = np.where(scale > 0.0, scale, 1.0)
    columns = columns / scale
    gram = columns.T @ columns / len(samples) + ridge * np.eye(len(scale))
    moment = columns.T @ (change - moved) / len(samples)
    found = np.linalg.solve(gram, moment) / scale[:, None]
    if not np.isfinite(found).all():
        return None
    A, B, constant = np.eye(n_z) + found[:n_z].T, found[n_z:].T, moved - mean @ found
    return LinearModel(kind, *(np.ascontiguousarray(x) for x in (A, B, constant)))


def fit_convolution(
    samples: Samples, *, kind: str, ridge: float, components: int
) -> LinearModel | None:
    """Least squares where A is the same at every place of a ring: circulant blocks.

    Each wavenumber has its own regression, with `components` unknowns in addition to the inputs.

    ridge: of normalised columns.
    """
    count, n_z = samples.before.shape
    n_x, n_a = n_z // components, samples.actions.shape[1]

    def transformed(states: Array) -> NDArray[np.complex128]:
        """(wavenumbers, N, components)"""
        spectrum = np.fft.rfft(states.reshape(count, components, n_x))
        return np.ascontiguousarray(spectrum.transpose(2, 0, 1))

    columns, change = transformed(samples.before), transformed(samples.after - samples.before)
    inputs = np.hstack([samples.actions, np.ones((count, 1))]).astype(complex)
    columns = np.concatenate([columns, np.broadcast_to(inputs, (len(columns), *inputs.shape))], 2)
    scale = np.sqrt(np.sum(np.abs(columns) ** 2, axis=1))
    # Fields have one unit at all wavenumbers, as else each would be fitted to its rounding.
    scale[:, :components] = np.sqrt(np.mean(scale[:, :components] ** 2, axis=0))
    scale = np.where(scale > 0.0, scale, 1.0)[:, None]
    columns = columns / scale
    gram = columns.conj().transpose(0, 2, 1) @ columns + ridge * np.eye(columns.shape[2])
    found = np.linalg.solve(gram, columns.conj().transpose(0, 2, 1) @ change)
    found = found / scale.transpose(0, 2, 1)  # (wavenumbers, unknowns, components)
    rows = np.fft.irfft(found, n_x, axis=0).transpose(2, 1, 0)  # (components, unknowns, n_x)
    if not np.isfinite(rows).all():
        return None
    places = (np.arange(n_x)[:, None] - np.arange(n_x)) % n_x
    A = np.block([[rows[i, j][places] for j in range(components)] for i in range(components)])
    B = rows[:, components : components + n_a].transpose(0, 2, 1).reshape(n_z, n_a)
    constant = rows[:, -1].ravel()
    A = np.eye(n_z) + A
    return LinearModel(kind, *(np.ascontiguousarray(x) for x in (A, B, constant)))


_LOW_RANK_RIDGE = 1e-12
"""Ridge of low-rank models."""
_SNAPSHOTS = 400
"""Maximum number of states that POD modes are computed from."""
_ENERGY = 1e-12
"""Share of the energy below which a POD mode is left out."""
_SAMPLES_PER_MODE = 4
"""Data steps per unknown in a row of a low-rank model."""


@dataclass(frozen=True, eq=False)
class LowRankModel(StoredModel):
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

    FORM = "low-rank"
    SHAPES: ClassVar = {"constant": "r", "V": "n r", "A": "r r", "B": "r a"}
    kind: str
    V: Array
    A: Array
    B: Array
    constant: Array

    @property
    def n_z(self) -> int:
        return len(self.V)

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
