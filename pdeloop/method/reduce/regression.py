# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A reduced linear model of the plant by least squares in reduced coordinates, and its order.

With U the first n_s left singular vectors of Z' = [z_1 .. z_N], Z = [z_0 .. z_{N-1}] and
Y = [a_0 .. a_{N-1}] (one column per step),

    [A B d] = argmin || U^T Z' - A U^T Z - B Y - d 1^T ||_F^2,

with d = 0 unless a constant term predicts all held-out parts of the data better; a log has one
(`has_offset`) whatever the data say: without it a pole that they hardly tell from 1 is at 1.

The paper's method is DMD with control (DMDc): with the p-truncated SVD [Z; Y] ~ Psi Xi Lambda^T,

    A = U^T Z' Lambda Xi^{-1} Psi_Z^T U,        B = U^T Z' Lambda Xi^{-1} Psi_Y^T,

where Psi_Z are the first n_z rows of Psi and Psi_Y its last n_a; with p < n_s + n_a it cuts into the
inputs, which the regression keeps whole.

Errors by which orders are compared (`study_orders`) are, on pieces of trajectories that were held out,

    one step    z_{k+1} - U (A U^T z_k + B a_k)
    rollout     z_{k+1} - U s_{k+1},    s_{k+1} = A s_k + B a_k,    s_0 = U^T z_0,

the root of the sum of squares relative to that of z_{k+1} - z_k and of z_{k+1} - z_0: 1 is as good as a
model in which nothing changes.

References
----------
Proctor, Brunton, Kutz, "Dynamic Mode Decomposition with Control", SIAM J. Appl. Dyn. Syst. 15(1),
2016 (DMDc). Zhang, Mowlavi, Benosman, Basar, arXiv:2403.01005.
Peherstorfer, Willcox, "Data-driven operator inference for nonintrusive projection-based model
reduction", CMAME 306, 2016 (least squares on projected states).
Ljung, "System Identification: Theory for the User", 2nd ed., chapter 16 (cross-validation).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from numbers import Integral

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import linalg

