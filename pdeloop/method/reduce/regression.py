# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A reduced linear model of the plant by least squares in reduced coordinates.

With U the first n_s left singular vectors of Z' = [z_1 .. z_N], Z = [z_0 .. z_{N-1}] and
Y = [a_0 .. a_{N-1}] (one column per step),

    [A B d] = argmin || U^T Z' - A U^T Z - B Y - d 1^T ||_F^2,

with d = 0 unless a constant term predicts all held-out parts of the data better. The zero of a log in
degrees and per cent is not the plant's rest, so it has one (`has_offset`) whatever the data say:
without it a pole that they hardly tell from 1 is at 1.

Data that do not determine it are refused (`pdeloop.method.reduce.identifiability`). States are
projected and inputs are kept whole, so that there is no second rank to choose and nothing depends on
the unit of the inputs.

The paper's method is DMD with control (DMDc): with the p-truncated SVD [Z; Y] ~ Psi Xi Lambda^T,

    A = U^T Z' Lambda Xi^{-1} Psi_Z^T U,        B = U^T Z' Lambda Xi^{-1} Psi_Y^T,

where Psi_Z are the first n_z rows of Psi and Psi_Y its last n_a. It is the same where the states have
no more than n_s modes and p keeps everything; with p < n_s + n_a it cuts into the inputs.

References
----------
Proctor, Brunton, Kutz, "Dynamic Mode Decomposition with Control", SIAM J. Appl. Dyn. Syst. 15(1),
2016 (DMDc).
Zhang, Mowlavi, Benosman, Basar, "Policy Optimization for PDE Control with a Warm Start",
arXiv:2403.01005.
Peherstorfer, Willcox, "Data-driven operator inference for nonintrusive projection-based model
reduction", CMAME 306, 2016 (least squares on projected states).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike
from scipy import linalg

from pdeloop.messages.arrays import Array
from pdeloop.method.reduce.channels import NUMBERED, Channels, cut_off, scaled
from pdeloop.method.reduce.identifiability import NotIdentifiableError, examine_steps
from pdeloop.method.reduce.reduced_model import (
    ReducedModel,
    Steps,
    leading_modes,
    numerical_rank,
    pieces,
    steps_of,
    turns,
)
from pdeloop.process.one_thread import one_thread

FOLDS = 4
"""Parts of the data that are held out one after the other."""
ROUNDED = 1e-24
"""Squared error, relative to the squared states, that is rounding."""
NEGLIGIBLE = 1e-20
"""Squared constant term, relative to the mean square of the states, that is rounding."""
LOWER = 0.995
"""Squared error with a constant term, relative to that without, below which it is needed."""


def exact_regression(
    trajectories: Sequence[tuple[ArrayLike, ArrayLike]],
    *,
    n_s: int,
    channels: Channels = NUMBERED,
    constant: bool | None = None,
) -> ReducedModel:
    """Identify a reduced model from trajectories of one plant, whose steps are pooled.

    Parameters
    ----------
    trajectories : sequence of (states (N + 1, n_z), actions (N, n_a))
        z_0 .. z_N and a_0 .. a_{N-1}; a_k is held from z_k to z_{k+1}.
    n_s : int
        Modes of the reduced state. All steps together must be at least n_s + n_a, as many as there are
        unknowns in a row of [A B].
    channels : Channels
        Names of states and inputs in error messages.
    constant : bool, optional
        Whether the model has a constant term; None: as `needs_constant` says.

    Returns
    -------
    ReducedModel
        With U from all z_1 .. z_N.

    Raises
    ------
    ValueError
        Shapes that do not fit, NaN or infinity, fewer steps than unknowns, more modes than the
        states have, or inputs whose effects cannot be told apart.

    Examples
    --------
    A plant z_{k+1} = 0.9 z_k + 2 a_k is found again:

    >>> a = np.array([[1.0], [-1.0], [0.5], [2.0]])
    >>> z = [np.array([1.0])]
    >>> for a_k in a:
    ...     z.append(0.9 * z[-1] + 2.0 * a_k)
    >>> model = exact_regression([(z, a)], n_s=1)
    >>> model.A.round(12), model.B.round(12)
    (array([[0.9]]), array([[2.]]))
    """
    data = steps_of(trajectories)
    steps, n_a = data.inputs.shape
    check_sizes(n_s, n_a, steps)
    # One thread: a threaded LAPACK rounds differently for another number of threads.
    with one_thread():
        U, _ = leading_modes(data.after, n_s, channels)
        examine_steps(data, U, channels).require()
        if constant is None:
            constant = needs_constant(trajectories, n_s)
        return fit(data, U, constant)


