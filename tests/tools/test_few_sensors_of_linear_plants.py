# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A rod and a chain of masses between a few sensors: no training returns a law that runs away."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.linalg import expm

import pdeloop
from pdeloop.messages.cost import Cost, measured_cost
from pdeloop.method.design.lqt import track_horizon
from pdeloop.report.data import gather
from tests.support.small import FEW_STEPS

pytestmark = pytest.mark.filterwarnings("ignore::pdeloop.TrainingWarning")


class Rod(pdeloop.Dynamics):
    """Twelve cells that cool and conduct, with a heater over two cells at a sixth and two thirds."""

    n_z, n_a, horizon, action_weight = 12, 2, 60, 0.01

    def __init__(self) -> None:
        links = np.diag(np.full(11, 1.0), 1) + np.diag(np.full(11, 1.0), -1)
        self.A = 0.93 * np.eye(12) + 0.25 * (links - np.diag(links.sum(axis=0)))
        self.B = np.zeros((12, 2))
        self.B[2:4, 0] = self.B[8:10, 1] = 0.8

    def initial_state(self, rng):
        return 1.0 + 0.3 * rng.random(12)

    def step(self, z, a):
        return z @ self.A.T + a @ self.B.T


def test_the_order_is_that_of_the_state_and_not_the_number_of_sensors() -> None:
    """LQG of the true model, which weighs the whole state, costs 0.82; of the readings 1.18."""
    run = pdeloop.train(plant=Rod(), sensors=3, rollouts=6, evaluation_fields=5, **FEW_STEPS)
    assert len(run.models[0].A) > 3
    assert run.costs["lqt"].mean() < 1.3 < 1.9 < run.costs["none"].mean()
    assert run.costs["adapted"].mean() < 1.3


def test_where_every_law_runs_away_no_control_is_tried_and_left_for_a_better_one() -> None:
    small = {"rollouts": 16, "evaluation_fields": 3, **FEW_STEPS}
    run = pdeloop.train(plant=Rod(), sensors=3, seed=2, reduced_order=3, **small)
    assert run.costs["lqt"].min() > 100.0
    assert run.costs["adapted"].mean() < 0.7 * run.costs["none"].mean()


class Chain(pdeloop.Dynamics):
    """Six masses between springs, hardly damped; two of them are pushed."""

    n_z, n_a, horizon, action_weight = 12, 2, 80, 0.05

    def __init__(self) -> None:
        springs = np.diag(np.ones(5), 1) + np.diag(np.ones(5), -1) - 2.0 * np.eye(6)
        pushed = np.zeros((14, 14))
        pushed[:6, 6:12], pushed[6:12, :6] = np.eye(6), springs
        pushed[6:12, 6:12] = -0.1 * np.eye(6)
        pushed[7, 12] = pushed[10, 13] = 1.0
        held = expm(0.3 * pushed)
        self.A, self.B = held[:12, :12], held[:12, 12:]

    def initial_state(self, rng):
        return np.concatenate([0.5 * rng.standard_normal(6), np.zeros(6)])

    def step(self, z, a):
        return z @ self.A.T + a @ self.B.T


def test_a_model_that_is_exact_on_held_out_readings_is_the_one_that_is_chosen() -> None:
    """Where there is no noise, a filter forgets a wrong initial state slowly: no model is to blame."""
    run = pdeloop.train(plant=Chain(), sensors=3, rollouts=6, evaluation_fields=5, **FEW_STEPS)
    assert len(run.models[0].A) == 12
    poles = np.abs(np.linalg.eigvals(run.models[0].A))
    np.testing.assert_allclose(poles, np.abs(np.linalg.eigvals(Chain().A)), rtol=1e-3)
    assert run.costs["lqt"].mean() < 0.7 * run.costs["none"].mean()


class Weighed(Rod):
    """The rod about a target of two outputs, with matrices as weights, bounds and a terminal weight."""

    output = np.kron(np.eye(2), np.full((1, 6), 1.0 / 6.0))
    target = np.array([0.5, 0.8])
    state_weight = np.array([[6.0, 1.0], [1.0, 4.0]])
    action_weight = np.diag([0.02, 0.05])
    terminal_weight = 2.0
    action_low, action_high = 0.0, 1.0


