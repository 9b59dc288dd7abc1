# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Whether trajectories determine a linear model, and which inputs they cannot separate.

The data determine the column of an input in B if it varied independently. So each input is regressed on

    1, the other inputs, s_k = U^T z_k, and the leading POD modes of z_k,

with every channel scaled to the norm 1. Its residual, relative to its own variation and per degree of
freedom, is its *independence*: about 1 for white noise, 0 for feedback without excitation. The 1
allows for drift of the plant, and the modes for feedback of the part of the state outside s.

References
----------
Ljung, "System Identification: Theory for the User", 2nd ed., chapter 13 (informative experiments,
closed loops). Belsley, Kuh, Welsch, "Regression Diagnostics", chapter 3 (collinearity).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike
from scipy import linalg

from pdeloop.messages.arrays import Array
from pdeloop.method.reduce import channels as words
from pdeloop.method.reduce.channels import NUMBERED, Channels, constant, scaled
from pdeloop.method.reduce.reduced_model import (
    Samples,
    Trajectory,
    numerical_rank,
    repeated,
    steps_of,
)
from pdeloop.process.one_thread import one_thread

DEPENDENT = 1e-5
"""An input of less independence cannot be told apart: a log of six digits holds no more."""
CLOSE = 0.05
"""An input of less independence calls for a warning: the standard errors of its column of B are twenty
times those of an independent input."""
ILL_CONDITIONED = 1e-3
"""Smallest singular value of the scaled regressors, relative to the largest, that calls for one."""
LEFT = 4
"""Degrees of freedom for each input that the POD modes leave to the residuals."""
RESOLVED = 1e-7
"""Relative size of a singular value that the square of a matrix still resolves."""
ROUNDED = 0.35
"""Root mean square of what rounding leaves, in steps: 0.29 for one that is uniform in a step."""
LEVELS = 10
"""Different values from which on an input counts as rounded; below it is switched."""


class NotIdentifiableError(ValueError):
    """The data do not determine the model; the text names what cannot be told apart."""


class IdentifiabilityWarning(UserWarning):
    """The data hardly determine the model."""


@dataclass(frozen=True, eq=False)
class Identifiability:
    """How well data determine the model to be identified from them.

    unknowns: in a row of [A B], n_s + n_a; rank, smallest_singular_value: of the scaled regressors, the
    latter relative to the largest, 0 if there are fewer steps than unknowns; independence (n_a,): of
    every input, from 0 to about 1; faults: why the data do not determine the model; remarks: what comes
    close to that, or is suspicious.
    """

    unknowns: int
    rank: int
    smallest_singular_value: float
    independence: Array
    faults: tuple[str, ...] = ()
    remarks: tuple[str, ...] = ()

    def require(self) -> None:
        """NotIdentifiableError if the data do not determine the model."""
        if self.faults:
            raise NotIdentifiableError("; ".join(self.faults))


def examine(
    trajectories: Sequence[tuple[ArrayLike, ArrayLike]], U: Array, channels: Channels = NUMBERED
) -> Identifiability:
    """Examine whether trajectories determine a model on modes U (n_z, n_s), copies and states included.

    channels: what the sentences call states and inputs.
    """
    data = steps_of(trajectories)
    with one_thread():  # as in the identification itself
        found = examine_steps(data, U, channels)
    remarks = list(found.remarks)
    if copies := repeated(trajectories):
        told = ", ".join(f"{i} repeats {first}" for i, first in list(copies.items())[: words.SHOWN])
        remarks.append(f"of the trajectories, {told}; each counts once")
    if suspicious := words.state_faults(data.after, channels):
        remarks.append(f"of the state, {'; '.join(suspicious)}: leave out what is not measured")
    return replace(found, remarks=tuple(remarks))


def examine_excitation(trajectory: Trajectory) -> Identifiability:
    """Examine whether an exploration separates the effects of its inputs, for a model of any order."""
    data = steps_of([trajectory])
    with one_thread():
        U = linalg.svd(data.after, full_matrices=False)[2][:1].T
        return examine_steps(data, U)


def examine_steps(data: Samples, U: Array, channels: Channels = NUMBERED) -> Identifiability:
    """Examine whether the steps determine a model on the modes U (n_z, n_s), with one LAPACK thread."""
    s, y = data.before @ U, data.actions
    values = linalg.svdvals(scaled(np.hstack([s, y]))[0])
    unknowns = s.shape[1] + y.shape[1]
    rank = numerical_rank(values, len(y), unknowns)
    smallest = float(values[-1] / values[0]) if rank == unknowns else 0.0
    independence, faults = _inputs(data, s, channels)
    remarks = []
    if not faults and rank < unknowns:
        faults = [
            f"the {len(y)} steps determine {rank} of the {unknowns} numbers in a row of [A B]: take a "
            "lower order, or add a log that begins from another state"
        ]
    elif not faults and (close := np.flatnonzero(independence < CLOSE)).size:
        names = [channels.input(int(j)) for j in close]
        remarks.append(words.hardly_independent(names, independence[close].tolist()))
    elif not faults and smallest < ILL_CONDITIONED:
        remarks.append(
            f"the steps hardly determine the model (the smallest singular value of the regressors is "
            f"{smallest:.1g} of the largest): take a lower order, or a longer log"
        )
    return Identifiability(unknowns, rank, smallest, independence, tuple(faults), tuple(remarks))


