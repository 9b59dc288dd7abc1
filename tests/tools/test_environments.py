# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The Gymnasium environments: the library's own check, the plant's bits, and what `info` says."""

from __future__ import annotations

import copy
import os
import pickle
import subprocess
import sys
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode

import pdeloop
from pde_sim_node.plant import DIVERGED_COST
from pdeloop.environments import Environment, VectorEnvironment, environment_id
from pdeloop.messages.problem import shipped_problems
from tests.support.loop_harness import forked
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


MAKERS = pytest.mark.parametrize("make", [gymnasium.make, gymnasium.make_vec])


@MAKERS
@pytest.mark.parametrize(
    ("given", "why"),
    [
        ({"divergence_penalty": np.nan}, "divergence_penalty is nan; expected a finite number"),
        ({"divergence_penalty": -1.0}, "divergence_penalty is -1.0; expected a finite number of 0"),
        ({"divergence_penalty": "big"}, "divergence_penalty is 'big'; expected a number"),
        ({"n_zz": 32}, "unknown parameter 'n_zz'; did you mean 'n_z'"),
        ({"viscosity": 1e-3}, r"'viscosity' is .* did you mean .* physical=\{'viscosity': 0.001\}"),
        ({"viscosty": 1e-3}, r"'viscosty' is .* did you mean .* physical=\{'viscosity': 0.001\}"),
        ({"physical": {"viscosty": 1.0}}, "unknown parameter 'physical.viscosty'"),
        ({"seed": 3}, r"has no parameter 'seed'; did you mean reset\(seed=...\)"),
        ({"dt": 0.1}, "has no parameter 'dt'; did you mean sample_time"),
        ({"rollouts": 20}, "'rollouts' is a parameter .* no effect on an environment"),
        ({"real_time_factor": 1.0}, "'real_time_factor' is a parameter .* no effect"),
        ({"reduced_order": 4}, "'reduced_order' is a parameter .* no effect"),
        ({"horizon": 0}, "horizon"),
    ],
)
def test_each_keyword_is_used_or_refused(
    make: Callable[..., Any], given: dict[str, Any], why: str
) -> None:
    with pytest.raises(ValueError, match=why):
        make(BURGERS, **{**GRID, **given})


def test_keywords_of_the_makers_are_refused_where_they_do_not_belong() -> None:
    with pytest.raises(ValueError, match="num_envs is 0; expected a whole number of 1 or more"):
        gymnasium.make_vec(BURGERS, num_envs=0, **GRID)
    with pytest.raises(ValueError, match="num_envs is True; expected"):
        gymnasium.make_vec(BURGERS, num_envs=True, **GRID)
    with pytest.raises(
        ValueError, match=r"has no parameter 'num_envs'; did you mean gymnasium.make_vec"
    ):
        gymnasium.make(BURGERS, num_envs=2, **GRID)
    with pytest.raises(
        ValueError, match="has no parameter 'max_episode_steps'; did you mean horizon"
    ):
        gymnasium.make_vec(BURGERS, max_episode_steps=2, **GRID)
    with pytest.raises(ValueError, match="autoreset_mode is 'later'; expected one of NextStep, "):
        gymnasium.make_vec(BURGERS, autoreset_mode="later", **GRID)
    for kind in (Environment, VectorEnvironment):
        with pytest.raises(
            ValueError, match="render_mode is 'human'; expected 'rgb_array' or None"
        ):
            kind("burgers", render_mode="human", **GRID)


@pytest.mark.parametrize("problem", shipped_problems())
def test_the_action_space_is_bounded_as_algorithms_need_it(problem: str) -> None:
    """At its bound all actions cost as much as the mean initial error, or it is the plant's limit."""
    env = gymnasium.make(environment_id(problem), n_z=64)
    plant = pdeloop.problem(problem, n_z=64).plant()
    error = plant.reset([-1])[0] - plant.field_target
    b = float(env.action_space.high[0])
    assert np.isfinite(b) and np.array_equal(env.action_space.low, -env.action_space.high)
    expected = plant.state_weight * (error @ error) / (plant.n_a * plant.action_weight)
    assert b**2 == pytest.approx(expected, rel=1e-12)
    limited = gymnasium.make(environment_id(problem), n_z=64, action_limit=0.5)
    assert np.all(limited.action_space.high == 0.5)


