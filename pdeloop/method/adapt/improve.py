# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Improvement of a law on a model of the whole field.

L-BFGS on the weighted cost over initial fields, in the coordinates

    x = G^{1/2} theta F^{1/2},        G = R + B^T P B,        F = mean [s; 1][s; 1]^T,

with P of the linear-quadratic problem at the target: of a linear plant the cost has the Hessian 2 I
there, so that few steps suffice and none of them depends on the units of actions and states.

References
----------
Nocedal, Wright, "Numerical Optimization", 2nd ed., algorithm 7.5 (L-BFGS). Byrd, Lu, Nocedal, Zhu, SIAM
J. Sci. Comput. 16, 1995 (the implementation).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import linalg

from pdeloop.messages.arrays import Array
from pdeloop.method.adapt.closed_loop import ClosedLoop
from pdeloop.method.settings import Settings, setting

FIRST_GAIN = 2e-2
"""`least_gain` before the last renewal."""
_MEMORY = 40
"""Gradient differences that L-BFGS keeps."""
_WINDOW = 5
"""L-BFGS steps that together must reach `least_gain`."""
_ISOTROPY = 1e-3
"""Share of the identity in the second moment of [s; 1] that scales the gains."""
_HALVINGS = 12
"""Maximum number of halvings of a law until the model's fields are finite."""

FAR = 10.0
"""The cost of a law without a finite one, per cost of the law to begin with."""


@dataclass(frozen=True, kw_only=True)
class ModelBasedSettings(Settings):
    """The constants of `model_based`.

    All are dimensionless: costs and gains are scaled by those of the initial law.
    """

    judging: int = setting(3, "rollouts of the final law on fresh fields", 1, 100)
    believed: float = setting(
        0.05,
        "largest E at which a model is used; above it, laws are steps along rollouts",
        0.0,
        1.0,
    )
    mixtures: int = setting(
        24, "most initial fields that are drawn; half as many before the final law", 0, 1000
    )
    most_mixtures: int = setting(
        96, "the same for a final law that fields left out do not confirm", 0, 1000
    )
    iterations: int = setting(100, "maximum number of L-BFGS steps per improvement", 1, 10_000)
    least_gain: float = setting(
        1e-3, "relative gain in a window of steps with which a descent continues", 0.0, 1.0
    )
    confidence: float = setting(
        1.0, "standard errors, if exact, by which a law must beat the first one", 0.0, 10.0
    )
    enough_fields: int = setting(
        48, "number of measured fields at which improvements stop", 2, 1_000_000
    )
    filter_unpredicted: float = setting(
        0.04,
        "share of a field's size that a filter adds to a reading's noise, 1 to 6 times",
        0.0,
        1.0,
    )
    filter_margin: float = setting(
        0.03, "share of the cost that a filter may add by trusting the equation less", 0.0, 1.0
    )


@dataclass(frozen=True, eq=False)
class Improvement:
    """A law, and its weighted cost on the fields where the law to begin with has a finite one.

    steps: of L-BFGS.
    """

    theta: Array
    before: float
    after: float
    steps: int