def check_sizes(n_s: int, n_a: int, steps: int) -> None:
    """ValueError if this many steps cannot determine a model of this order."""
    if n_s < 1:
        raise ValueError(f"n_s must be at least 1, but it is {n_s}.")
    if steps < n_s + n_a:
        raise ValueError(
            f"a model of n_s = {n_s} modes and n_a = {n_a} inputs needs at least {n_s + n_a} steps, "
            f"but there are {steps}; take more steps (a longer horizon), or a lower n_s where that is "
            "enough."
        )


def needs_constant(trajectories: Sequence[tuple[ArrayLike, ArrayLike]], n_s: int) -> bool:
    """True if a constant term lowers the one-step errors of each of four held-out parts of the data.

    By more than half a per cent, as chance may do it by one over the number of steps. Call it with one
    LAPACK thread.
    """
    known = [(np.asarray(z, np.float64), np.asarray(a, np.float64)) for z, a in trajectories]
    cut = list(turns(pieces(known, 2 * FOLDS), FOLDS))
    if len(cut) < FOLDS:
        return False
    for others, own in cut:
        data, held = steps_of(others), steps_of(own)
        U, values, _ = linalg.svd(data.after.T, full_matrices=False)
        n = min(
            n_s,
            numerical_rank(values, *data.after.shape),
            len(data.inputs) - len(held.inputs[0]) - 2,
        )
        if n < 1:
            return False
        without, with_it = (
            float(np.sum(_missed(fit(data, U[:, :n], constant), held) ** 2))
            for constant in (False, True)
        )
        rounding = ROUNDED * float(np.sum(held.after**2))
        if not (with_it < LOWER * without and without > rounding):
            return False
    return True


def has_offset(trajectories: Sequence[tuple[ArrayLike, ArrayLike]]) -> bool:
    """False if the constant term of all steps together is rounding, or they leave no room for one."""
    data = steps_of(trajectories)
    steps, n_a = data.inputs.shape
    with one_thread():
        U, values, _ = linalg.svd(data.after.T, full_matrices=False)
        n = min(numerical_rank(values, *data.after.shape), steps - n_a - 1)
        d = fit(data, U[:, : max(n, 1)], constant=True).d
    return bool(n > 0 and steps * d @ d > NEGLIGIBLE * np.sum(data.after**2))


def _missed(model: ReducedModel, data: Steps) -> Array:
    """Residuals of single steps in reduced coordinates."""
    once = data.before @ model.U @ model.A.T + data.inputs @ model.B.T + model.d
    return data.after @ model.U - once


def fit(data: Steps, U: Array, constant: bool = False) -> ReducedModel:
    """`exact_regression` on given modes U (n_z, n_s), unchecked. Call it with one LAPACK thread."""
    s, y = data.before @ U, data.inputs
    n_s = s.shape[1]
    if constant:
        # About the means, which is the same and loses no digits to a large offset.
        means = data.before.mean(axis=0), data.after.mean(axis=0), y.mean(axis=0)
        own = (part - mean for part, mean in zip((data.before, data.after, y), means, strict=True))
        centred = fit(Steps(*own), U)
        d = means[1] @ U - centred.A @ (means[0] @ U) - centred.B @ means[2]
        return ReducedModel(centred.A, centred.B, U, d)
    # The modes keep their proportions, in which small ones are small; inputs have none to each other.
    units = np.concatenate([np.full(n_s, _norm(s)), scaled(y)[1]])
    units[units == 0.0] = 1.0
    coefficients: Array = linalg.lstsq(np.hstack([s, y]) / units, data.after @ U)[0]
    coefficients /= units[:, None]
    return ReducedModel(A=coefficients[:n_s].T, B=coefficients[n_s:].T, U=U)


def _norm(values: Array) -> float:
    return float(linalg.norm(values))


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
    check_truncated_sizes(p, n_s, n_z=n_z, n_a=n_a, steps=steps)

    # One thread: a threaded LAPACK rounds differently for another number of threads.
    with one_thread():
        basis, _ = leading_modes(data.after, n_s, channels)
        examine_steps(data, basis, channels).require()
        return truncated_fit(data, basis, p, channels)


def truncated_fit(data: Steps, U: Array, p: int, channels: Channels = NUMBERED) -> ReducedModel:
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


def check_truncated_sizes(p: int, n_s: int, *, n_z: int, n_a: int, steps: int) -> None:
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
