# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A reduced linear model of the plant, and what every way to identify one begins with.

    z_{k+1} = f(z_k, a_k)    is approximated on s = U^T z by    s_{k+1} = A s_k + B a_k + d

Trajectories of the plant give the columns of Z = [z_0 .. z_{N-1}], Z' = [z_1 .. z_N] and
Y = [a_0 .. a_{N-1}]; U holds the leading left singular vectors of Z'.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from hashlib import sha256
from io import BytesIO
from itertools import pairwise
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import linalg

from pdeloop.messages.array_files import read_arrays
from pdeloop.messages.arrays import Array, float_array
from pdeloop.messages.files import write_atomically
from pdeloop.method.reduce.channels import NUMBERED, Channels, scaled, state_faults
from pdeloop.method.settings import Settings, setting

T = TypeVar("T")
Trajectory = tuple[Array, Array]
"""States (N + 1, n_z) and actions (N, n_a)."""
ORTHONORMAL = 1e-9
"""Largest difference of U^T U to the identity with which U counts as orthonormal."""
INDEPENDENT = 1e-10
"""Least singular value of independent columns of norm 1."""
SAME_TIME = 1e-6
"""Relative tolerance between two sampling times."""


@dataclass(frozen=True, kw_only=True)
class IdentificationSettings(Settings):
    """Constants of the reduced model and of the first law.

    All are dimensionless: errors are relative to the data.
    """

    order_folds: int = setting(
        4, "number of groups of pieces of an exploratory episode, each held out once", 2, 1000
    )
    order_share: float = setting(
        0.8,
        "share of the best order's reduction of the one-step error, on a logarithmic scale, that "
        "the suggested order reaches",
        0.0,
        1.0,
    )
    field_error: float = setting(
        0.05, "largest error of a model that a first law is designed from", 0.0, 1.0
    )
    noise_evidence: float = setting(
        2.0,
        "standard errors by which the residuals must show measurement noise before a filter is "
        "designed for it",
        0.0,
        100.0,
    )


DEFAULTS = IdentificationSettings()