def improve(
    loop: ClosedLoop,
    theta: Array,
    fields: Array,
    weights: Array,
    curvature: Array,
    settings: ModelBasedSettings,
    least_gain: float | None = None,
    trust: float = 0.0,
) -> Improvement | None:
    """The law after a descent, or None where no law to begin with is finite on the model.

    theta is halved where it is not finite from any field (F, n_z), and single such fields are left out;
    curvature: G; trust: weight of the added cost |x - x_0|^2: for a linear plant the step is
    1/(1 + trust) of the whole one.
    """
    for _ in range(_HALVINGS + 1):
        simulation = loop.simulate(theta, fields)
        finite = np.isfinite(simulation.costs) & (weights > 0.0)
        if finite.any():
            break
        theta = 0.5 * theta
    else:
        return None
    fields, weights = fields[finite], weights[finite] / weights[finite].sum()
    moment = loop.moment(simulation.of_fields(finite), weights)
    count = len(moment) - loop.constants
    size = float(np.trace(moment[:count, :count])) / count
    if not (size > 0.0 and np.isfinite(moment).all()):
        return None
    # s and the constants each in its own unit.
    units = np.append(np.full(count, size), np.full(loop.constants, 1.0 / loop.constants))
    moment[np.diag_indices(len(moment))] += _ISOTROPY * units
    left, right = (_inverse_root(matrix) for matrix in (curvature, moment))
    gain = settings.least_gain if least_gain is None else least_gain
    # Not at the top: a node that never improves a law has no need of it.
    from scipy.optimize import minimize

    before, by_theta = loop.gradient(theta, fields, weights)
    # Of a quadratic cost the step -g/2 leads to its minimum. L-BFGS begins with one of unit length.
    unit = 0.5 * float(np.linalg.norm((left.T @ by_theta @ right).ravel()))
    if not (unit > 0.0 and np.isfinite(unit) and before > 0.0):
        return Improvement(theta, before, before, 0)
    best, values = Improvement(theta, before, before, 0), [1.0]
    least, held = before, trust * unit**2

    def objective(y: Array) -> tuple[float, Array]:
        nonlocal best, least
        at, cost, gradient = theta, before, by_theta  # the descent starts from known values
        if y.any():
            at = theta + left @ (unit * y).reshape(len(left), -1) @ right.T
            cost, gradient = loop.gradient(at, fields, weights)
        if not (cost < FAR * before and np.isfinite(gradient).all()):
            return FAR, np.zeros_like(y)
        total = cost + held * float(y @ y)
        if total < least:
            least, best = total, Improvement(at, before, cost, best.steps)
        slope = unit * (left.T @ gradient @ right).ravel() + 2.0 * held * y
        return total / before, slope / before

    def stop_when_flat(_: Array) -> None:
        values.append(least / before)
        earlier = values[max(len(values) - 1 - _WINDOW, 0)]
        few = len(values) <= _WINDOW
        if not few and earlier - values[-1] <= gain * values[-1]:
            raise StopIteration

    minimize(
        objective,
        np.zeros(theta.size),
        jac=True,
        method="L-BFGS-B",
        callback=stop_when_flat,
        options={"maxiter": settings.iterations, "maxcor": _MEMORY, "ftol": 0.0, "gtol": 0.0},
    )
    return Improvement(best.theta, before, best.after, len(values) - 1)


def _inverse_root(matrix: Array) -> Array:
    """L^{-T} of a matrix L L^T."""
    root = linalg.cholesky(matrix, lower=True)
    inverse: Array = linalg.solve_triangular(root, np.eye(len(root)), lower=True).T
    return inverse


def cheapest(loop: ClosedLoop, laws: Sequence[Array], fields: Array, weights: Array) -> Array:
    """The law that is finite from most of the fields, and cheapest where all of those are."""
    if all(np.array_equal(law, laws[0]) for law in laws):
        return laws[0]
    return laws[index_of_cheapest(np.array([loop.costs(theta, fields) for theta in laws]), weights)]


def index_of_cheapest(costs: Array, weights: Array) -> int:
    """The row of costs (laws, F) that `cheapest` chooses, the first of several alike.

    >>> index_of_cheapest(np.array([[np.inf, np.inf], [np.inf, 9.0]]), np.ones(2))
    1
    >>> index_of_cheapest(np.array([[2.0, np.inf, 0.5], [np.inf, 9.0, 1.0]]), np.ones(3))
    0
    """
    lost = ~np.isfinite(costs) @ weights
    common = np.isfinite(costs[lost <= lost.min()]).all(axis=0)
    total = np.where(common, costs, 0.0) @ weights
    return int(np.lexsort((total, lost))[0])


def curvature_of(loop: ClosedLoop) -> Array:
    """R + B^T P B of the model linearised at the target; R where there is none."""
    R, lqr = loop.cost.action_matrix, loop.regulator
    if lqr is not None:
        found = R + lqr.B.T @ lqr.P[:-1, :-1] @ lqr.B
        found = 0.5 * (found + found.T)
        if np.linalg.eigvalsh(found)[0] > 0.0:
            return loop.curvature(found)
    return loop.curvature(R)