def test_an_action_beyond_the_space_acts_as_it_is() -> None:
    env, plant = gymnasium.make(BURGERS, **GRID), pdeloop.problem("burgers", **GRID).plant()
    env.reset(seed=2), plant.reset([2])
    push = 3.0 * env.action_space.high
    assert same_bits(env.step(push)[0], plant.step(push[np.newaxis])[0])


@pytest.mark.parametrize("changes", [{}, {"sensors": 4, "measurement_noise": 0.1}])
def test_info_has_cost_distance_and_target(changes: dict[str, Any]) -> None:
    env = gymnasium.make(BURGERS, divergence_penalty=7.0, **GRID, **changes)
    plant = env.unwrapped.plant
    _, info = env.reset(seed=1)
    assert info["cost"] == 0.0
    action = np.full(6, 0.1)
    for _ in range(3):
        z = plant.states[0].copy()
        error = z - plant.field_target
        assert info["distance"] == pytest.approx(np.sqrt(np.mean(error**2)), rel=1e-14)
        assert same_bits(info["target"], plant.target)
        _, reward, _, _, info = env.step(action)
        assert info["cost"] == -reward
        assert info["cost"] == pytest.approx(error @ error + action @ action, rel=1e-12)
    info["target"][:] = 9.0
    assert not np.any(plant.target == 9.0)
    _, reward, terminated, _, info = env.step(np.full(6, 1e6))
    assert terminated and reward == -info["cost"] - 7.0


def assert_equal_info(ours: Any, theirs: Any) -> None:
    """Of vector environments: the same keys, masks, types and values."""
    assert type(ours) is type(theirs)
    if isinstance(ours, dict):
        assert ours.keys() == theirs.keys()
        for name in ours:
            assert_equal_info(ours[name], theirs[name])
    elif ours.dtype == object:
        for one, other in zip(ours, theirs, strict=True):
            assert (one is None) == (other is None)
            assert one is None or np.array_equal(one, other)
    else:
        assert ours.dtype == theirs.dtype and np.array_equal(ours, theirs)


@pytest.mark.parametrize("mode", AutoresetMode)
@pytest.mark.parametrize("changes", [{}, {"sensors": 4, "sensor_delays": 2}])
def test_a_batch_begins_again_as_the_librarys_own_vector_environment_does(
    mode: AutoresetMode, changes: dict[str, Any]
) -> None:
    changes = {**changes, "action_limit": 0.5, **GRID}
    batch = gymnasium.make_vec(BURGERS, num_envs=3, autoreset_mode=mode, **changes)
    singles = gymnasium.make_vec(
        BURGERS,
        num_envs=3,
        vectorization_mode="sync",
        vector_kwargs={"autoreset_mode": mode},
        **changes,
    )
    assert batch.metadata["autoreset_mode"] == singles.metadata["autoreset_mode"] == mode
    rng = np.random.default_rng(0)
    ours, theirs = batch.reset(seed=5), singles.reset(seed=5)
    for _ in range(2 * GRID["horizon"] + 4):
        for one, other in zip(ours[:-1], theirs[:-1], strict=True):
            assert one.dtype == other.dtype and np.array_equal(one, other)
        assert_equal_info(ours[-1], theirs[-1])
        if mode is AutoresetMode.DISABLED and len(ours) == 5 and ours[3].all():
            again = {"reset_mask": np.ones(3, dtype=np.bool_)}
            ours, theirs = batch.reset(options=dict(again)), singles.reset(options=dict(again))
        else:
            actions = rng.standard_normal((3, 6))
            ours, theirs = batch.step(actions), singles.step(actions)