@dataclass(frozen=True, eq=False)
class ReducedModel:
    """A linear model of the plant: s_{k+1} = A s_k + B a_k + d, z_k = U s_k, y_k = C s_k.

    Where the columns of U are not orthonormal, U = Q T with Q orthonormal: the model is kept in the
    coordinates T s, so that U becomes Q, A becomes T A T^-1, B and d become T B and T d, and C becomes
    C T^-1. A model that is projected obliquely, s = W^T z with z = V s, is given with U = V.

    Attributes
    ----------
    A : (n_s, n_s) array
        One step of the state without inputs. A read-only copy, as are the others.
    B : (n_s, n_a) array
        Input matrix; the inputs are held during the step.
    U : (n_z, n_s) array
        Orthonormal basis of the plant's state, so that s = U^T z. By default that of C if its columns
        are independent, with z = y, and otherwise the identity, with z = s.
    d : (n_s,) array
        Drift, the constant term about an operating point; 0 by default.
    C : (n_y, n_s) array or None
        Of the outputs y; None: all of z is measured.

    Raises
    ------
    ValueError
        Names the array whose kind, shape or values do not fit, such as complex numbers, or columns of U
        that depend on each other.

    Examples
    --------
    A mode that is measured in another unit, z = 10 s:

    >>> model = ReducedModel([[0.9]], [[1.0]], U=[[10.0]])
    >>> np.abs(model.U), np.abs(model.B), model.poles.real
    (array([[1.]]), array([[10.]]), array([0.9]))
    >>> states, outputs = model.simulate([0.0], [[1.0], [0.0]])
    >>> states.ravel().round(12)
    array([ 0., 10.,  9.])
    """

    A: Array
    B: Array
    U: Array = None  # type: ignore[assignment]  # an array from __post_init__ on
    d: Array = None  # type: ignore[assignment]
    C: Array | None = None

    def __post_init__(self) -> None:
        A, B = _real("A", self.A), _real("B", self.B)
        n_s = len(A)
        if A.shape != (n_s, n_s):
            raise ValueError(f"A of a reduced model must be square, but its shape is {A.shape}.")
        if len(B) != n_s:
            raise ValueError(
                f"a reduced model with A of shape {A.shape} needs B with {n_s} rows, but its shape is "
                f"{B.shape}."
            )
        C, U = (None if own is None else _real(n, own) for n, own in (("C", self.C), ("U", self.U)))
        for name, array in (("U", U), ("C", C)):
            if array is not None and array.shape[1] != n_s:
                raise ValueError(
                    f"a reduced model with A of shape {A.shape} needs {name} with {n_s} columns, but "
                    f"{name} is {array.shape}."
                )
        if U is None:
            U = C if C is not None and _independent(C) else np.eye(n_s)
        if not _independent(U):
            raise ValueError(
                f"the columns of U of a reduced model must be independent, but those of its {U.shape} "
                "are not: leave out modes that are combinations of others."
            )
        d = np.zeros(n_s) if self.d is None else float_array("d of a reduced model", self.d)
        if d.shape != (n_s,) or not np.isfinite(d).all():
            raise ValueError(
                f"d of a reduced model must be {n_s} finite numbers, one for each row of A, got shape "
                f"{d.shape}{'' if np.isfinite(d).all() else ' with NaN or infinity'}."
            )
        if np.abs(U.T @ U - np.eye(n_s)).max() > ORTHONORMAL:
            U, T = linalg.qr(U, mode="economic")
            signs = np.where(np.diag(T) < 0.0, -1.0, 1.0)  # U with columns near 1 keeps their signs
            U, T = U * signs, signs[:, None] * T
            into = linalg.solve_triangular(T.T, np.eye(n_s), lower=True).T
            A, B, d = T @ A @ into, T @ B, T @ d
            C = None if C is None else C @ into
        for name, array in (("A", A), ("B", B), ("U", U), ("d", d), ("C", C)):
            if array is not None:
                array = np.array(array, dtype=np.float64, order="C")
                array.flags.writeable = False
            object.__setattr__(self, name, array)

    @classmethod
    def of(cls, system: Any, sample_time: float | None = None) -> ReducedModel:
        """The model of a state-space system of python-control, SciPy, or with the same attributes.

        Parameters
        ----------
        system
            With A, B, C, D and `dt`, like `control.ss(A, B, C, 0, dt)` or `scipy.signal.StateSpace`;
            its outputs are y = C s, and D must be 0.
        sample_time
            Seconds of a step. A system in continuous time is sampled with inputs that are held; that of
            a system in discrete time must agree. Without it, the system must be in discrete time.

        Returns
        -------
        ReducedModel

        Raises
        ------
        ValueError
            The system has D, another sampling time, or none where one is needed.
        """
        if isinstance(system, cls):
            return system
        if missing := [name for name in "AB" if not hasattr(system, name)]:
            raise ValueError(
                f"model is {system!r}; expected a ReducedModel, a state-space system, or a file"
                + f" (it has no {missing[0]})" * (len(missing) == 1)
            )
        if not hasattr(system, "D"):  # a model of a run or of another program
            return cls(
                system.A, system.B, system.U if hasattr(system, "U") else np.eye(len(system.A))
            )
        A, B, C, D = (
            float_array(f"{name} of the system", getattr(system, name)) for name in "ABCD"
        )
        if D.any():
            raise ValueError(
                "D of the system is not 0; expected outputs y = C s without the inputs"
            )
        dt = getattr(system, "dt", None)
        if dt is None and hasattr(system, "isctime"):
            raise ValueError(
                "dt of the system is None, which does not say whether it is in continuous time: make "
                "it 0, or the sampling time"
            )
        if dt is None or (dt == 0 and dt is not False):
            if sample_time is None:
                raise ValueError("the system is in continuous time: give the sample_time of a step")
            whole = linalg.expm(
                sample_time * np.block([[A, B], [np.zeros((B.shape[1], len(A) + B.shape[1]))]])
            )
            A, B = whole[: len(A), : len(A)], whole[: len(A), len(A) :]
        elif sample_time is not None and dt is not True and abs(dt / sample_time - 1.0) > SAME_TIME:
            raise ValueError(
                f"the system has a sampling time of {dt:g} s; expected {sample_time:g} s"
            )
        return cls(A, B, C=C)

    @classmethod
    def load(cls, path: str | Path) -> ReducedModel:
        """The model in a .npz file with the arrays A and B, and U, d and C if it has them.

        Parameters
        ----------
        path
            Written by `save`, by `pdeloop identify --out`, or by `numpy.savez`.

        Returns
        -------
        ReducedModel

        Raises
        ------
        ValueError
            The file cannot be read, or its arrays are not those of a model.
        """
        arrays = read_arrays(Path(path))
        if missing := [name for name in ("A", "B") if name not in arrays]:
            raise ValueError(
                f"{path} has no array {' and no '.join(missing)}; expected A and B, and U, d and C "
                f"where a model has them, got {', '.join(arrays) or 'none'}"
            )
        try:
            return cls(**{name: arrays[name] for name in "ABUdC" if name in arrays})
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from error

    def save(self, path: str | Path) -> None:
        """Write A, B, U, d, and C if it has one, as .npz, which `pdeloop train --model` takes.

        Parameters
        ----------
        path
            Where; an existing file is replaced.

        Raises
        ------
        ValueError
            It cannot be written.
        """
        content = BytesIO()
        arrays = {name: getattr(self, name) for name in "ABUdC"}
        np.savez(content, **{name: array for name, array in arrays.items() if array is not None})
        try:
            write_atomically(Path(path), content.getvalue())
        except OSError as error:
            raise ValueError(f"cannot write {path}: {error.strerror}") from error

    def simulate(self, start: ArrayLike, actions: ArrayLike) -> tuple[Array, Array]:
        """The model's states and outputs under given actions.

        Parameters
        ----------
        start : (n_z,)
            z_0, of which U U^T z_0 is simulated.
        actions : (N, n_a)
            a_0 .. a_{N-1}.

        Returns
        -------
        states : (N + 1, n_z) array
            z_0 .. z_N.
        outputs : (N + 1, n_y) array
            y_0 .. y_N; the states if the model has no C.

        Raises
        ------
        ValueError
            Shapes that do not fit.
        """
        z, a = float_array("start", start), float_array("actions", actions)
        if z.shape != (self.n_z,) or a.ndim != 2 or a.shape[1] != self.n_a:
            raise ValueError(
                f"expected start of shape ({self.n_z},) and actions (N, {self.n_a}), got {z.shape} and "
                f"{a.shape}"
            )
        s = np.empty((len(a) + 1, self.n_s))
        s[0] = self.U.T @ z
        for k in range(len(a)):
            s[k + 1] = self.A @ s[k] + self.B @ a[k] + self.d
        states = s @ self.U.T
        return states, states if self.C is None else s @ self.C.T

    def __repr__(self) -> str:
        drift, outputs = (
            ", d" * bool(self.d.any()),
            "" if self.C is None else f", C of {len(self.C)}",
        )
        return (
            f"ReducedModel(order {self.n_s}: A, B with {self.n_a} inputs, U with {self.n_z} rows"
            f"{drift}{outputs})"
        )

    @property
    def poles(self) -> NDArray[np.complex128]:
        """The eigenvalues of A, (n_s,)."""
        found: NDArray[np.complex128] = np.linalg.eigvals(self.A).astype(np.complex128)
        return found

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


