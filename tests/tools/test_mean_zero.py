# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Actions of mean zero, of which only differences show an effect, with few sensors and in a bag."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import pdeloop
from controller_node.identification import DesignSettings, designed
from pdeloop.identification import _identified
from tests.support.small import FEW_STEPS


class Pumps(pdeloop.Dynamics):
    """Three pumps that move a quantity about between six tanks."""

    n_z, n_a, horizon, zero_mean = 6, 3, 60, True
    target = np.array([1.0, 0.3, -0.3, -0.3, -0.5, -0.2])
    action_weight = 0.1

    def initial_state(self, rng: np.random.Generator) -> Any:
        return 0.3 * rng.normal(size=6)

    def step(self, z: Any, a: Any) -> Any:
        moved = 0.8 * z + 0.05 * (np.roll(z, 1) + np.roll(z, -1))
        moved[::2] += 0.4 * a
        return moved


@pytest.fixture(scope="module")
def explored() -> list[tuple[np.ndarray, np.ndarray]]:
    problem = pdeloop.problem(plant=Pumps())
    return [problem.explore(seed) for seed in (0, 1)]


def test_a_model_in_innovation_form_knows_their_differences(explored: Any) -> None:
    values = pdeloop.problem(plant=Pumps(), law="observer", identification="subspace").values
    rows = designed(explored, Pumps.target, DesignSettings.of(values)).rows
    np.testing.assert_allclose(rows.B.sum(axis=1), 0.0, atol=1e-9 * np.abs(rows.B).max())
    run = pdeloop.train(plant=Pumps(), sensors=3, rollouts=12, evaluation_fields=4, **FEW_STEPS)
    costs = {name: own.mean() for name, own in run.costs.items()}
    assert costs["adapted"] < 0.95 * costs["lqt"] < 0.9 * costs["none"]


def test_a_recorded_run_is_identified(explored: Any) -> None:
    values = pdeloop.problem(plant=Pumps()).values
    sources = [{"trajectory": 0}, {"trajectory": 1}]
    found = _identified(explored, Pumps.target, sources, values, {})
    truth = np.array([Pumps().step(np.zeros(6), a) for a in np.eye(3)]).T
    effect = found.model.U @ found.model.B
    np.testing.assert_allclose(effect - effect.mean(axis=1, keepdims=True), effect, atol=1e-9)
    differences = np.eye(3) - 1.0 / 3.0
    np.testing.assert_allclose(effect, truth @ differences, atol=1e-6)
    assert found.pole[0] == pytest.approx(0.9, abs=1e-3)