def test_one_that_diverges_begins_again_in_the_same_step() -> None:
    made = {"num_envs": 2, "divergence_penalty": 50.0, **GRID}
    batch = gymnasium.make_vec(BURGERS, autoreset_mode="SameStep", **made)
    batch.reset(seed=1)
    seen, reward, terminated, truncated, info = batch.step(np.array([np.zeros(6), np.full(6, 1e6)]))
    assert terminated.tolist() == [False, True] and not truncated.any() and reward[1] < -50.0
    assert info["_final_obs"].tolist() == [False, True] and info["final_obs"][0] is None
    assert not same_bits(info["final_obs"][1], seen[1]) and info["cost"][1] == 0.0
    assert info["final_info"]["cost"][1] == -reward[1] - 50.0
    fresh = pdeloop.problem("burgers", **GRID).plant()
    fresh.reset(seen[1:])
    assert same_bits(batch.step(np.zeros((2, 6)))[0][1], fresh.step(np.zeros((1, 6)))[0])


def test_without_autoreset_what_has_ended_waits_for_a_reset() -> None:
    batch = gymnasium.make_vec(BURGERS, num_envs=2, autoreset_mode="Disabled", **GRID)
    batch.reset(seed=1)
    first = batch.step(np.array([np.zeros(6), np.full(6, 1e6)]))[0].copy()
    with pytest.raises(RuntimeError, match=r"environments \[1\] have ended: call reset"):
        batch.step(np.zeros((2, 6)))
    seen, info = batch.reset(seed=[None, 7], options={"reset_mask": np.array([False, True])})
    fresh = pdeloop.problem("burgers", **GRID).plant()
    assert same_bits(seen[0], first[0]) and same_bits(seen[1], fresh.reset([7])[0])
    assert info["_cost"].tolist() == [False, True]
    for _ in range(GRID["horizon"] - 1):
        *_, truncated, _ = batch.step(np.zeros((2, 6)))
    assert truncated.all()
    with pytest.raises(
        ValueError, match="share a horizon, which has been reached: reset_mask must"
    ):
        batch.reset(options={"reset_mask": np.array([False, True])})
    for wrong in (np.ones(3, dtype=bool), np.zeros(2, dtype=bool), np.ones(2)):
        with pytest.raises(ValueError, match=r"options\['reset_mask'\] must be an array of 2 bool"):
            batch.reset(options={"reset_mask": wrong})


def test_seeds_make_episodes_and_only_episodes_without_one_differ() -> None:
    env = gymnasium.make(BURGERS, **GRID)
    first, _ = env.reset(seed=4)
    drawn = [env.reset()[0] for _ in range(3)]
    assert same_bits(env.reset(seed=4)[0], first)
    assert all(same_bits(env.reset()[0], again) for again in drawn)
    assert len({z.tobytes() for z in (first, *drawn)}) == 4
    batch = gymnasium.make_vec(BURGERS, num_envs=2, **GRID)
    assert same_bits(batch.reset(seed=np.int64(4))[0][0], first)
    assert same_bits(batch.reset(seed=[None, 4])[0][1], first)
    assert same_bits(batch.reset(seed=(9, 4))[0][1], first)
    for wrong in (-1, 0.5, "4"):
        with pytest.raises((ValueError, TypeError, gymnasium.error.Error)):
            env.reset(seed=wrong)
        with pytest.raises((ValueError, TypeError, gymnasium.error.Error)):
            batch.reset(seed=[wrong, 1])


def test_an_episode_begins_with_a_field_that_is_given() -> None:
    field = np.sin(np.arange(32))
    env, batch = gymnasium.make(BURGERS, **GRID), gymnasium.make_vec(BURGERS, 2, **GRID)
    assert same_bits(env.reset(options={"field": field})[0], field)
    fields = np.stack([field, 2 * field])
    assert same_bits(batch.reset(options={"field": fields})[0], fields)
    for make in (env, batch):
        with pytest.raises(ValueError, match=r"options\['field'\] must have shape"):
            make.reset(options={"field": field[:5]})
        with pytest.raises(ValueError, match="unknown option 'fields' of reset; expected 'field'"):
            make.reset(options={"fields": field})


