# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Linear models, for plants that are not equations on a grid, and their fits."""

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
