# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""`python -m benchmarks agents`: PPO, SAC and CrossQ that begin with the law of a run, and without.

An agent of stable-baselines3 with the library's defaults learns on `VecEnvironment` of the run's
problem and is evaluated, without exploring, on the fields of the run's evaluation.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

import pdeloop
from benchmarks.processes import markdown, shown
from pde_sim_node.build import build_plant
from pdeloop.finished_run import FinishedRun
from pdeloop.messages.arrays import Array

STD = 0.05
"""Exploration of the cloned agents, the default of `warm_start`."""
STARTS = ("cold", "path", "frozen", "cloned")
"""Without a law; with a linear path that learns, or does not; with the network fitted to rollouts."""


def run(
    folder: Path,
    *,
    algorithms: Sequence[str] = ("ppo",),
    starts: Sequence[str] = ("cold", "path"),
    rollouts: Sequence[int] = (20, 80),
    seeds: int = 3,
) -> dict[str, Any]:
    """Train agents, and evaluate each after the given numbers of rollouts.

    Parameters
    ----------
    folder
        The run of the law.
    algorithms
        ppo, sac, crossq.
    starts
        cold, path, frozen, cloned.
    rollouts
        Numbers of episodes after which an agent is evaluated.
    seeds
        Number of agents of each kind.
    """
    import torch  # of the extra rl, as the imports below

    torch.set_num_threads(1)
    law = pdeloop.load_run(folder)
    rows = []
    for algorithm in algorithms:
        for start in starts:
            costs = np.array(
                [_learn(law, algorithm, start, sorted(rollouts), seed) for seed in range(seeds)]
            )
            after = dict(zip(("0", *map(str, sorted(rollouts))), costs.T.tolist(), strict=True))
            rows.append({"algorithm": algorithm, "start": start, "costs": after})
    return {"law": float(law.costs["adapted"].mean()), "rows": rows}


def _learn(
    law: FinishedRun, algorithm: str, start: str, rollouts: Sequence[int], seed: int
) -> list[float]:
    """Costs at the beginning and after each number of rollouts."""
    from sb3_contrib import CrossQ  # in PyTorch, as `warm_start` needs it
    from stable_baselines3 import PPO, SAC
    from stable_baselines3.common.logger import Logger

    from pdeloop.environments import warm_start
    from pdeloop.environments.stable_baselines import VecEnvironment

    algorithms = {"ppo": PPO, "sac": SAC, "crossq": CrossQ}
    plant = build_plant(law.values)
    batch = 4 if algorithm == "ppo" else 1
    env = VecEnvironment(plant, num_envs=batch)
    own = {"n_steps": plant.horizon} if algorithm == "ppo" else {}
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "You have specified a mini-batch size")
        agent: Any = algorithms[algorithm]("MlpPolicy", env, seed=seed, device="cpu", **own)
    agent.set_logger(Logger(None, []))  # else each call of `learn` makes a folder
    if start in ("path", "frozen"):
        warm_start(agent, law)
    if start == "frozen":
        head = agent.policy.action_net if algorithm == "ppo" else agent.actor.mu
        head.law.requires_grad_(False)
    if start == "cloned":
        _clone(agent, law)
    costs, paid = [_cost(agent, law)], 0
    for budget in rollouts:
        agent.learn((budget - paid) * plant.horizon, reset_num_timesteps=False)
        paid = budget
        costs.append(_cost(agent, law))
    return costs


def _cost(agent: Any, law: FinishedRun) -> float:
    """The mean stage cost of its mean actions on the evaluation's fields."""

    def acting(k: int, states: Array) -> Array:
        return np.asarray(agent.predict(states, deterministic=True)[0], dtype=np.float64)

    episode = pdeloop.rollout(build_plant(law.values), acting, *law.evaluation)
    return float(episode.costs.mean.mean())


def _clone(agent: Any, law: FinishedRun, steps: int = 3000) -> None:
    """Fit the mean actions to the law's on four of its rollouts, by least squares."""
    import torch

    episode = pdeloop.rollout(build_plant(law.values), law.law(), range(4))
    states = episode.states[:-1].reshape(-1, episode.states.shape[-1])
    actions = agent.policy.scale_action(episode.actions.reshape(len(states), -1))
    squashed = hasattr(agent, "actor")
    if not squashed:
        actions = episode.actions.reshape(len(states), -1)
    y, a = (torch.as_tensor(x, dtype=torch.float32) for x in (states, actions))
    chosen = agent.actor if squashed else agent.policy
    optimizer, draw = torch.optim.Adam(chosen.parameters(), 1e-3), np.random.default_rng(0)
    for _ in range(steps):
        rows = draw.integers(0, len(y), 256)
        mean = (
            agent.actor(y[rows], deterministic=True)
            if squashed
            else agent.policy.get_distribution(y[rows]).distribution.mean
        )
        loss = ((mean - a[rows]) ** 2).mean()
        optimizer.zero_grad(), loss.backward(), optimizer.step()
    space = agent.action_space
    with torch.no_grad():
        if squashed:
            agent.actor.log_std.weight.zero_(), agent.actor.log_std.bias.fill_(np.log(STD))
            agent.learning_starts = 0
        else:
            agent.policy.log_std.fill_(float(np.log(STD * (space.high - space.low).max() / 2)))


def text(result: dict[str, Any]) -> str:
    """Mean costs over the seeds, and the worst one's."""
    counts = [*result["rows"][0]["costs"]]
    head = ("algorithm", "start", *(f"{count} rollouts" for count in counts))
    rows = [
        (
            row["algorithm"],
            row["start"],
            *(f"{shown(float(np.mean(c)))} ({shown(max(c))})" for c in row["costs"].values()),
        )
        for row in result["rows"]
    ]
    return f"law {shown(result['law'])}; mean over the seeds (worst)\n\n" + markdown(head, rows)
