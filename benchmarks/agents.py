# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""`python -m benchmarks agents`: PPO, SAC and CrossQ that begin with the law of a run, and without.

An agent of stable-baselines3 with the library's defaults learns on `VecEnvironment` of the run's
problem, whose actions are bounded at the law's largest one in four rollouts, and is evaluated, without
exploring, on the fields of the run's evaluation.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from copy import deepcopy
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

import pdeloop
from benchmarks.processes import markdown, shown
from pde_sim_node.build import build_plant
from pdeloop.episode import EpisodeRecord, Law
from pdeloop.finished_run import FinishedRun
from pdeloop.messages.arrays import Array

STD = 0.05
"""Exploration of the cloned agents, the default of `warm_start`."""
SCALE = 0.1
"""Of the residual agents' actions, as in docs/deploy.md."""
STARTS = ("cold", "path", "frozen", "cloned", "residual")
"""Without a law; with a linear path that learns, or does not; with the network fitted to rollouts;
with a network that begins at 0 and adds to the law's actions."""


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
        cold, path, frozen, cloned, residual.
    rollouts
        Numbers of episodes after which an agent is evaluated.
    seeds
        Number of agents of each kind.
    """
    import torch  # of the extra rl, as the imports below

    torch.set_num_threads(1)
    law = pdeloop.load_run(folder)
    limit = float(np.abs(_rollouts(law).actions).max())
    law = replace(law, values={**law.values, "action_limit": limit})
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
    import torch
    from sb3_contrib import CrossQ  # in PyTorch, as `warm_start` needs it
    from stable_baselines3 import PPO, SAC
    from stable_baselines3.common.logger import Logger
    from stable_baselines3.common.vec_env import DummyVecEnv

    from pdeloop.environments import Environment, ResidualAction, warm_start
    from pdeloop.environments.stable_baselines import VecEnvironment

    algorithms = {"ppo": PPO, "sac": SAC, "crossq": CrossQ}
    plant = build_plant(law.values)
    batch = 4 if algorithm == "ppo" else 1
    env: Any = VecEnvironment(plant, num_envs=batch)
    if start == "residual":
        single = Environment(build_plant(law.values))
        env = DummyVecEnv(
            [lambda: ResidualAction(deepcopy(single), law, scale=SCALE) for _ in range(batch)]
        )
    own = {"n_steps": plant.horizon} if algorithm == "ppo" else {}
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "You have specified a mini-batch size")
        agent: Any = algorithms[algorithm]("MlpPolicy", env, seed=seed, device="cpu", **own)
    agent.set_logger(Logger(None, []))  # else each call of `learn` makes a folder
    if start in ("path", "frozen"):
        warm_start(agent, law)
    head = agent.policy.action_net if algorithm == "ppo" else agent.actor.mu
    if start == "frozen":
        head.law.requires_grad_(False)
    if start == "residual":
        with torch.no_grad():
            for part in head.parameters():
                part.zero_()
    if start == "cloned":
        _clone(agent, law)
    beside = law.law() if start == "residual" else None
    costs, paid = [_cost(agent, law, beside)], 0
    for budget in rollouts:
        agent.learn((budget - paid) * plant.horizon, reset_num_timesteps=False)
        paid = budget
        costs.append(_cost(agent, law, beside))
    return costs


def _rollouts(law: FinishedRun) -> EpisodeRecord:
    """Four of the law."""
    return pdeloop.rollout(build_plant(law.values), law.law(), range(4))


def _cost(agent: Any, law: FinishedRun, beside: Law | None) -> float:
    """The mean stage cost of its mean actions, beside a law or alone, on the evaluation's fields."""
    space = agent.action_space

    def acting(k: int, states: Array) -> Array:
        own = np.asarray(agent.predict(states, deterministic=True)[0], dtype=np.float64)
        if beside is None:
            return own
        asked = beside(k, states) + SCALE * own  # whose space is twice as wide as the actions'
        return np.asarray(np.clip(asked, space.low / 2.0, space.high / 2.0))

    episode = pdeloop.rollout(build_plant(law.values), acting, *law.evaluation)
    return float(episode.costs.mean.mean())


def _clone(agent: Any, law: FinishedRun, steps: int = 3000) -> None:
    """Fit the mean actions to the law's on four of its rollouts, by least squares."""
    import torch

    episode = _rollouts(law)
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