def _inputs(data: Samples, s: Array, channels: Channels) -> tuple[Array, list[str]]:
    """The independence of every input, and the sentences about inputs that have none."""
    y, (steps, n_a) = data.actions, data.actions.shape
    # Without a step for the constant it cannot be told from the others.
    drift = steps - 1 - s.shape[1] >= n_a
    offset = y.mean(axis=0) if drift else np.zeros(n_a)
    unit, sizes = scaled(y - offset)
    still = constant(y).tolist()
    faults = []
    if still:
        names = [channels.input(j) for j in still]
        faults.append(words.never_moved(names, [float(y[0, j]) for j in still]))
    own: list[int] = []
    """Inputs that are not combinations of those before them."""
    for j in range(n_a):
        if j in still:
            continue
        weights, left = explained(unit[:, own], unit[:, j])
        if not _rounding(left, y[:, j], sizes[j]):
            own.append(j)
            continue
        factors = {
            own[i]: float(weights[i] * sizes[j] / sizes[own[i]])
            for i in np.flatnonzero(np.abs(weights) > 1e-3)
        }
        rest = float(offset[j] - sum(factor * offset[i] for i, factor in factors.items()))
        named = {channels.input(i): factor for i, factor in factors.items()}
        constant_part = rest if abs(rest) > 1e-6 * np.abs(y[:, j]).max() else 0.0
        faults.append(words.moved_together(channels.input(j), named, constant_part))
    independence = np.zeros(n_a)
    if not own:
        return independence, faults
    basis = _state_basis(data.before, s, drift, len(own))
    left = unit[:, own] - basis @ (basis.T @ unit[:, own])
    left -= basis @ (basis.T @ left)  # again, as the first time leaves rounding errors
    left *= np.sqrt((steps - drift) / max(steps - drift - basis.shape[1], 1))
    fed: dict[int, None] = {}
    for place, j in enumerate(own):
        others = [i for i in range(len(own)) if i != place]
        weights, rest_of_it = explained(left[:, others], left[:, place])
        independence[j] = linalg.norm(rest_of_it)
        if _rounding(rest_of_it, y[:, j], sizes[j]):
            shares = np.abs(weights) * linalg.norm(left[:, others], axis=0)
            fed |= dict.fromkeys([j, *(own[others[i]] for i in np.flatnonzero(shares > 1e-3))])
    if fed:
        faults.append(words.followed_the_state([channels.input(j) for j in sorted(fed)]))
    return independence, faults


def explained(columns: Array, values: Array) -> tuple[Array, Array]:
    """Weights of the columns that explain other ones best, by least squares, and what is left."""
    if not columns.shape[1]:
        return np.empty(0), values
    weights = linalg.lstsq(columns, values)[0]
    return weights, values - columns @ weights


def _state_basis(z: Array, s: Array, drift: bool, n_a: int) -> Array:
    """Orthonormal columns that span s_k and leading modes of z_k, less their means if `drift`."""
    parts = [scaled(s - s.mean(axis=0) if drift else s)[0]]
    room = len(s) - drift - s.shape[1] - LEFT * n_a
    if room > 0:
        fields, _ = scaled(z - z.mean(axis=0) if drift else z)
        if fields.shape[1] > len(fields):  # the smaller square is enough, and much quicker
            squares, left = linalg.eigh(fields @ fields.T)
            modes = left[:, squares > RESOLVED**2 * squares[-1]][:, ::-1]
        else:
            left, values, _ = linalg.svd(fields, full_matrices=False)
            modes = left[:, : numerical_rank(values, *fields.shape)]
        parts.append(modes[:, :room])
    left, values, _ = linalg.svd(np.hstack(parts), full_matrices=False)
    return np.asarray(left[:, : numerical_rank(values, *left.shape)])


def _rounding(left: Array, channel: Array, size: float) -> bool:
    """True if the residual of a channel scaled by `size` is no more than its rounding."""
    norm = float(linalg.norm(left))
    return norm < DEPENDENT or norm * size <= ROUNDED * _step(channel) * np.sqrt(len(left))


def _step(channel: Array) -> float:
    """The step in which a channel was written; 0: there is none, or it is switched, not rounded."""
    levels = np.unique(channel)
    if len(levels) < LEVELS:
        return 0.0
    step = float(np.diff(levels).min())
    multiples = (levels - levels[0]) / step
    return step if np.abs(multiples - np.round(multiples)).max() < 1e-3 else 0.0
