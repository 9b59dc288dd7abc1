# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Minimise a mean stage cost with exact gradients until it falls no further: L-BFGS.

Source: Liu & Nocedal, Mathematical Programming 45 (1989); Nocedal & Wright, Numerical Optimization,
section 7.2.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.optimize import Bounds, minimize

from pdeloop.messages.action_set import ANY_ACTION, ActionSet
from pdeloop.messages.arrays import Array

__all__ = ["Descent", "descend"]

MEMORY = 40
"""Pairs that L-BFGS remembers."""
WINDOW = 20
"""Iterations over which the fall is judged."""


@dataclass(frozen=True)
class Descent:
    """The end point of a descent, and its progress until then.

    x: the argument; cost; iterations; gradient_norm: |x| |dJ/dx|/J at the end; last_fall: of the last
    WINDOW iterations, relative to the cost; converged: whether that, or the gradient norm's square,
    is below the tolerance (else the iterations were used up).
    """

    x: Array
    cost: float
    iterations: int
    gradient_norm: float
    last_fall: float
    converged: bool


def descend(
    function: Callable[[Array], tuple[float, Array]],
    x: Array,
    *,
    tolerance: float,
    iterations: int = 1000,
    action_set: ActionSet = ANY_ACTION,
) -> Descent:
    """Minimise function(x) = (J, dJ/dx) from x on.

    Parameters
    ----------
    function
        Gives J and its gradient, of the shape of x.
    x
        Where to begin.
    tolerance
        Converged when J falls by less than this share of it in WINDOW iterations.
    iterations
        At most.
    action_set
        Whose bounds the numbers of x, (..., n_a), have.

    Raises
    ------
    ValueError
        J is not finite at the start. Elsewhere, where a rollout diverges, it may be infinite: the
        line search then turns back.
    """
    first, _ = function(x)
    if not np.isfinite(first):
        raise ValueError("a descent must begin where the cost is finite, but a rollout diverges")
    costs = [first]

    def bounded(flat: Array) -> tuple[float, Array]:
        cost, gradient = function(flat.reshape(x.shape))
        if not np.isfinite(cost):
            return 10 * first, np.zeros_like(flat)
        return cost, gradient.ravel()

    def fall() -> float:
        return 1 - costs[-1] / costs[max(0, len(costs) - 1 - WINDOW)]

    def after(intermediate_result: object) -> None:
        costs.append(float(intermediate_result.fun))  # type: ignore[attr-defined]
        if len(costs) > WINDOW and fall() < tolerance:
            raise StopIteration

    low, high = (np.broadcast_to(b, x.shape) for b in (action_set.low, action_set.high))
    options = {"maxiter": iterations, "maxfun": 10 * iterations, "maxcor": MEMORY}
    end = minimize(
        bounded,
        x.ravel(),
        jac=True,
        method="L-BFGS-B",
        bounds=Bounds(low.ravel(), high.ravel()) if action_set.bounded else None,
        callback=after,
        options={**options, "ftol": 0.0, "gtol": 0.0},
    )
    _, gradient = bounded(end.x)
    if action_set.bounded:  # what points out of the bounds is nothing that is left to fall
        outward = np.where(gradient > 0.0, end.x <= low.ravel(), end.x >= high.ravel())
        gradient = np.where(outward, 0.0, gradient)
    norm = float(np.linalg.norm(end.x) * np.linalg.norm(gradient) / end.fun)
    # A descent that comes to the bottom fast ends before its window is full of small falls. What is
    # left to fall is of second order in the gradient.
    flat = norm**2 < tolerance
    return Descent(
        x=end.x.reshape(x.shape),
        cost=float(end.fun),
        iterations=len(costs) - 1,
        gradient_norm=norm,
        last_fall=float(fall()),
        converged=bool(len(costs) > WINDOW and fall() < tolerance) or flat,
    )
