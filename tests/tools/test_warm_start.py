# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A law as the start of agents of stable-baselines3 and sb3-contrib."""

from __future__ import annotations

import importlib
import importlib.util
import os
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium
import numpy as np
import pytest

import pdeloop
import pdeloop.environments
from benchmarks import agents
from pdeloop.environments import Environment, ResidualAction, warm_start
from pdeloop.finished_run import FinishedRun
from pdeloop.messages.arrays import Array
from tests.support.small import SMALL

LIMIT = 0.3
AGENTS = {"PPO": "stable_baselines3", "SAC": "stable_baselines3", "CrossQ": "sb3_contrib"}
QUICK: dict[str, Any] = {"optimizer": "two_point", "rollouts": 5, "evaluation_fields": 2}

needs_library = pytest.mark.skipif(
    importlib.util.find_spec("sb3_contrib") is None,
    reason="stable-baselines3 is not installed: extra rl",
)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> FinishedRun:
    folder = tmp_path_factory.mktemp("runs")
    os.environ.setdefault("TORCHINDUCTOR_CACHE_DIR", str(folder / "inductor"))  # made when it saves
    out = folder / "run"
    return pdeloop.train(str(SMALL), horizon=20, action_limit=LIMIT, **QUICK, out=out)


def environment(**changed: Any) -> gymnasium.Env[Any, Any]:
    return Environment(str(SMALL), **{"horizon": 20, "action_limit": LIMIT} | changed)


def agent(name: str, env: Any, **how: Any) -> Any:
    import torch

    torch.set_num_threads(1)
    library = importlib.import_module(AGENTS[name])
    own: dict[str, Any] = (
        {"n_steps": 20, "batch_size": 20} if name == "PPO" else {"buffer_size": 100}
    )
    own["policy_kwargs"] = {"net_arch": {"pi": [16], "vf" if name == "PPO" else "qf": [16]}}
    return quiet(getattr(library, name)("MlpPolicy", env, seed=0, device="cpu", **own | how))


def quiet(made: Any) -> Any:
    """The agent, which writes no log into the temporary folder."""
    from stable_baselines3.common.logger import Logger

    made.set_logger(Logger(None, []))
    return made


def fields(run: FinishedRun) -> Array:
    """Measurements at which the law is within its bounds, and others where it is not."""
    draw = np.random.default_rng(0).standard_normal((40, len(run.models[0].U)))
    return np.concatenate([0.2 * draw, 20.0 * draw])


@needs_library
@pytest.mark.parametrize("name", AGENTS)
@pytest.mark.parametrize("rescaled", [False, True])
def test_the_mean_action_is_that_of_the_law(run: FinishedRun, name: str, rescaled: bool) -> None:
    env = environment()
    if rescaled:
        env = gymnasium.wrappers.RescaleAction(env, np.float64(-1.0), np.float64(1.0))
    made = agent(name, env)
    before, _ = made.predict(fields(run), deterministic=True)
    warm_start(made, run)
    own = run.law()(0, fields(run)) / (LIMIT if rescaled else 1.0)
    acted, _ = made.predict(fields(run), deterministic=True)
    width = 1.0 if rescaled else LIMIT
    inside = np.abs(own) < 0.99 * width
    assert inside.any() and not inside.all()
    np.testing.assert_allclose(acted[inside], own[inside], atol=1e-5 * width)
    # A squashed policy stays 0.1 % of the width away from its bounds.
    np.testing.assert_allclose(acted, own, atol=(1e-5 if name == "PPO" else 1.001e-3) * width)
    assert np.abs(before - own).max() > 0.1 * width


@needs_library
@pytest.mark.parametrize("name", AGENTS)
def test_it_explores_about_the_law_learns_and_is_saved(
    run: FinishedRun, name: str, tmp_path: Path
) -> None:
    made = agent(name, environment(), learning_rate=1e-3)
    warm_start(made, run, std=0.02)
    near = 0.02 * fields(run)[:40]
    mean, _ = made.predict(near, deterministic=True)
    drawn = np.array([made.predict(near)[0] for _ in range(100)]) - mean
    slope = 1.0 if name == "PPO" else 1.0 - (mean / LIMIT) ** 2  # of tanh
    assert (drawn / slope).std() == pytest.approx(0.02 * LIMIT, rel=0.05)
    owner = made.policy if name == "PPO" else made.actor
    path = owner.action_net if name == "PPO" else owner.mu
    before = [p.detach().clone() for p in (path.law.weight, path.layer.weight)]
    made.learn(60)
    for old, new in zip(before, (path.law.weight, path.layer.weight), strict=True):
        assert (old != new).any()
    made.save(tmp_path / "agent")
    again = type(made).load(tmp_path / "agent", env=environment(), device="cpu")
    assert np.array_equal(*(a.predict(fields(run), deterministic=True)[0] for a in (made, again)))
    quiet(again).learn(40)


@needs_library
def test_its_first_episode_costs_what_the_law_costs(run: FinishedRun) -> None:
    made, env = agent("PPO", environment()), environment()
    warm_start(made, run)
    law, costs = run.law(), []
    for act in (
        lambda k, y: law(k, y[None])[0],
        lambda k, y: made.predict(y, deterministic=True)[0],
    ):
        y, _ = env.reset(seed=3)
        rewards = []
        for k in range(20):
            y, reward, *_ = env.step(act(k, y))
            rewards.append(float(reward))
        costs.append(-np.mean(rewards))
    assert costs[1] == pytest.approx(costs[0], rel=1e-5)


@needs_library
@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda run: agent("PPO", environment(n_z=128)), "measures 32 numbers .* shapes"),
        (lambda run: agent("PPO", ResidualAction(environment(), run)), "use one of the two"),
        (lambda run: agent("PPO", environment(), use_sde=True), "without gSDE"),
        (lambda run: agent("PPO", normalised()), "norm_obs=False"),
        (lambda run: warm(agent("SAC", environment()), run), "has a law already"),
        (lambda run: SimpleNamespace(), "expected a PPO, SAC or CrossQ"),
    ],
)
def test_agents_that_cannot_have_the_law_are_refused(
    run: FinishedRun, make: Any, message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        warm_start(make(run), run)


def warm(made: Any, run: FinishedRun) -> Any:
    warm_start(made, run)
    return made


def normalised() -> Any:
    from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

    return VecNormalize(DummyVecEnv([environment]))


@needs_library
@pytest.mark.parametrize("algorithm", ["ppo", "sac"])
def test_agents_of_the_benchmark_begin_at_the_cost_of_the_law(
    run: FinishedRun, algorithm: str
) -> None:
    """But the cold one, which does not know the law; all of them learn."""
    found = agents.run(
        run.folder, algorithms=[algorithm], starts=agents.STARTS, rollouts=[8], seeds=1
    )
    costs = {row["start"]: [cost for (cost,) in row["costs"].values()] for row in found["rows"]}
    for start in ("path", "frozen", "residual"):
        assert costs[start][0] == pytest.approx(found["law"], rel=1e-3)
        assert costs[start][1] != costs[start][0]
    assert abs(costs["cold"][0] / found["law"] - 1.0) > 0.05
    assert abs(costs["cloned"][0] / found["law"] - 1.0) < 0.2
