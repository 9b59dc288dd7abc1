# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""One episode in one process: what the plant does step by step, and what is kept of it."""

from __future__ import annotations

import numpy as np
import pytest

from pde_sim_node.build import build_plant
from pdeloop.episode import rollout
from tests.support.small import parameters

GAIN = 0.1


def feedback(k: int, z: np.ndarray) -> np.ndarray:
    return -GAIN * z[:, :4] + 0.01 * k


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"measurement_noise": 0.1, "process_noise": 0.01, "action_limit": 0.05},
        {"sensors": 4, "sensor_delays": 2},
    ],
)
def test_it_is_the_plant_step_by_step(changes: dict) -> None:
    plant, judge = (build_plant(parameters(**changes)) for _ in range(2))
    seeds = np.array([3, -1, 4])
    noise = np.array([7, 8, 9]) if "measurement_noise" in changes else None
    episode = rollout(plant, feedback, seeds, noise)
    z = judge.reset(seeds, noise)
    for k in range(judge.horizon):
        assert np.array_equal(episode.states[k], z)
        assert np.array_equal(episode.fields[k], judge.states)
        assert np.array_equal(episode.actions[k], feedback(k, z))
        z = judge.step(feedback(k, z))
    assert np.array_equal(episode.states[-1], z)
    assert np.array_equal(episode.fields[-1], judge.states)
    costs = judge.episode_costs()
    assert np.array_equal(episode.costs.mean, costs.mean)
    assert np.array_equal(episode.costs.total, costs.total)
    light = rollout(plant, feedback, seeds, noise, keep=False)
    assert np.array_equal(light.costs.mean, costs.mean)
    assert len(light.states) == len(light.fields) == len(light.actions) == 0


def test_a_diverged_environment_keeps_its_last_state_and_the_others_go_on() -> None:
    plant = build_plant(parameters(divergence_bound=1.5))

    def push(k: int, z: np.ndarray) -> np.ndarray:
        return np.array([[0.0], [5.0 * (k >= 3)]]) * np.ones((2, plant.n_a))

    episode = rollout(plant, push, [1, 1])
    alone = rollout(plant, lambda k, z: np.zeros((1, plant.n_a)), [1])
    assert episode.costs.diverged_step[0] == -1
    step = episode.costs.diverged_step[1]
    assert step >= 3
    assert (episode.states[step:, 1] == episode.states[step, 1]).all()
    assert np.array_equal(episode.states[:, 0], alone.states[:, 0])


def test_actions_that_are_no_numbers_are_refused() -> None:
    plant = build_plant(parameters())
    with pytest.raises(ValueError, match="finite"):
        rollout(plant, lambda k, z: np.full((1, plant.n_a), np.nan), [0])
    with pytest.raises(ValueError, match="shape"):
        rollout(plant, lambda k, z: np.zeros((2, plant.n_a)), [0])
