# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Large states as coordinates in an orthonormal basis of the measured ones.

The states of a trajectory, and those of all trajectories of one plant, have much in common: with
orthonormal rows W that span them, z = W^T x, and all that a linear law, a model and a quadratic cost
need of z is in x. Norms and white noise are the same in both. Work and memory then grow with n_z for W
alone, and with the few numbers of x for everything else.

References
----------
Sirovich, "Turbulence and the dynamics of coherent structures", Quart. Appl. Math. 45, 1987 (snapshots).
Brand, "Fast low-rank modifications of the thin singular value decomposition", Linear Algebra Appl. 415,
2006 (a basis that grows).
"""

from __future__ import annotations

import numpy as np
from scipy import linalg

from pdeloop.messages.arrays import Array
from pdeloop.process.one_thread import one_thread

LARGE = 2048
"""States of more numbers than this are kept as coordinates."""
CAPACITY = 256
"""Rows of a basis, at most, and numbers of its coordinates; those without a row are 0."""
ROUNDED, OUTSIDE = 1e-12, 1e-4
"""Singular values, relative to the norm of all, below which a direction of a trajectory is rounding,
and one outside of the basis is left out."""


def factored(states: Array) -> tuple[Array, Array]:
    """C (N, r) and orthonormal rows V (r, n_z) with states (N, n_z) = C V, strongest first."""
    with one_thread():  # a threaded LAPACK rounds differently
        left, values, right = linalg.svd(states, full_matrices=False)
    kept = max(int(np.count_nonzero(values > ROUNDED * linalg.norm(values))), 1)
    return left[:, :kept] * values[:kept], np.ascontiguousarray(right[:kept])


class SnapshotBasis:
    """Orthonormal rows (r, n_z), extended by the components of new states outside their span."""

    def __init__(self, rows: Array) -> None:
        self.rows = rows

    def extend(self, states: Array, noise: float = 0.0) -> None:
        """Add the directions of states (N, n_z) that are outside, as long as there is room.

        noise: standard deviation of white noise on every number, whose own directions tell nothing.
        """
        room = CAPACITY - len(self.rows)
        if room <= 0 or not len(states):
            return
        with one_thread():
            left = states - (states @ self.rows.T) @ self.rows
            # Again, as the first time leaves rounding errors of what is inside.
            left -= (left @ self.rows.T) @ self.rows
            _, values, right = linalg.svd(left, full_matrices=False)
            floor = OUTSIDE * linalg.norm(states)
            floor = max(floor, noise * (np.sqrt(states.shape[1]) + np.sqrt(len(states))))
            new = right[: min(int(np.count_nonzero(values > floor)), room)]
        if len(new):
            self.rows = np.vstack([self.rows, new])

    def coordinates(self, states: Array) -> Array:
        """x of states (N, n_z), (N, CAPACITY)."""
        found = np.zeros((len(states), CAPACITY))
        with one_thread():
            found[:, : len(self.rows)] = states @ self.rows.T
        return found
