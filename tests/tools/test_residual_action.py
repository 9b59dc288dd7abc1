# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""An agent that corrects a law: without a correction it is the law, to the bit."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import pdeloop
from pdeloop.environments import Environment, ResidualAction
from pdeloop.finished_run import FinishedRun
from tests.support.small import SMALL

QUICK: dict[str, Any] = {"optimizer": "two_point", "rollouts": 6, "evaluation_fields": 2}


@pytest.fixture(scope="module", params=["affine", "observer"])
def run(request: Any, tmp_path_factory: pytest.TempPathFactory) -> FinishedRun:
    out = tmp_path_factory.mktemp("runs") / request.param
    given = {"law": request.param, "horizon": 20, "action_limit": 0.2}
    return pdeloop.train(str(SMALL), **given, **QUICK, out=out)


def environment() -> Environment:
    return Environment(str(SMALL), horizon=20, action_limit=0.2)


def test_without_a_residual_an_episode_is_that_of_the_law(run: FinishedRun) -> None:
    env = ResidualAction(environment(), run)
    plant = pdeloop.problem(str(SMALL), horizon=20, action_limit=0.2).plant()
    for seed in (3, 4):
        expected = pdeloop.rollout(plant, run.law(), [seed])
        total, (observation, _) = 0.0, env.reset(seed=seed)
        for k in range(20):
            assert np.array_equal(observation, expected.states[k, 0])
            observation, reward, _, ended, info = env.step(np.zeros(env.action_space.shape))
            assert np.array_equal(np.clip(info["law_action"], -0.2, 0.2), expected.actions[k, 0])
            total -= reward
        assert ended and total == pytest.approx(expected.costs.total[0], rel=1e-13)


def test_a_residual_is_scaled_added_and_kept_within_the_bounds(run: FinishedRun) -> None:
    env, plain = ResidualAction(environment(), run, "lqt", scale=0.5), environment()
    env.reset(seed=0)
    plain.reset(seed=0)
    residual = np.array([0.1, -0.3, 0.4, -0.4])
    observation, *_, info = env.step(residual)
    asked = np.clip(info["law_action"] + 0.5 * residual, -0.2, 0.2)
    assert np.array_equal(observation, plain.step(asked)[0])
    assert env.action_space.high.tolist() == [0.4] * 4


@pytest.mark.filterwarnings("ignore:.*is different from the unwrapped version")
def test_it_is_an_environment_of_gymnasium_and_of_the_same_sizes(
    run: FinishedRun, tmp_path: Path
) -> None:
    check_env(ResidualAction(environment(), run), skip_render_check=True)
    other = Environment(str(SMALL), horizon=20, sensors=8)
    with pytest.raises(ValueError, match="but the environment has the shapes"):
        ResidualAction(other, run)
