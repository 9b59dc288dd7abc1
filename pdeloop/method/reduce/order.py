# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The order n_s that the data support: errors of models on held-out steps.

Every trajectory is cut into pieces; in each of four folds every fourth piece is held out, and the
others give U, A and B (see `pdeloop.method.reduce.regression`). The errors of the model on a held-out
piece z_0 .. z_N are

    one step    z_{k+1} - U (A U^T z_k + B a_k)
    rollout     z_{k+1} - U s_{k+1},    s_{k+1} = A s_k + B a_k,    s_0 = U^T z_0,

so they include the part outside the modes. An error is the root of the sum of squares over all
held-out steps, relative to that of z_{k+1} - z_k for one step and z_{k+1} - z_0 for the rollout: 1 is
as good as a model in which nothing changes.

References
----------
Ljung, "System Identification: Theory for the User", 2nd ed., chapter 16 (cross-validation).
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from numbers import Integral

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import linalg

from pdeloop.messages.arrays import Array
from pdeloop.method.reduce.channels import NUMBERED, Channels, scaled
from pdeloop.method.reduce.identifiability import examine_steps
from pdeloop.method.reduce.reduced_model import (
    DEFAULTS,
    IdentificationSettings,
    ReducedModel,
    Steps,
    Trajectory,
    distinct,
    leading_modes,
    numerical_rank,
    pieces,
    steps_of,
    turns,
)
from pdeloop.method.reduce.regression import fit, needs_constant
from pdeloop.process.one_thread import one_thread

_ORDER_PIECES = 8
"""Number of pieces of an exploratory episode from which an order is suggested."""

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
    fitted_by: Callable[[Steps, Array], ReducedModel] | None = None,
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
        `order_pieces`, `order_folds` and `order_share`.
    fitted_by : callable, optional
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
        if len(everything.inputs) > 1 and singular_values[0] > 0.0:
            examine_steps(everything, leading_modes(everything.after, 1)[0], channels).require()
        if constant is None:
            constant = needs_constant(known, max((n for n in tried if n <= MOST), default=1))
        by = fitted_by or (lambda data, U: fit(data, U, constant))
        for fitted, held in turns(pieces(known, _ORDER_PIECES), settings.order_folds):
            data = steps_of(fitted)
            modes, values, _ = linalg.svd(data.after.T, full_matrices=False)
            most = min(numerical_rank(values, *data.after.shape), _determined(data, modes))
            if most < 1:  # an input that moved in the held-out steps only, for one
                continue
            tried = [n for n in tried if n <= most]
            errors.append([_held_out(by, data, modes[:, :n], held) for n in tried])
            scales += _summed(_squares(z[1:] - z[:-1], z[1:] - z[0]) for z, _ in held)
    if not (tried and errors):
        raise ValueError(
            f"the {len(everything.inputs)} steps with {everything.inputs.shape[1]} inputs are too few, "
            "or vary too little, to hold some of them out; record a longer trajectory"
        )
    total = _summed(np.array(fold[: len(tried)]) for fold in errors)
    with np.errstate(divide="ignore", invalid="ignore"):
        one_step, rollout = np.sqrt(np.nan_to_num(total / scales, nan=np.inf)).T
    digits = -np.log10(np.clip(one_step, ROUNDING, 1.0 / ROUNDING))
    enough = digits[0] + settings.order_share * (digits.max() - digits[0])
    suggested = tried[int(np.argmax(digits >= enough))]
    return OrderStudy(singular_values, np.array(tried), one_step, rollout, suggested)


def _held_out(
    by: Callable[[Steps, Array], ReducedModel], data: Steps, U: Array, held: Sequence[Trajectory]
) -> Array:
    """Sums of squared errors of a model on held-out pieces; infinite where there is none."""
    try:
        model = by(data, U)
    except ValueError:
        return np.full(2, np.inf)
    return _summed(_errors(model, *piece) for piece in held)


def _determined(data: Steps, modes: Array) -> int:
    """The highest order whose regressors, on the leading modes (n_z, n), are independent here."""
    steps, n_a = data.inputs.shape
    columns, _ = scaled(np.hstack([data.inputs, data.before @ modes])[:, :steps])
    heights = np.abs(np.diag(linalg.qr(columns, mode="r")[0]))
    lost = np.flatnonzero(heights <= steps * np.finfo(np.float64).eps)
    most: int = (lost[0] if lost.size else heights.size) - n_a
    return most


def _errors(model: ReducedModel, states: Array, actions: Array) -> Array:
    """Sums of squared errors on one piece: of one step, and rolled out."""
    A, B, U = model.A, model.B, model.U
    inputs = actions @ B.T + model.d
    rolled = np.empty((len(states), model.n_s))
    rolled[0] = states[0] @ U
    with np.errstate(over="ignore", invalid="ignore"):
        for k, forced in enumerate(inputs):
            rolled[k + 1] = A @ rolled[k] + forced
        once = states[:-1] @ U @ A.T + inputs
        return _squares(states[1:] - once @ U.T, states[1:] - rolled[1:] @ U.T)


def _squares(*residuals: Array) -> Array:
    return np.array([np.sum(residual**2) for residual in residuals])


def _summed(parts: Iterable[Array]) -> Array:
    total: Array = np.sum(list(parts), axis=0)
    return total