def test_weights_of_outputs_are_those_of_the_state_between_the_sensors() -> None:
    small: dict[str, Any] = {"plant": Weighed(), "rollouts": 9, **FEW_STEPS}
    whole = pdeloop.train(**small)
    for law in ("extended_kalman", "affine"):
        run = pdeloop.train(**small, sensors=4, law=law)
        costs = {name: own.mean() for name, own in run.costs.items()}
        assert costs["adapted"] < 0.5 * costs["none"]
        assert costs["adapted"] < 1.3 * whole.costs["adapted"].mean()


def test_the_cost_of_readings_is_that_of_states_that_are_linear_between_sensors() -> None:
    values = pdeloop.problem(plant=Weighed(), sensors=4, sensor_delays=2).values
    plant, known = Weighed(), measured(values)
    cost = pdeloop.problem(plant=plant).plant().cost
    places = np.array([1, 4, 7, 10])  # int((j + 1/2) 12 / 4)
    y = np.random.default_rng(0).standard_normal((5, 4))
    z = np.array([np.interp(np.arange(12), places, own) for own in y])
    o = np.sqrt(12 / 8) * np.hstack([y, np.zeros_like(y)])
    a, (own, of_states) = np.full((5, 2), 0.3), np.zeros((2, 5))
    known.add(own, o, a, 0)
    cost.add(of_states, z, a, 0)
    np.testing.assert_allclose(own, of_states, rtol=1e-12)


class Following(Rod):
    """The rod, of which every cell is to follow a wave of its own."""

    target = 1.0 + 0.4 * np.sin(0.15 * np.arange(61)[:, None] - 0.5 * np.arange(12))


def test_a_target_that_moves_is_followed_with_few_sensors(tmp_path: Path) -> None:
    """At 1.05 times the cost of the best law of all states that knows A, B and this cost."""
    late = pdeloop.problem(plant=Following(), sensors=3, sensor_delays=2).values
    assert late["law"] == "extended_kalman" and late["identification"] == "subspace"
    own = {"sensors": 3, "measurement_noise": 0.02, "rollouts": 6, "evaluation_fields": 3}
    run = pdeloop.train(plant=Following(), **own, out=tmp_path / "run")
    assert len(gather(tmp_path / "run").problems[0].behaviours) == 3
    plant, between = Following(), measured(pdeloop.problem(plant=Following(), sensors=3).values)
    places = [2, 6, 10]
    K, b = track_horizon(plant.A, plant.B, between.through(2.0 * np.eye(12)[places]), np.eye(12))
    fields = run.evaluation[0]
    best = pdeloop.rollout(
        pdeloop.problem(plant=plant).plant(), lambda k, z: z @ K[k].T + b[k], fields
    ).costs.mean
    assert run.costs["adapted"].mean() < 1.05 * best.mean() < 0.3 * run.costs["none"].mean()
    assert run.costs["lqt"].mean() < 1.1 * best.mean()


def measured(values: dict[str, Any]) -> Cost:
    cost = Cost.parse(measured_cost(values))
    assert cost is not None
    return cost


def test_without_outputs_it_is_the_distance_from_the_target_that_is_linear_between_sensors() -> (
    None
):
    problem = pdeloop.problem(plant=Following(), sensors=4)
    known, cost = measured(problem.values), pdeloop.problem(plant=Following()).plant().cost
    places, wanted = np.array([1, 4, 7, 10]), Following.target[3]
    y = np.random.default_rng(0).standard_normal((5, 4))
    z = wanted + np.array([np.interp(np.arange(12), places, own - wanted[places]) for own in y])
    a, (own, of_states) = np.full((5, 2), 0.3), np.zeros((2, 5))
    known.add(own, np.sqrt(12 / 4) * y, a, 3)
    cost.add(of_states, z, a, 3)
    np.testing.assert_allclose(own, of_states, rtol=1e-12)
