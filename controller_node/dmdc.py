"""A reduced linear model of the plant from one exploratory trajectory, by DMD with control (DMDc).

    z_{k+1} = f(z_k, a_k)    is approximated on s = U^T z by    s_{k+1} = A s_k + B a_k

With Z = [z_0 .. z_{N-1}], Z' = [z_1 .. z_N] and Y = [a_0 .. a_{N-1}] (one column per step), the
p-truncated SVD [Z; Y] ~ Psi Xi Lambda^T and the n_s-truncated SVD Z' ~ U Gamma V^T give

    A = U^T Z' Lambda Xi^{-1} Psi_Z^T U,        B = U^T Z' Lambda Xi^{-1} Psi_Y^T,

where Psi_Z are the first n_z rows of Psi and Psi_Y its last n_a.

References
----------
Zhang, Mowlavi, Benosman, Basar, "Policy Optimization for PDE Control with a Warm Start",
arXiv:2403.01005.
Proctor, Brunton, Kutz, "Dynamic Mode Decomposition with Control", SIAM J. Appl. Dyn. Syst. 15(1),
2016.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import linalg
from threadpoolctl import threadpool_limits

__all__ = ["ReducedModel", "identify", "identify_from"]

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class ReducedModel:
    """The linear model s_{k+1} = A s_k + B a_k of the projected state s = U^T z.

    Attributes
    ----------
    A : (n_s, n_s) array
    B : (n_s, n_a) array
    U : (n_z, n_s) array
        Orthonormal columns; the largest entry of each column is positive, so that U is unique.

    The arrays are read-only copies. A ValueError names the array whose shape or values do not fit.
    """

    A: Array
    B: Array
    U: Array

    def __post_init__(self) -> None:
        for name in ("A", "B", "U"):
            array = np.array(getattr(self, name), dtype=np.float64, order="C")
            if array.ndim != 2 or 0 in array.shape:
                raise ValueError(
                    f"{name} of a reduced model must be a non-empty matrix, but its shape is "
                    f"{array.shape}."
                )
            if not np.isfinite(array).all():
                raise ValueError(
                    f"{name} of a reduced model must be finite, but it has NaN or infinity."
                )
            array.flags.writeable = False
            object.__setattr__(self, name, array)
        n_s = self.U.shape[1]
        if self.A.shape != (n_s, n_s) or self.B.shape[0] != n_s:
            raise ValueError(
                f"a reduced model with U of shape {self.U.shape} needs A of shape ({n_s}, {n_s}) "
                f"and B with {n_s} rows, but A is {self.A.shape} and B is {self.B.shape}."
            )

    @property
    def n_z(self) -> int:
        """Dimension of the full state."""
        return int(self.U.shape[0])

    @property
    def n_s(self) -> int:
        """Dimension of the reduced state."""
        return int(self.U.shape[1])

    @property
    def n_a(self) -> int:
        """Number of actuators."""
        return int(self.B.shape[1])


def identify(states: ArrayLike, actions: ArrayLike, *, p: int, n_s: int) -> ReducedModel:
    """Identify a reduced model from one trajectory.

    Parameters
    ----------
    states : (N + 1, n_z) array
        z_0 .. z_N.
    actions : (N, n_a) array
        a_0 .. a_{N-1}; a_k is held from z_k to z_{k+1}.
    p : int
        Directions of [Z; Y] that are kept, n_s <= p <= min(n_z + n_a, N). Too small loses the
        effect of the actuators; too large fits noise.
    n_s : int
        Modes of the reduced state.

    Raises
    ------
    ValueError
        Shapes that do not fit, NaN or infinity, or more directions asked for than the trajectory
        holds.
    """
    return identify_from([(states, actions)], p=p, n_s=n_s)


def identify_from(
    trajectories: Sequence[tuple[ArrayLike, ArrayLike]], *, p: int, n_s: int
) -> ReducedModel:
    """Identify a reduced model from several trajectories (states, actions) of one plant.

    As `identify`, with the steps of all trajectories as columns beside each other.
    """
    befores, afters, inputs = [], [], []
    for states, actions in trajectories:
        z, own = _matrix("states", states), _matrix("actions", actions)
        if z.shape[0] != len(own) + 1:
            raise ValueError(
                f"{len(own)} actions belong to {len(own) + 1} states, but {z.shape[0]} states were "
                "given; pass the states from before the first action to after the last."
            )
        befores.append(z[:-1])
        afters.append(z[1:])
        inputs.append(own)
    before, following, a = (np.concatenate(parts) for parts in (befores, afters, inputs))
    steps, n_a = a.shape
    n_z = before.shape[1]
    if n_s < 1 or p < 1:
        raise ValueError(f"p and n_s must be at least 1, but p is {p} and n_s is {n_s}.")
    largest = min(n_z + n_a, steps)
    if p > largest:
        raise ValueError(
            f"p must be at most min(n_z + n_a, N) = {largest}, but p is {p}; lower p or record a "
            "longer trajectory."
        )
    if n_s > p:
        raise ValueError(
            f"n_s must be at most p = {p}, but n_s is {n_s}; {p} directions of the data cannot "
            "carry more modes, so lower n_s or raise p."
        )

    # One thread: a threaded LAPACK rounds differently for another number of threads.
    with threadpool_limits(limits=1):
        after = following.T
        psi, xi, lam_t = linalg.svd(np.vstack([before.T, a.T]), full_matrices=False)
        rank = _numerical_rank(xi, n_z + n_a, steps)
        if p > rank:
            raise ValueError(
                f"p must be at most the numerical rank of the data, {rank}, but p is {p}; lower p "
                "or excite more."
            )
        left, gamma, _ = linalg.svd(after, full_matrices=False)
        rank = _numerical_rank(gamma, n_z, steps)
        if n_s > rank:
            raise ValueError(
                f"n_s must be at most the numerical rank of the states, {rank}, but n_s is {n_s}; "
                "lower n_s or excite more."
            )
        basis = _unique_signs(left[:, :n_s])
        regression = (basis.T @ after) @ (lam_t[:p].T / xi[:p])
        return ReducedModel(
            A=regression @ (psi[:n_z, :p].T @ basis), B=regression @ psi[n_z:, :p].T, U=basis
        )


def _matrix(name: str, values: ArrayLike) -> Array:
    array = np.asarray(values, dtype=np.float64)
    if array.ndim != 2 or 0 in array.shape:
        raise ValueError(
            f"{name} must be a non-empty matrix with one row per step, but the shape is "
            f"{array.shape}."
        )
    if not np.isfinite(array).all():
        row = int(np.argmin(np.isfinite(array).all(axis=1)))
        raise ValueError(
            f"{name} must be finite, but row {row} has NaN or infinity; the episode diverged, so "
            "excite less."
        )
    return array


def _numerical_rank(singular_values: Array, rows: int, columns: int) -> int:
    threshold = max(rows, columns) * np.finfo(np.float64).eps * singular_values[0]
    return int(np.count_nonzero(singular_values > threshold))


def _unique_signs(columns: Array) -> Array:
    largest = np.argmax(np.abs(columns), axis=0)
    signs = np.where(columns[largest, np.arange(columns.shape[1])] < 0.0, -1.0, 1.0)
    return columns * signs