WAYS = pytest.mark.parametrize(
    "again", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))], ids=["copy", "pickle"]
)


@WAYS
def test_a_copy_of_an_environment_continues_with_the_same_bits(again: Callable[[Any], Any]) -> None:
    env = gymnasium.make(BURGERS, render_mode="rgb_array", measurement_noise=0.1, **GRID)
    env.action_space.seed(0)
    env.reset(seed=3), env.step(np.ones(6)), env.render()
    other = again(env)
    for _ in range(2 * GRID["horizon"]):
        ours, theirs = env.step(np.ones(6)), other.step(np.ones(6))
        assert same_bits(ours[0], theirs[0]) and ours[1:4] == theirs[1:4]
        if ours[3]:  # the next field is drawn
            assert same_bits(env.reset()[0], other.reset()[0])
    assert np.array_equal(env.action_space.sample(), other.action_space.sample())


@WAYS
@pytest.mark.parametrize("mode", [AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP])
def test_a_copy_of_a_batch_continues_with_the_same_bits(
    again: Callable[[Any], Any], mode: AutoresetMode
) -> None:
    batch = gymnasium.make_vec(BURGERS, 2, autoreset_mode=mode, process_noise=0.01, **GRID)
    batch.reset(seed=3), batch.step(np.array([np.zeros(6), np.full(6, 1e6)]))
    other = again(batch)
    for _ in range(2 * GRID["horizon"]):
        a = np.ones((2, 6))
        for ours, theirs in zip(batch.step(a)[:4], other.step(a)[:4], strict=True):
            assert np.array_equal(ours, theirs)


def test_an_environment_is_made_of_a_problem_or_a_plant_too() -> None:
    problem = pdeloop.problem("burgers", physical={"viscosity": 2e-3}, **GRID)
    made = [Environment(source) for source in (problem, problem.plant())]
    made.append(Environment("burgers", physical={"viscosity": 2e-3}, **GRID))
    assert len({env.reset(seed=1)[0].tobytes() for env in made}) == 1
    assert len({env.step(np.ones(6))[0].tobytes() for env in made}) == 1
    assert VectorEnvironment(problem.plant(5), num_envs=2).reset(seed=1)[0].shape == (2, 32)
    with pytest.raises(ValueError, match="'n_z' is given with Problem"):
        Environment(problem, n_z=64)


def test_closing_twice_does_no_harm() -> None:
    for env in (gymnasium.make(BURGERS, **GRID), gymnasium.make_vec(BURGERS, 2, **GRID)):
        first, _ = env.reset(seed=0)
        env.close(), env.close()
        again, _ = env.reset(seed=0)
        assert np.array_equal(first, again)


def test_the_module_in_the_id_is_imported_where_nobody_has_done_it() -> None:
    program = (
        "import gymnasium\n"
        f"print(gymnasium.make('pdeloop.environments:{BURGERS}', n_z=32).observation_space.shape)"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=120, check=True
    )
    assert done.stdout == "(32,)\n"


def test_processes_of_their_own_have_the_same_bits() -> None:
    how = {"num_envs": 2, "action_limit": 0.5, **GRID}
    forked(os.getpid).join()  # what they are forked from is there, and has everything loaded
    apart = gymnasium.make_vec(
        BURGERS, vectorization_mode="async", vector_kwargs={"context": "forkserver"}, **how
    )
    try:
        batch = gymnasium.make_vec(BURGERS, **how)
        assert same_bits(apart.reset(seed=1)[0], batch.reset(seed=1)[0])
        for _ in range(GRID["horizon"] + 2):
            a = np.ones((2, 6))
            for ours, theirs in zip(batch.step(a)[:4], apart.step(a)[:4], strict=True):
                assert np.array_equal(ours, theirs)
    finally:
        apart.close()
