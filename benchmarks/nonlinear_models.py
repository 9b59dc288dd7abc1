# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Nonlinear reduced models by libraries of others, and LQ tracking on them, for `benchmarks.methods`.

A model is a map x_{k+1} = f(x_k, a_k) of x = S^-1 U'(z - z_r): the first modes U of the deviations from
the target, in units S of their root mean squares.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from benchmarks.estimators import Experiment
from pde_sim_node.plant import Plant
from pdeloop.episode import Law
from pdeloop.messages.arrays import Array
from pdeloop.messages.cost import Cost
from pdeloop.method.design.lqt import output_law
from pdeloop.method.reduce.reduced_model import leading_modes

Step = Callable[[Array, Array], Array]
"""States (N, n_s) and actions (N, n_a) -> the next states (N, n_s)."""
Fit = Callable[[Sequence[tuple[Array, Array]]], Step]
"""Fits a model to trajectories of states (T + 1, n_s) and actions (T, n_a)."""
STEP = 1e-3
"""Of central differences, which are exact for models of degree two."""


def inferred(operators: str, regularizer: float, data: Sequence[tuple[Array, Array]]) -> Step:
    """Operator inference: least squares of the `operators` c, A, H(x, x), B, with Tikhonov's term.

    Peherstorfer, Willcox, "Data-driven operator inference for nonintrusive projection-based model
    reduction", CMAME 306, 2016; opinf.
    """
    from opinf import errors, models

    model = models.DiscreteModel(operators, solver=regularizer)
    now, then = (np.vstack([x[own] for x, _ in data]) for own in (slice(-1), slice(1, None)))
    with warnings.catch_warnings():  # of fewer data than unknowns, which the regularisation is for
        warnings.simplefilter("ignore", errors.OpInfWarning)
        model.fit(now.T, then.T, np.vstack([a for _, a in data]).T)
    return lambda x, a: np.stack([model.rhs(*row) for row in zip(x, a, strict=True)])


def sparse(degree: int, threshold: float, data: Sequence[tuple[Array, Array]]) -> Step:
    """SINDy with control: polynomials of states and actions, thresholded least squares.

    Brunton, Proctor, Kutz, "Sparse identification of nonlinear dynamics with control (SINDYc)",
    IFAC-PapersOnLine 49(18), 2016; pysindy.
    """
    import pysindy

    model = pysindy.DiscreteSINDy(
        optimizer=pysindy.STLSQ(threshold=threshold, alpha=1e-3),
        feature_library=pysindy.PolynomialLibrary(degree=degree),
    )
    states, actions = [x for x, _ in data], [np.vstack([a, a[-1:]]) for _, a in data]
    with warnings.catch_warnings():  # of coefficients that all fall below the threshold
        warnings.simplefilter("ignore", UserWarning)
        model.fit(states, t=1.0, u=actions)
    return lambda x, a: np.asarray(model.predict(x, a))


def linearised(step: Step, n_s: int, n_a: int) -> tuple[Array, Array, Array]:
    """A, B and d of x_{k+1} = A x + B a + d, the model at x = 0 and a = 0.

    Examples
    --------
    >>> A, B, d = linearised(lambda x, a: 0.5 * x + x**2 + 3.0 * a + 1.0, 1, 1)
    >>> (A.round(9), B.round(9), d.round(9))
    (array([[0.5]]), array([[3.]]), array([1.]))
    """
    moved = STEP * np.eye(n_s + n_a)
    ends = [step(p[:, :n_s], p[:, n_s:]) for p in (moved, -moved)]
    J = ((ends[0] - ends[1]) / (2.0 * STEP)).T
    return J[:, :n_s], J[:, n_s:], step(np.zeros((1, n_s)), np.zeros((1, n_a)))[0]


def tracking(plant: Plant, values: Mapping[str, Any], data: Sequence[Experiment], fit: Fit) -> Law:
    """LQ tracking on the linearisation of a model at the target; no control where none stabilises."""
    order = values["reduced_order"]
    errors = [each.states - plant.target for each in data]
    U, _ = leading_modes(np.vstack([e[1:] for e in errors]), order)
    S = np.sqrt(np.mean(np.square(np.vstack(errors) @ U), axis=0))
    pairs = [(e @ U / S, each.actions) for e, each in zip(errors, data, strict=True)]
    A, B, d = linearised(fit(pairs), order, plant.n_a)
    weights = {name: values[name] for name in ("state_weight", "action_weight")}
    K, b = output_law(A, B, U * S, Cost(len(U), plant.n_a, 1, **weights), d, or_no_control=True)

    def law(k: int, states: Array) -> Array:
        actions: Array = ((states - plant.target) @ U / S) @ K.T + b
        return actions

    return law
