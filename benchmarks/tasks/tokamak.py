# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Gym-TORAX's ramp-up of ITER's hybrid scenario (`examples/plants/tokamak_gymtorax.py`).

Every episode begins alike and nothing is random. Laws are designed for the example's quadratic cost,
and measured by the environment's own return.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Iterator
from functools import partial
from typing import Any

import numpy as np

import pdeloop
from benchmarks.tasks.common import Row, shown
from pdeloop.episode import Law
from pdeloop.process.module_path import PROJECT

EXAMPLE = PROJECT / "examples" / "plants" / "tokamak_gymtorax.py"
PUBLISHED = {"open loop": "3.40", "PI on the core current density": "3.79"}
GAIN = 1
"""Where log(1 + Q) / log 11 is measured: names in the order of the alphabet are H98, Q, ..."""
PI = {"kp": 0.700, "ki": 34.257, "kd": 0.0}


def rows(budgets: list[int], seeds: int) -> Iterator[Row]:
    """The table, without budgets of five rollouts or less."""
    if importlib.util.find_spec("gymtorax") is None:
        raise ValueError("this task needs Gym-TORAX: pip install 'pdeloop[tokamak]'")
    spec = importlib.util.spec_from_file_location("tokamak_gymtorax", EXAMPLE)
    assert spec is not None and spec.loader is not None
    example = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(example)
    plant, rewarded = example.ramp(), example.rewarded()

    def row(name: str, laws: list[Law], spent: Any) -> Row:
        episodes = [pdeloop.rollout(rewarded, law, [0]) for law in laws]
        ends = [int(episode.costs.diverged_step[0]) for episode in episodes]
        if max(ends) >= 0:
            return _row(name, f"fails in step {min(end for end in ends if end >= 0) + 1}", spent)
        declared = [pdeloop.rollout(plant, law, [0], keep=False).costs.mean[0] for law in laws]
        measures = {
            "declared cost": shown(declared, digits=4),
            "largest Q": shown(
                [11.0 ** own.states[:, 0, GAIN].max() - 1.0 for own in episodes], digits=3
            ),
        }
        returns = shown([-episode.costs.total[0] for episode in episodes], np.min)
        return _row(name, returns, spent, **measures)

    for name, figure in PUBLISHED.items():
        yield _row(name, figure, 0, by="Gym-TORAX, torax 1.0")
    # In the order of the keys: beam, current, waves.
    heated = np.array([[1.0, 0.0, 1.0]])
    yield row("open loop", [lambda k, z: heated], 0)
    yield row("the same without heating", [lambda k, z: np.zeros((1, 3))], 0)
    yield pi(example)
    parts = ("exploration", "check", "adaptation")
    for i, budget in enumerate(budget for budget in budgets if budget > 5):
        train = partial(pdeloop.train, plant=plant, rollouts=budget, evaluation_fields=1)
        runs = [train(seed=seed) for seed in range(seeds)]
        if i == 0:
            explored = max(run.rollouts[0]["exploration"] for run in runs)
            yield row("`pdeloop.train`, its first law", [run.law("lqt") for run in runs], explored)
        spent = max(sum(run.rollouts[0][part] for part in parts) for run in runs)
        yield row("`pdeloop.train`", [run.law() for run in runs], spent)


def pi(example: Any) -> Row:
    """The agent of the package in the environment itself."""
    from gymtorax import PIDAgent

    env = example.scenario().env
    agent = PIDAgent(env.action_space, lambda t: 0.6e6 + 14e3 * min(t, 100), 0.2e6, **PI)
    (observation, _), total = env.reset(seed=0), 0.0
    for k in range(150):
        action = {name: np.array(a, float) for name, a in agent.act(observation).items()}
        observation, reward, *_ = env.step(action)
        if reward == example.FAILED:
            return _row("PI of the package", f"fails in step {k + 1}", 0)
        total += reward
    return _row("PI of the package", shown(total), 0)


def _row(
    name: str, figure: str, spent: Any, *, by: str = "here, torax 1.4.3", **measures: str
) -> Row:
    known = {"declared cost": "", "largest Q": "", **measures}
    return {"controller": name, "return": figure, **known, "episodes": spent, "by": by}
