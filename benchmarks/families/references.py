# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Reference controllers of the plants in `process`, which know the exact linearisation.

With e = z - z_0 at an operating point f(z_0, a_0), e_{k+1} = A e_k + B a_k + d:

- the affine law that minimises the cost over the horizon, its actions clipped to the bounds,
- linear model predictive control within the bounds, over `STEPS` steps and with that law's cost to go
  behind them, solved by OSQP. Without bounds it is the same law.

Where pysindy is installed (extra `rivals`), also nonlinear model predictive control on the model of
SINDy with control, which knows nothing but twenty rollouts (`benchmarks.families.sindy`).

References
----------
Rawlings, Mayne, Diehl, "Model Predictive Control", 2nd edition, section 1.3. Stellato et al., "OSQP: an
operator splitting solver for quadratic programs", Math. Prog. Comp. 12, 2020.
"""

from __future__ import annotations

from collections.abc import Sequence
from importlib.util import find_spec
from typing import NamedTuple

import numpy as np
from scipy import sparse

import pdeloop
from benchmarks.families.process import Process
from benchmarks.families.sindy import sindy_cost
from pdeloop.episode import Law, rollout
from pdeloop.messages.action_set import ActionSet
from pdeloop.messages.arrays import Array
from pdeloop.messages.cost import Cost
from pdeloop.method.design.lqt import Regulator, regulator
from pdeloop.method.models.linear import LinearModel

STEPS = 20
"""Of a plan."""
_DIFFERENCE = 1e-5


class Linearisation(NamedTuple):
    """A (n, n), B (n, n_a) and d (n,) at z_0 (n,)."""

    A: Array
    B: Array
    d: Array
    point: Array


def linearisation(plant: Process) -> Linearisation:
    """That of a step, by central differences."""
    z, a = plant.operating_point()
    sides = [
        [plant.step(z + s * _DIFFERENCE * e, a) for e in np.eye(plant.n_z)]
        + [plant.step(z, a + s * _DIFFERENCE * e) for e in np.eye(plant.n_a)]
        for s in (1.0, -1.0)
    ]
    slopes = (np.array(sides[0]) - np.array(sides[1])).T / (2.0 * _DIFFERENCE)
    A, B = slopes[:, : plant.n_z], slopes[:, plant.n_z :]
    return Linearisation(A, B, plant.step(z, a) - z - B @ a, z)


def clipped_law(model: Linearisation, cost: Cost, admissible: ActionSet) -> Law:
    """The affine law of least cost over the horizon, within bounds."""
    known = problem_of(model, cost)
    return lambda k, states: admissible.project(states @ known.K.T + known.b)


def problem_of(model: Linearisation, cost: Cost) -> Regulator:
    """The linear-quadratic problem of a linearised plant."""
    A, B, d, point = model
    known = regulator(LinearModel("linear", A, B, d + point - A @ point), cost, point)
    if known is None:
        raise ValueError("the linearised plant has no law of finite cost")
    return known


def predictive_law(model: Linearisation, cost: Cost, admissible: ActionSet) -> Law:
    """Linear model predictive control."""
    import osqp

    A, B, d, point = model
    n, n_a = B.shape
    E = cost.residual(np.eye(n))
    offset = E @ point - cost.residual_target().mean(axis=0)
    stage = np.column_stack([E, offset])
    weights = [stage.T @ stage] * (STEPS - 1) + [problem_of(model, cost).P]
    R, a_r = cost.action_matrix, cost.action_target
    whole = np.block([[A, d[:, None]], [np.zeros(n), np.ones(1)]])
    inputs = np.vstack([B, np.zeros((1, n_a))])
    # [e; 1] of the steps 1 .. N is free [e; 1] of step 0 + forced a.
    powers = [np.linalg.matrix_power(whole, j) for j in range(STEPS + 1)]
    free, size = np.vstack(powers[1:]), n + 1
    forced = np.zeros((STEPS * size, STEPS * n_a))
    for j in range(STEPS):
        for i in range(j + 1):
            forced[j * size : (j + 1) * size, i * n_a : (i + 1) * n_a] = powers[j - i] @ inputs
    weighted = np.vstack([W @ forced[j * size : (j + 1) * size] for j, W in enumerate(weights)])
    H = forced.T @ weighted + np.kron(np.eye(STEPS), R)
    from_state, constant = weighted.T @ free, -np.tile(R @ a_r, STEPS)
    low, high = (
        np.tile(np.broadcast_to(bound, n_a), STEPS) for bound in (admissible.low, admissible.high)
    )
    solver = osqp.OSQP()
    solver.setup(
        sparse.csc_matrix(np.triu(H + H.T) / 2.0),
        constant,
        sparse.eye(len(low), format="csc"),
        low,
        high,
        verbose=False,
        eps_abs=1e-5,
        eps_rel=1e-5,
    )

    def law(k: int, states: Array) -> Array:
        found = []
        for z in states:
            solver.update(q=from_state @ np.append(z - point, 1.0) + constant)
            found.append(solver.solve(raise_error=False).x[:n_a])
        return admissible.project(np.nan_to_num(np.array(found)))

    return law


def reference_costs(plant: Process, seeds: Sequence[int], seed: int) -> dict[str, float]:
    """Mean costs of these controllers from the initial states of these seeds; seed: of rollouts."""
    problem = pdeloop.problem(plant=plant)
    built = problem.plant()
    model, cost = linearisation(plant), built.cost
    admissible = ActionSet(plant.n_a, plant.action_low, plant.action_high, plant.zero_mean)
    laws = {
        "lqr": clipped_law(model, cost, admissible),
        "mpc": predictive_law(model, cost, admissible),
    }
    found = {
        name: float(rollout(built, law, seeds, keep=False).costs.mean.mean())
        for name, law in laws.items()
    }
    if find_spec("pysindy"):
        found["sindy"] = sindy_cost(built, problem, seeds, seed)
    return found