from pdeloop.messages.arrays import Array
from pdeloop.messages.model_rows import ModelRows
from pdeloop.method.reduce.channels import NUMBERED, Channels, cut_off, scaled
from pdeloop.method.reduce.identifiability import NotIdentifiableError, examine_steps
from pdeloop.method.reduce.reduced_model import (
    DEFAULTS,
    IdentificationSettings,
    ReducedModel,
    Samples,
    Trajectory,
    distinct,
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
STILL = 1e-8
"""Variation of a mode, relative to its size, that is rounding."""
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

    trajectories: (states (N + 1, n_z), actions (N, n_a)) each, a_k held from z_k to z_{k+1}; n_s:
    modes; channels: names in error messages; constant: whether there is a constant term, None: as
    `needs_constant` says. ValueError for shapes that do not fit, NaN or infinity, fewer steps than the
    n_s + n_a unknowns in a row of [A B], more modes than the states have, or inputs whose effects
    cannot be told apart.
    """
    data = steps_of(trajectories)
    steps, n_a = data.actions.shape
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
            len(data.actions) - len(held.actions[0]) - 2,
        )
        if n < 1:
            return False
        without, with_it = (
            float(np.sum(residuals(fit(data, U[:, :n], constant), held) ** 2))
            for constant in (False, True)
        )
        rounding = ROUNDED * float(np.sum(held.after**2))
        if not (with_it < LOWER * without and without > rounding):
            return False
    return True


def has_offset(trajectories: Sequence[tuple[ArrayLike, ArrayLike]]) -> bool:
    """False if the constant term of all steps together is rounding, or they leave no room for one."""
    data = steps_of(trajectories)
    steps, n_a = data.actions.shape
    with one_thread():
        U, values, _ = linalg.svd(data.after.T, full_matrices=False)
        n = min(numerical_rank(values, *data.after.shape), steps - n_a - 1)
        d = fit(data, U[:, : max(n, 1)], constant=True).d
    return bool(n > 0 and steps * d @ d > NEGLIGIBLE * np.sum(data.after**2))


def residuals(model: ReducedModel | ModelRows, data: Samples) -> Array:
    """s_{k+1} - A s_k - B a_k - d of single steps in reduced coordinates, a row each."""
    s, after = data.before @ model.U, data.after @ model.U
    found: Array = after - s @ model.A.T - data.actions @ model.B.T
    return found if model.d is None else found - model.d


def fit(data: Samples, U: Array, constant: bool = False) -> ReducedModel:
    """`exact_regression` on given modes U (n_z, n_s), unchecked. Call it with one LAPACK thread."""
    s, y, n_s = data.before @ U, data.actions, U.shape[1]
    if constant:
        # About the means, which is the same and loses no digits to a large offset.
        before, after, inputs = (part.mean(axis=0) for part in (data.before, data.after, y))
        own = (data.before - before) @ U
        _, sizes, modes = linalg.svd(own, full_matrices=False)
        modes = modes[sizes > STILL * linalg.norm(s @ modes.T, axis=0)]
        own = own if len(modes) == n_s else own @ modes.T @ modes  # the rest is the constant
        steps = Samples(own, y - inputs, (data.after - after) @ U)
        centred = fit(steps, np.eye(n_s))
        d = after @ U - centred.A @ (before @ U) - centred.B @ inputs
        return ReducedModel(centred.A, centred.B, U, d)
    # The modes keep their proportions, in which small ones are small; inputs have none to each other.
    units = np.concatenate([np.full(n_s, float(linalg.norm(s))), scaled(y)[1]])
    units[units == 0.0] = 1.0
    coefficients: Array = linalg.lstsq(np.hstack([s, y]) / units, data.after @ U)[0]
    coefficients /= units[:, None]
    return ReducedModel(A=coefficients[:n_s].T, B=coefficients[n_s:].T, U=U)


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
    """Identify a reduced model by the paper's method; parameters and errors as for `exact_regression`.

    p: directions of [Z; Y] that are kept, n_s <= p <= min(n_z + n_a, N); ValueError for more than the
    trajectories hold. Too small loses the effect of the actuators; too large fits noise.
    """
    data = steps_of(trajectories)
    steps, n_a = data.actions.shape
    n_z = data.before.shape[1]
    check_truncated_sizes(p, n_s, n_z=n_z, n_a=n_a, steps=steps)

    # One thread: a threaded LAPACK rounds differently for another number of threads.
    with one_thread():
        basis, _ = leading_modes(data.after, n_s, channels)
        examine_steps(data, basis, channels).require()
        return truncated_fit(data, basis, p, channels)


def truncated_fit(data: Samples, U: Array, p: int, channels: Channels = NUMBERED) -> ReducedModel:
    """`truncated_dmdc` on given modes U (n_z, n_s). Call it with one LAPACK thread."""
    n_z, (steps, n_a) = len(U), data.actions.shape
    stacked = np.vstack([data.before.T, data.actions.T])
    psi, xi, lam_t = linalg.svd(stacked, full_matrices=False)
    rank = numerical_rank(xi, n_z + n_a, steps)
    if p > rank:
        raise ValueError(
            f"p must be at most the numerical rank of the data, {rank}, but p is {p}; lower p "
            "or excite more."
        )
    kept = _kept(psi, data.actions.shape[1], p)
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
        stacked = np.vstack([data.before.T, data.actions.T])
        psi, _, _ = linalg.svd(stacked, full_matrices=False)
    kept = _kept(psi, data.actions.shape[1], p)
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


ORDERS = (1, 2, 3, 4, 5, 6, 8, 10, 12, 16, 20, 24, 28, 32, 40, 48, 64)
MOST = 8
"""The highest order by which it is decided whether models have a constant term."""
ROUNDING = 1e-9
"""Smaller errors are equal."""


@dataclass(frozen=True, eq=False)
class OrderStudy:
    """Errors of reduced models by their order, and the suggested order.

    Attributes
    ----------
    singular_values : (min(N, n_z),) array
        Singular values of Z' = [z_1 .. z_N], with all trajectories together.
    orders : (K,) int array
        The orders n_s that were tried, ascending.
    one_step, rollout : (K,) arrays
        Relative errors on held-out data; infinity where a rollout overflows.
    suggested : int
        The lowest order that reaches a share (`IdentificationSettings.order_share`) of what the
        best one gains, in digits of the one-step error. With noise the error falls less, so lower
        orders are suggested.
    """

    singular_values: Array
    orders: NDArray[np.int64]
    one_step: Array
    rollout: Array
    suggested: int

    def __repr__(self) -> str:
        tried = f"{self.orders.min()} to {self.orders.max()}"
        return f"OrderStudy(order {self.suggested} suggested of {tried})"

    def rows(self) -> list[dict[str, float]]:
        """The study as a table.

        Returns
        -------
        list of dict
            For each order: `order`, `singular_value` relative to the largest, and the relative errors
            `one_step_error` and `rollout_error`.
        """
        relative = self.singular_values[self.orders - 1] / self.singular_values[0]
        columns = (self.orders, relative, self.one_step, self.rollout)
        names = ("order", "singular_value", "one_step_error", "rollout_error")
        return [
            dict(zip(names, (value.item() for value in row), strict=True))
            for row in zip(*columns, strict=True)
        ]

    def text(self) -> str:
        """The study as a table to be printed.

        Returns
        -------
        str
            A line of names, one for each order, and a note; the suggested order is marked.
        """
        lines = ["  order  singular value  one-step error  rollout error"]
        for row in self.rows():
            order, *numbers = row.values()
            mark = "  suggested" if order == self.suggested else ""
            lines.append("  {:>5}  {:>14.2e}  {:>14.3g}  {:>13.3g}".format(order, *numbers) + mark)
        note = "  errors on held-out steps, relative to a model in which nothing changes"
        return "\n".join([*lines, note])


def study_orders(
    trajectories: Sequence[tuple[ArrayLike, ArrayLike]],
    orders: Iterable[int] = ORDERS,
    *,
    channels: Channels = NUMBERED,
    settings: IdentificationSettings = DEFAULTS,
    fitted_by: Callable[[Samples, Array], ReducedModel] | None = None,
    constant: bool | None = None,
) -> OrderStudy:
    """Try orders of a reduced model on held-out parts of trajectories of one plant.

    Parameters
    ----------
    trajectories : sequence of (states (N + 1, n_z), actions (N, n_a))
        z_0 .. z_N and a_0 .. a_{N-1}; a_k is held from z_k to z_{k+1}.
        A duplicated trajectory counts once.
    orders : iterable of int
        Candidates; those that the data do not determine without the held-out steps are dropped
        (at least n_s + n_a steps must remain).
    channels : Channels
        Names of states and inputs in error messages.
    settings : IdentificationSettings
        `order_folds` and `order_share`.
    fitted_by : callable (steps, U (n_z, n)) -> model, optional
        The model of steps on modes U (n_z, n), in place of the regression.
    constant : bool, optional
        Whether the models of the regression have a constant term; None: as `needs_constant` says.

    Returns
    -------
    OrderStudy

    Raises
    ------
    ValueError
        Shapes that do not fit, NaN or infinity, inputs whose effects cannot be separated, or too few
        steps for any of the orders.

    Examples
    --------
    A plant of two states, of which three numbers are measured:

    >>> rng = np.random.default_rng(0)
    >>> A, C = np.array([[0.9, 0.3], [-0.3, 0.9]]), rng.normal(size=(3, 2))
    >>> a, s = rng.normal(size=(60, 1)), np.zeros((61, 2))
    >>> for k in range(60):
    ...     s[k + 1] = A @ s[k] + a[k]
    >>> study = study_orders([(s @ C.T, a)])
    >>> study.orders, study.suggested
    (array([1, 2]), 2)
    """
    everything = steps_of(trajectories)
    known = distinct(trajectories)
    asked = list(orders)
    if wrong := [order for order in asked if not isinstance(order, Integral)]:
        raise ValueError(f"orders holds {wrong[0]!r}; expected whole numbers")
    tried = sorted({n for n in asked if n >= 1})
    errors, scales = [], np.zeros(2)
    with one_thread():  # as in the identification itself
        singular_values: Array = linalg.svdvals(everything.after)
        if len(everything) > 1 and singular_values[0] > 0.0:
            examine_steps(everything, leading_modes(everything.after, 1)[0], channels).require()
        if constant is None:
            constant = needs_constant(known, max((n for n in tried if n <= MOST), default=1))
        by = fitted_by or (lambda data, U: fit(data, U, constant))
        for fitted, held in turns(pieces(known, 2 * FOLDS), settings.order_folds):
            data = steps_of(fitted)
            modes, values, _ = linalg.svd(data.after.T, full_matrices=False)
            most = min(numerical_rank(values, *data.after.shape), _determined(data, modes))
            if most < 1:  # an input that moved in the held-out steps only, for one
                continue
            tried = [n for n in tried if n <= most]
            errors.append([_held_out(by, data, modes[:, :n], held) for n in tried])
            scales += np.sum([_squares(z[1:] - z[:-1], z[1:] - z[0]) for z, _ in held], axis=0)
    if not (tried and errors):
        raise ValueError(
            f"the {len(everything)} steps with {everything.actions.shape[1]} inputs are too few, or "
            "vary too little, to hold some of them out; record a longer trajectory"
        )
    total = np.sum([fold[: len(tried)] for fold in errors], axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        one_step, rollout = np.sqrt(np.nan_to_num(total / scales, nan=np.inf)).T
    digits = -np.log10(np.clip(one_step, ROUNDING, 1.0 / ROUNDING))
    enough = digits[0] + settings.order_share * (digits.max() - digits[0])
    suggested = tried[int(np.argmax(digits >= enough))]
    return OrderStudy(singular_values, np.array(tried), one_step, rollout, suggested)


def _held_out(
    by: Callable[[Samples, Array], ReducedModel],
    data: Samples,
    U: Array,
    held: Sequence[Trajectory],
) -> Array:
    """Sums of squared errors on held-out pieces: of one step, and rolled out; infinite: no model."""
    try:
        model = by(data, U)
    except ValueError:
        return np.full(2, np.inf)
    total, (A, U) = np.zeros(2), (model.A, model.U)
    for states, actions in held:
        with np.errstate(over="ignore", invalid="ignore"):
            rolled, _ = model.simulate(states[0], actions)
            once = states[:-1] @ U @ A.T + actions @ model.B.T + model.d
            total += _squares(states[1:] - once @ U.T, states[1:] - rolled[1:])
    return total


def _determined(data: Samples, modes: Array) -> int:
    """The highest order whose regressors, on the leading modes (n_z, n), are independent here."""
    steps, n_a = data.actions.shape
    columns, _ = scaled(np.hstack([data.actions, data.before @ modes])[:, :steps])
    heights = np.abs(np.diag(linalg.qr(columns, mode="r")[0]))
    lost = np.flatnonzero(heights <= steps * np.finfo(np.float64).eps)
    most: int = (lost[0] if lost.size else heights.size) - n_a
    return most


def _squares(*residuals: Array) -> Array:
    return np.array([np.sum(residual**2) for residual in residuals])
