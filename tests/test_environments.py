# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The Gymnasium environments: the library's own check, and the plant's bits."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import pdeloop
from loop_interfaces.problem import shipped_problems
from pde_sim_node.plant import DIVERGED_COST
from pdeloop.environments import environment_id
from tests.small import same_bits

BURGERS = "pdeloop/Burgers-v0"
GRID = {"n_z": 32, "horizon": 6}


@pytest.mark.parametrize("problem", shipped_problems())
def test_every_problem_passes_the_check_of_the_library_without_a_warning(problem: str) -> None:
    env = gymnasium.make(environment_id(problem), action_limit=1.0, n_z=64)
    check_env(env.unwrapped)


def test_an_episode_is_that_of_the_plant_to_the_bit() -> None:
    noise = {"measurement_noise": 0.1, "process_noise": 0.01, "sensors": 4}
    moved = {"actuator_positions": [0.1, 0.15, 0.3, 0.6, 0.7, 0.95], "actuator_shape": "gaussian"}
    for changes in ({}, noise, moved):
        env = gymnasium.make(BURGERS, **GRID, **changes)
        plant = pdeloop.problem("burgers", **GRID, **changes).plant()
        rng, total, ended = np.random.default_rng(0), 0.0, False
        seen, z = env.reset(seed=7)[0], plant.reset([7])[0]
        while not ended:
            assert same_bits(seen, z)
            action = rng.standard_normal(plant.n_a)
            seen, reward, terminated, ended, _ = env.step(action)
            z = plant.step(action[np.newaxis])[0]
            total += reward
            assert not terminated
        assert plant.step_index == plant.horizon
        assert -total == plant.totals[0]


def test_environments_of_the_library_side_by_side_have_their_own_seeds_and_begin_again() -> None:
    made = {"num_envs": 2, "divergence_penalty": 50.0, **GRID}
    envs, calm = (gymnasium.make_vec(BURGERS, **made) for _ in range(2))
    seen, _ = envs.reset(seed=5)
    plant = pdeloop.problem("burgers", **GRID).plant()
    assert same_bits(seen, plant.reset([5, 6]))
    calm.reset(seed=5)
    push = np.array([np.zeros(6), np.full(6, 1e6)])
    for k in range(GRID["horizon"]):
        seen, reward, terminated, truncated, _ = envs.step(push if k == 1 else 0 * push)
        other, expected, *_ = calm.step(0 * push)
        assert same_bits(seen[0], other[0]) and reward[0] == expected[0]
        assert terminated.tolist() == [False, k == 1]
        assert truncated.tolist() == [k == GRID["horizon"] - 1, False]
        if k == 1:
            assert reward[1] < -50.0
    single = gymnasium.make(BURGERS, **GRID)
    single.reset(seed=1)
    _, reward, terminated, truncated, _ = single.step(np.full(6, 1e6))
    assert terminated and not truncated and reward <= -DIVERGED_COST


def test_actions_that_do_not_fit_are_refused() -> None:
    env = gymnasium.make(BURGERS, **GRID).unwrapped
    env.reset(seed=0)
    for refused in (np.zeros(5), np.full(6, np.nan)):
        with pytest.raises(ValueError, match="actions must"):
            env.step(refused)


def test_keywords_that_do_not_fit_are_refused() -> None:
    for given in (np.nan, np.inf, -1.0):
        for make in (gymnasium.make, gymnasium.make_vec):
            with pytest.raises(ValueError, match=r"divergence_penalty is .* a finite number of 0"):
                make(BURGERS, **GRID, divergence_penalty=given)
    with pytest.raises(ValueError, match="unknown parameter 'n_zz'; did you mean 'n_z'"):
        gymnasium.make(BURGERS, n_zz=32)
