# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""SINDy with control, and nonlinear model predictive control on its model: the plainest rival.

With POD coordinates x of the scaled state and scaled actions u,

    x_{k+1} = Xi [1; x_k; u_k; products of two of [x_k; u_k]],

by sequentially thresholded least squares. The number of modes and the threshold are those of least
error in predicting pieces of the newest rollout, which the fit does not see. A plan of `STEPS` actions
within the bounds is improved at every step (`pdeloop.method.laws.plans`, from no affine law). Half of
the rollouts explore as a training does; the others are under the law, made anew after half of them.

References
----------
Brunton, Proctor, Kutz, "Sparse identification of nonlinear dynamics with control (SINDYc)", IFAC
PapersOnLine 49(18), 2016. Kaiser, Kutz, Brunton, "Sparse identification of nonlinear dynamics for model
predictive control in the low-data limit", Proc. R. Soc. A 474, 2018.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product

import numpy as np

import pdeloop
from pde_sim_node.plant import Plant
from pdeloop.episode import Law, rollout
from pdeloop.messages.arrays import Array
from pdeloop.method.laws.plans import Planner
from pdeloop.method.models.polynomial import PolynomialModel

STEPS = 20
"""Of a plan."""
ENERGIES, MOST = (1e-2, 1e-3, 1e-4), 12
"""Shares of the variance that modes leave out, and modes at most."""
THRESHOLDS = (0.0, 1e-3, 1e-2)
ITERATIONS = 10
"""Of the search at a step."""

Data = Sequence[tuple[Array, Array]]


def fitted(data: Data) -> PolynomialModel:
    """The model of rollouts, states (T + 1, n_z) and actions (T, n_a)."""
    rows = np.concatenate([states for states, _ in data])
    centre, scale = rows.mean(axis=0), rows.std(axis=0)
    scale = np.where(scale > 1e-9 * np.abs(centre), scale, 1.0)
    _, values, modes = np.linalg.svd((rows - centre) / scale, full_matrices=False)
    left_out = 1.0 - np.cumsum(values**2) / np.sum(values**2)
    counts = {min(int(np.sum(left_out > share)) + 1, MOST) for share in ENERGIES}

    def made(own: Data, count: int, threshold: float) -> PolynomialModel:
        return _regression(own, centre, scale, modes[:count].T, threshold)

    tried = list(product(sorted(counts), THRESHOLDS))
    found = [_error(made(data[:-1], *each), data[-1], scale) for each in tried]
    return made(data, *tried[int(np.argmin(found))])


def _regression(
    data: Data, centre: Array, scale: Array, V: Array, threshold: float
) -> PolynomialModel:
    import pysindy

    actions = np.concatenate([own for _, own in data])
    middle, size = actions.mean(axis=0), actions.std(axis=0)
    size = np.where(size > 0.0, size, 1.0)
    xs = [((states - centre) / scale) @ V for states, _ in data]
    us = [(own - middle) / size for _, own in data]
    found = pysindy.DiscreteSINDy(
        optimizer=pysindy.STLSQ(threshold=threshold, alpha=1e-6, max_iter=20),
        feature_library=pysindy.PolynomialLibrary(degree=2),
    )
    found.fit(xs, t=1, u=[np.vstack([own, own[-1:]]) for own in us])
    of, powers = found.coefficients(), found.feature_library.powers_
    total, places = powers.sum(axis=1), np.arange(powers.shape[1])
    pairs = np.array([np.repeat(places, row) for row in powers[total == 2]], dtype=np.int64)
    linear = of[:, total == 1][:, np.argsort(powers[total == 1].argmax(axis=1))]
    linear[:, : len(of)] -= np.eye(len(of))  # of what changes in a step
    changes = np.hstack([of[:, total == 0], linear, of[:, total == 2]])
    coefficients = np.ascontiguousarray((scale[:, None] * V @ changes).T)
    rows = np.ascontiguousarray(V / scale[:, None])
    return PolynomialModel("sindy", rows, centre, middle, size, pairs, coefficients)


def _error(model: PolynomialModel, rollout: tuple[Array, Array], scale: Array) -> float:
    """Squared scaled error of pieces of `STEPS` steps, infinite where one is lost."""
    states, actions = rollout
    begins = np.arange(0, len(actions) - STEPS + 1, STEPS)
    z, total = states[begins], 0.0
    with np.errstate(all="ignore"):
        for k in range(STEPS):
            z = model.step(z, actions[begins + k])
            total += float(np.sum(((z - states[begins + k + 1]) / scale) ** 2))
    return total if np.isfinite(total) else np.inf


def planned_law(model: PolynomialModel, plant: Plant) -> Law:
    """Nonlinear model predictive control; one law for one batch of rollouts."""
    n_z, n_a = plant.n_z, plant.n_a
    planner = Planner(
        model,
        plant.cost,
        plant.action_set,
        np.zeros((n_a, n_z)),
        model.action_centre,
        around=True,
        steps=STEPS,
        terminal=False,
        iterations=ITERATIONS,
        starts=1,
    )
    plan = np.zeros((0, STEPS, n_a))

    def law(k: int, states: Array) -> Array:
        nonlocal plan
        plan = plan if k else np.zeros((len(states), STEPS, n_a))
        actions, plan, _ = planner.step(plan, states, k)
        plan = planner.shifted(plan)
        return actions

    return law


def sindy_cost(plant: Plant, problem: pdeloop.Problem, seeds: Sequence[int], seed: int) -> float:
    """Mean cost of the law from the initial states of these seeds, after 20 rollouts from another."""
    data = [problem.explore(1000 * seed + i) for i in range(10)]
    for i in range(2):
        starts = [10**6 + 1000 * seed + 5 * i + j for j in range(5)]
        episode = rollout(plant, planned_law(fitted(data), plant), starts)
        whole = np.isfinite(episode.states).all(axis=(0, 2))
        data += [(episode.states[:, m], episode.actions[:, m]) for m in np.flatnonzero(whole)]
    law = planned_law(fitted(data), plant)
    return float(rollout(plant, law, seeds, keep=False).costs.mean.mean())