def _real(name: str, values: ArrayLike) -> Array:
    """A matrix of finite real numbers."""
    if np.ma.is_masked(values):
        raise ValueError(f"{name} of a reduced model has masked values; expected finite numbers.")
    array = float_array(f"{name} of a reduced model", values)
    if array.ndim != 2 or 0 in array.shape:
        raise ValueError(
            f"{name} of a reduced model must be a non-empty matrix, but its shape is {array.shape}."
        )
    if not np.isfinite(array).all():
        raise ValueError(f"{name} of a reduced model must be finite, but it has NaN or infinity.")
    return array


def _independent(columns: Array) -> bool:
    """Whether no column is a combination of the others, whatever their units."""
    unit = scaled(columns)[0]
    return unit.shape[0] >= unit.shape[1] and bool(linalg.svdvals(unit)[-1] > INDEPENDENT)


@dataclass(frozen=True, eq=False)
class Samples:
    """Steps of the plant: z_k, a_k, z_{k+1}, a row each, (N, n_z), (N, n_a), (N, n_z)."""

    before: Array
    actions: Array
    after: Array

    def __len__(self) -> int:
        return len(self.before)

    def thinned(self, most: int) -> Samples:
        """At most this many of them, equally spaced."""
        some = slice(None, None, max(-(-len(self) // most), 1))
        return Samples(self.before[some], self.actions[some], self.after[some])

    def weights(self) -> Array:
        """1 / max(|Δz|, mean |Δz|): a step counts relative to how much changes in it.

        Where the field rests, what is left is the error of the model's integration, which would
        otherwise outweigh everything; so less than the mean change counts as the mean.
        """
        change = np.linalg.norm(self.after - self.before, axis=1)
        size = np.maximum(change, change.mean())
        weights: Array = 1.0 / np.where(size > 0.0, size, 1.0)
        return weights


def operating_inputs(trajectories: Sequence[tuple[ArrayLike, ArrayLike]]) -> Array:
    """The operating point of the inputs, (n_a,): 0, or the mean of one that kept its sign."""
    a = np.concatenate([np.asarray(a, np.float64) for _, a in trajectories])
    return np.where((a.min(axis=0) <= 0.0) & (a.max(axis=0) >= 0.0), 0.0, a.mean(axis=0))


def steps_of(trajectories: Sequence[tuple[ArrayLike, ArrayLike]]) -> Samples:
    """The steps of trajectories of one plant; a duplicated one counts once.

    ValueError for shapes that do not fit, NaN and infinity.
    """
    befores, taken, afters = [], [], []
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
    for z, own in distinct(checked):
        if z.shape[0] != len(own) + 1:
            raise ValueError(
                f"{len(own)} actions belong to {len(own) + 1} states, but {z.shape[0]} states were "
                "given; pass the states from before the first action to after the last."
            )
        befores.append(z[:-1])
        afters.append(z[1:])
        taken.append(own)
    return Samples(*(np.concatenate(parts) for parts in (befores, taken, afters)))


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


def distinct(trajectories: Sequence[tuple[ArrayLike, ArrayLike]]) -> list[Trajectory]:
    """Trajectories as arrays, without copies of earlier ones."""
    copies = repeated(trajectories)
    return [
        (np.asarray(z, np.float64), np.asarray(a, np.float64))
        for number, (z, a) in enumerate(trajectories)
        if number not in copies
    ]


def pieces(trajectories: Sequence[Trajectory], count: int) -> list[Trajectory]:
    """Every trajectory cut into this many pieces of similar length; neighbours share a state."""
    cut = []
    for states, actions in trajectories:
        edges = np.unique(np.linspace(0, len(actions), count + 1).astype(int))
        cut += [(states[a : b + 1], actions[a:b]) for a, b in pairwise(edges)]
    return cut


def turns(parts: Sequence[T], folds: int) -> Iterator[tuple[list[T], list[T]]]:
    """Parts to fit to and others that are held out, so that each is held out once; neither is empty."""
    for fold in range(folds):
        others = [part for i, part in enumerate(parts) if i % folds != fold]
        if others and len(parts) > fold:
            yield others, list(parts[fold::folds])


def leading_modes(after: Array, n_s: int, channels: Channels = NUMBERED) -> tuple[Array, Array]:
    """The first n_s left singular vectors of Z', that is of after^T (n_z, N), and all singular values.

    ValueError if the states have fewer modes; it names the channels that are the reason. Call it with
    one LAPACK thread.
    """
    left, values, _ = linalg.svd(after.T, full_matrices=False)
    rank = numerical_rank(values, *after.shape)
    if n_s > rank:
        reasons = state_faults(after, channels)
        raise ValueError(
            f"n_s must be at most the numerical rank of the states, {rank}, but n_s is {n_s}"
            f"{': ' if reasons else ''}{', '.join(reasons)}; lower n_s or excite more."
        )
    columns = left[:, :n_s]
    largest = columns[np.argmax(np.abs(columns), axis=0), np.arange(n_s)]
    return columns * np.where(largest < 0.0, -1.0, 1.0), values


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
