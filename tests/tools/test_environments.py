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
from tests.support.small import same_bits

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


def test_a_batch_has_the_bits_of_single_environments_over_several_episodes() -> None:
    changes = {"measurement_noise": 0.1, "action_limit": 0.5, **GRID}
    batch = gymnasium.make_vec(BURGERS, num_envs=3, **changes)
    singles = gymnasium.make_vec(BURGERS, num_envs=3, vectorization_mode="sync", **changes)
    assert batch.observation_space == singles.observation_space
    assert batch.action_space == singles.action_space
    assert same_bits(batch.reset(seed=5)[0], singles.reset(seed=5)[0])
    rng = np.random.default_rng(0)
    for _ in range(2 * GRID["horizon"] + 4):
        actions = rng.standard_normal((3, 6))
        for ours, theirs in zip(batch.step(actions)[:4], singles.step(actions)[:4], strict=True):
            assert np.array_equal(ours, theirs)
    assert same_bits(
        batch.reset(seed=[4, 4, 9])[0][:2].copy(), np.tile(batch.reset(seed=4)[0][0], (2, 1))
    )
    with pytest.raises(ValueError, match="expected 3 seeds"):
        batch.reset(seed=[1, 2])


@pytest.mark.parametrize("changes", [{}, {"sensors": 4, "measurement_noise": 0.1}])
def test_an_environment_that_diverges_begins_again_and_disturbs_no_other(changes: dict) -> None:
    made = {"num_envs": 2, "divergence_penalty": 50.0, **GRID, **changes}
    batch, calm = (gymnasium.make_vec(BURGERS, **made) for _ in range(2))
    batch.reset(seed=1), calm.reset(seed=1)
    push = np.array([np.zeros(6), np.full(6, 1e6)])
    for k in range(GRID["horizon"]):
        seen, reward, terminated, truncated, _ = batch.step(push if k == 1 else 0 * push)
        other, expected, *_ = calm.step(0 * push)
        assert same_bits(seen[0], other[0]) and reward[0] == expected[0]
        assert terminated.tolist() == [False, k == 1]
        assert truncated.all() == (k == GRID["horizon"] - 1)
        if k == 1:
            assert reward[1] < -50.0
        if k == 2:
            field = batch.plant.states[1].copy()
            assert reward[1] == 0.0 and not same_bits(field, calm.plant.states[1])
            fresh = pdeloop.problem("burgers", **GRID).plant()
        if k == 3:
            fresh.reset(field[np.newaxis])
            fresh.step(np.zeros((1, 6)))
            assert same_bits(batch.plant.states[1], fresh.states[0])
            assert reward[1] == -fresh.totals[0]
    single = gymnasium.make(BURGERS, **GRID, **changes)
    single.reset(seed=1)
    _, reward, terminated, truncated, _ = single.step(np.full(6, 1e6))
    assert terminated and not truncated and reward <= -DIVERGED_COST


def test_actions_that_do_not_fit_are_refused() -> None:
    env, batch = gymnasium.make(BURGERS, **GRID).unwrapped, gymnasium.make_vec(BURGERS, **GRID)
    env.reset(seed=0), batch.reset(seed=0)
    for refused in (np.zeros(5), np.full(6, np.nan)):
        with pytest.raises(ValueError, match="actions must"):
            env.step(refused)
        with pytest.raises(ValueError, match="actions must"):
            batch.step(refused[np.newaxis])


def test_keywords_that_do_not_fit_are_refused() -> None:
    for given in (np.nan, np.inf, -1.0):
        for make in (gymnasium.make, gymnasium.make_vec):
            with pytest.raises(ValueError, match=r"divergence_penalty is .* a finite number of 0"):
                make(BURGERS, **GRID, divergence_penalty=given)
    with pytest.raises(ValueError, match="num_envs is 0; expected a whole number of 1 or more"):
        gymnasium.make_vec(BURGERS, num_envs=0, **GRID)
    with pytest.raises(ValueError, match="unknown parameter 'n_zz'; did you mean 'n_z'"):
        gymnasium.make(BURGERS, n_zz=32)
