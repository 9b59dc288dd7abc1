# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""What `pdeloop identify` says of a first law from a model of the whole field."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from scipy import linalg

from pdeloop.messages.arrays import Array
from pdeloop.process.one_thread import one_thread

if TYPE_CHECKING:
    from pdeloop.method.design.field_law import FieldLaw

EXCITED = 3e-3
"""Variation in a direction, relative to the largest, from which on the data say how it decays: ridges
are up to the square of that."""


def determined(field: FieldLaw, A: Array) -> Array:
    """What the data determine of a matrix of the whole state: S A P.

    S and P, S P = I: onto the directions in which the data move, and back. In others the ridge of a
    model decides whose coefficients no points share; of any other model all is determined.
    """
    # Not at the top: whoever reads logs alone has no need of models.
    from pdeloop.method.models.linear import LinearModel
    from pdeloop.method.models.polynomial import PolynomialModel
    from pdeloop.method.models.selection import scale_of

    fitted = field.fitted
    model = fitted.model if fitted else None
    if fitted is None or not isinstance(
        getattr(model, "inner", model), LinearModel | PolynomialModel
    ):
        return A
    states = [np.asarray(own.states) for own in fitted.rollouts]
    scale = scale_of(states)
    gram = sum(y.T @ y for y in ((own - scale.reference) / scale.units for own in states))
    with one_thread():
        squares, vectors = linalg.eigh(gram)
    W = vectors[:, squares > EXCITED**2 * squares[-1]]
    found: Array = (W.T / scale.units) @ A @ (W * scale.units[:, None])
    return found


def summary(field: FieldLaw) -> dict[str, Any]:
    """The report as data."""
    fitted = field.fitted
    return {
        "kind": fitted and fitted.model.kind,
        "error": fitted and fitted.error,
        "candidates": [list(pair) for pair in fitted.candidates] if fitted else [],
        "own_error": fitted and _number(fitted.own.simulated),
        "one_step_error": fitted and _number(fitted.own.one_step),
        "regression_error": _number(field.regression.simulated),
        "regression_one_step_error": _number(field.regression.one_step),
        "believed": field.rows is not None,
        "judges": list(field.judges),
        "linearised": field.remark,
        "noise": field.noise,
        "predicted_cost": _number(field.cost),
        "predicted_cost_of_regression": _number(field.other_cost),
        "doubtful": field.doubtful,
        "law": "field" if field.better else "regression",
    }


def text(field: FieldLaw) -> list[str]:
    """The report as text."""
    fitted = field.fitted
    if fitted is None:
        return ["no model of the whole field can be fitted: the law of the regression is used"]
    of = f" of {field.part} steps near the target" if field.part else ""
    lines = [
        f"model of the whole field: {fitted.model.kind}{of}, error {fitted.error:.2g} in "
        "predicting the data",
        f"  relative to what the data do, on parts held out: {fitted.own.simulated:.2g}, "
        f"regression {field.regression.simulated:.2g}; of single steps {fitted.own.one_step:.2g} "
        f"and {field.regression.one_step:.2g}",
        f"  tried: {', '.join(f'{kind} {error:.2g}' for kind, error in fitted.candidates)}",
    ]
    if field.remark:
        lines.append(f"  {field.remark}")
    if field.noise:
        return [
            *lines,
            f"  undeclared measurement noise of about {field.noise:.2g} was found: the law of "
            "the regression is used; declare it (measurement_noise) and explore again, as "
            "strongly as it requires",
        ]
    if field.rows is None:
        exact = "regression" in field.judges
        reason = "the regression is more accurate" if exact else "it is not accurate enough"
        return [*lines, f"  {reason}: the law of the regression is used"]
    taken = "its law is used" if field.better else "the law of the regression is used"
    costs = f"{_cost(field.cost)} for its law, {_cost(field.other_cost)} for that of the regression"
    several = len(field.judges) > 1
    by = f" by {' and '.join(field.judges)}, the worse one," if several else ""
    lines.append(f"  predicted mean stage cost{by} {costs}: {taken}")
    if field.doubtful:
        lines.append(
            "  what it saves against no control may be the model's error: a training begins from "
            "no control"
        )
    return lines


def _number(cost: float) -> float | None:
    return cost if np.isfinite(cost) else None


def _cost(cost: float) -> str:
    return f"{cost:.4g}" if np.isfinite(cost) else "unbounded"
