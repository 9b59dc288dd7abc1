# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A reduced linear model of the plant, and what every way to identify one begins with.

    z_{k+1} = f(z_k, a_k)    is approximated on s = U^T z by    s_{k+1} = A s_k + B a_k

Trajectories of the plant give the columns of Z = [z_0 .. z_{N-1}], Z' = [z_1 .. z_N] and
Y = [a_0 .. a_{N-1}]; U holds the leading left singular vectors of Z'.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from hashlib import sha256
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike
from scipy import linalg

from loop_interfaces.arrays import Array, float_array
from loop_method.reduce.channels import NUMBERED, Channels, state_faults

Trajectory = tuple[Array, Array]
"""States (N + 1, n_z) and actions (N, n_a)."""


@dataclass(frozen=True, eq=False)
class ReducedModel:
    """The linear model s_{k+1} = A s_k + B a_k of the projected state s = U^T z.

    Attributes
    ----------
    A : (n_s, n_s) array
        A read-only copy, as are the others.
    B : (n_s, n_a) array
        Input matrix.
    U : (n_z, n_s) array
        Orthonormal columns; the largest entry of each column is positive, so that U is unique.

    Raises
    ------
    ValueError
        Names the array whose shape or values do not fit.
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

    def __repr__(self) -> str:
        return (
            f"ReducedModel(order {self.n_s}: A, B with {self.n_a} inputs, U with {self.n_z} rows)"
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


@dataclass(frozen=True, eq=False)
class Steps:
    """The steps of one or more trajectories, a row each.

    before, after (N, n_z): z_k and z_{k+1}, the transposes of Z and Z'; inputs (N, n_a): a_k, that
    of Y.
    """

    before: Array
    after: Array
    inputs: Array


def steps_of(trajectories: Sequence[tuple[ArrayLike, ArrayLike]]) -> Steps:
    """The steps of trajectories (states (N + 1, n_z), actions (N, n_a)) of one plant, pooled.

    A duplicated trajectory counts once. ValueError for shapes that do not fit, NaN and
    infinity.
    """
    befores, afters, inputs = [], [], []
    if (
        not isinstance(trajectories, Sequence)
        or not trajectories
        or any(not isinstance(t, Sequence) or len(t) != 2 for t in trajectories)
    ):
        raise ValueError("expected a list of trajectories, each a tuple (states, actions)")
    checked = [(_matrix("states", z), _matrix("actions", a)) for z, a in trajectories]
    if len(sizes := sorted({(z.shape[1], own.shape[1]) for z, own in checked})) > 1:
        raise ValueError(
            "expected trajectories of one plant, got states and actions of "
            f"{' and of '.join(f'{n_z} and {n_a}' for n_z, n_a in sizes[:4])} numbers."
        )
    copies = repeated(checked)
    for z, own in [pair for number, pair in enumerate(checked) if number not in copies]:
        if z.shape[0] != len(own) + 1:
            raise ValueError(
                f"{len(own)} actions belong to {len(own) + 1} states, but {z.shape[0]} states were "
                "given; pass the states from before the first action to after the last."
            )
        befores.append(z[:-1])
        afters.append(z[1:])
        inputs.append(own)
    return Steps(*(np.concatenate(parts) for parts in (befores, afters, inputs)))


def repeated(trajectories: Sequence[tuple[ArrayLike, ArrayLike]]) -> dict[int, int]:
    """Trajectories that are copies of earlier ones, with the number of the original."""
    first: dict[bytes, int] = {}
    found = {}
    for number, trajectory in enumerate(trajectories):
        content = sha256()
        for values in trajectory:
            array = np.ascontiguousarray(values)
            content.update(repr((array.shape, array.dtype)).encode())
            content.update(array.data)
        if (earlier := first.setdefault(content.digest(), number)) != number:
            found[number] = earlier
    return found


def pieces(trajectories: Sequence[Trajectory], count: int) -> list[Trajectory]:
    """Every trajectory cut into this many pieces of similar length; neighbours share a state."""
    cut = []
    for states, actions in trajectories:
        edges = np.unique(np.linspace(0, len(actions), count + 1).astype(int))
        cut += [(states[a : b + 1], actions[a:b]) for a, b in pairwise(edges)]
    return cut


def leading_modes(after: Array, n_s: int, channels: Channels = NUMBERED) -> tuple[Array, Array]:
    """The first n_s left singular vectors of Z', (n_z, n_s), and all its singular values.

    after : (N, n_z) array
        The transpose of Z'.

    ValueError if the states have fewer modes than that; it names the channels that are the reason.
    Call it with one LAPACK thread.
    """
    left, values, _ = linalg.svd(after.T, full_matrices=False)
    rank = numerical_rank(values, *after.shape)
    if n_s > rank:
        reasons = state_faults(after, channels)
        raise ValueError(
            f"n_s must be at most the numerical rank of the states, {rank}, but n_s is {n_s}"
            f"{': ' if reasons else ''}{', '.join(reasons)}; lower n_s or excite more."
        )
    return _unique_signs(left[:, :n_s]), values


def _matrix(name: str, values: ArrayLike) -> Array:
    array = float_array(name, values)
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


def numerical_rank(singular_values: Array, rows: int, columns: int) -> int:
    """Number of singular values of a matrix above the rounding errors of the largest."""
    threshold = max(rows, columns) * np.finfo(np.float64).eps * singular_values[0]
    return int(np.count_nonzero(singular_values > threshold))


def _unique_signs(columns: Array) -> Array:
    largest = np.argmax(np.abs(columns), axis=0)
    signs = np.where(columns[largest, np.arange(columns.shape[1])] < 0.0, -1.0, 1.0)
    return columns * signs
