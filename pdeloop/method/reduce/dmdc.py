# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A reduced linear model of the plant (`reduced_model`) by DMD with control (DMDc).

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

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike
from scipy import linalg

from pdeloop.messages.arrays import Array
from pdeloop.method.reduce.channels import NUMBERED, Channels, cut_off
from pdeloop.method.reduce.identifiability import NotIdentifiableError, examine_steps
from pdeloop.method.reduce.reduced_model import (
    ReducedModel,
    Steps,
    leading_modes,
    numerical_rank,
    steps_of,
)
from pdeloop.process.one_thread import one_thread

LOST, SHRUNK = 0.01, 0.1
"""Shares of a move of an input alone that p directions keep: with less it is refused, or remarked
upon."""


def truncated_dmdc(
    trajectories: Sequence[tuple[ArrayLike, ArrayLike]],
    *,
    p: int,
    n_s: int,
    channels: Channels = NUMBERED,
) -> ReducedModel:
    """Identify a reduced model from trajectories of one plant, whose steps are pooled.

    Parameters
    ----------
    trajectories : sequence of (states (N + 1, n_z), actions (N, n_a))
        z_0 .. z_N and a_0 .. a_{N-1}; a_k is held from z_k to z_{k+1}.
    p : int
        Directions of [Z; Y] that are kept, n_s <= p <= min(n_z + n_a, N). Too small loses the
        effect of the actuators; too large fits noise.
    n_s : int
        Modes of the reduced state.
    channels : Channels
        Names of states and inputs in error messages.

    Raises
    ------
    ValueError
        Shapes that do not fit, NaN or infinity, more directions asked for than the trajectories
        hold, or inputs whose effects cannot be told apart.
    """
    data = steps_of(trajectories)
    steps, n_a = data.inputs.shape
    n_z = data.before.shape[1]
    check_sizes(p, n_s, n_z=n_z, n_a=n_a, steps=steps)

    # One thread: a threaded LAPACK rounds differently for another number of threads.
    with one_thread():
        basis, _ = leading_modes(data.after, n_s, channels)
        examine_steps(data, basis, channels).require()
        return fit(data, basis, p, channels)


def fit(data: Steps, U: Array, p: int, channels: Channels = NUMBERED) -> ReducedModel:
    """`truncated_dmdc` on given modes U (n_z, n_s). Call it with one LAPACK thread."""
    n_z, (steps, n_a) = len(U), data.inputs.shape
    stacked = np.vstack([data.before.T, data.inputs.T])
    psi, xi, lam_t = linalg.svd(stacked, full_matrices=False)
    rank = numerical_rank(xi, n_z + n_a, steps)
    if p > rank:
        raise ValueError(
            f"p must be at most the numerical rank of the data, {rank}, but p is {p}; lower p "
            "or excite more."
        )
    kept = _kept(psi, data.inputs.shape[1], p)
    if (lost := np.flatnonzero(kept < LOST)).size:
        names = [channels.input(j) for j in lost.tolist()]
        raise NotIdentifiableError(cut_off(names, kept[lost].tolist(), p))
    regression = (U.T @ data.after.T) @ (lam_t[:p].T / xi[:p])
    return ReducedModel(A=regression @ (psi[:n_z, :p].T @ U), B=regression @ psi[n_z:, :p].T, U=U)


def truncation_remarks(
    trajectories: Sequence[tuple[ArrayLike, ArrayLike]], p: int, channels: Channels = NUMBERED
) -> list[str]:
    """Name the inputs that p directions of [Z; Y] hardly keep."""
    data = steps_of(trajectories)
    with one_thread():
        stacked = np.vstack([data.before.T, data.inputs.T])
        psi, _, _ = linalg.svd(stacked, full_matrices=False)
    kept = _kept(psi, data.inputs.shape[1], p)
    shrunk = np.flatnonzero(kept < SHRUNK)
    names = [channels.input(j) for j in shrunk.tolist()]
    return [cut_off(names, kept[shrunk].tolist(), p)] if names else []


def _kept(psi: Array, n_a: int, p: int) -> Array:
    """The share of a move of each input alone, in [Z; Y], that the p directions have; in the norm."""
    return np.asarray(linalg.norm(psi[-n_a:, :p], axis=1))


def check_sizes(p: int, n_s: int, *, n_z: int, n_a: int, steps: int) -> None:
    """ValueError if this many steps cannot hold p directions, or p directions not n_s modes."""
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
