# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""PPO and SAC of stable-baselines3 and CrossQ of sbx, for `python -m benchmarks baselines`.

An agent learns on `VecEnvironment`, in episodes that begin with fields of the training's seed. They
are paid for like any rollout, as are the exploration and the check if it is told what they found. The
result is its deterministic policy after the last update within the budget.

There are two ways to inform an agent (`agent`):

- "plain": it observes the whole field, and actions of magnitude 1 are `reach` times the bound of the
  environment's action space, which follows from the cost (`pdeloop.environments`). Its reward is
  -`reward` times the stage cost. Nothing is identified.
- "informed": it observes e = U'(z - z_r), U of the reduced model that all methods know, divided by its
  root mean square in the rollout of the check; actions of magnitude 1 are `reach` times the largest one
  of LQ tracking there, and its reward is -`reward` times the stage cost over the mean one there.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np
from gymnasium.spaces import Box
from numpy.typing import NDArray
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.vec_env import VecEnvWrapper
from torch import set_num_threads

from benchmarks.methods import training_field
from benchmarks.warm_start import warm_start
from pde_sim_node.build import build_plant
from pdeloop.environments.signals import mean_field_error
from pdeloop.environments.stable_baselines import VecEnvironment
from pdeloop.episode import Law
from pdeloop.in_process import LocalPair
from pdeloop.messages.arrays import Array
from pdeloop.messages.model_rows import unpack

PENALTY = 100.0
"""The cost of a diverged episode, in stage costs of the mean initial field."""


class Signals(NamedTuple):
    """An agent's observations of states (M, state_size), and the units of its actions and reward.

    paid: rollouts that this took to find out.
    """

    observe: Callable[[Array], NDArray[np.float32]]
    bound: float
    unit: float
    paid: int


def plain(values: Mapping[str, Any], pair: LocalPair, environment_bound: float) -> Signals:
    """The whole field, the bound of the environment, and the stage cost as it is."""
    return Signals(lambda states: np.asarray(states, dtype=np.float32), environment_bound, 1.0, 0)


def informed(values: Mapping[str, Any], pair: LocalPair, environment_bound: float) -> Signals:
    """The reduced error and the actions of LQ tracking, and its mean stage cost."""
    training = warm_start(values, pair)
    assert training.models is not None
    plant, U = pair.plant, unpack(training.models[0], values["n_a"]).U
    check = training.measured[0][-1]
    error = check.states - plant.target
    scale = np.sqrt(np.mean((error @ U) ** 2, axis=0))
    steps = len(check.actions)
    state_cost = values["state_weight"] * np.sum(error[:steps] ** 2)
    cost = (state_cost + values["action_weight"] * np.sum(check.actions**2)) / steps

    def observe(states: Array) -> NDArray[np.float32]:
        return np.asarray((states - plant.target) @ U / scale, dtype=np.float32)

    bound = float(np.abs(check.actions).max())
    return Signals(observe, bound, float(cost), int(training.budget.paid[0]))


AGENTS = {"plain": plain, "informed": informed}


class Episodes(VecEnvWrapper):  # type: ignore[misc, unused-ignore]  # untyped where it is not installed
    """The plants as an agent sees them; `ended` counts their episodes."""

    def __init__(self, plants: VecEnvironment, signals: Signals, reward: float) -> None:
        self._signals, self._factor = signals, reward / signals.unit
        first = signals.observe(plants.reset())
        super().__init__(
            plants,
            Box(-np.inf, np.inf, first.shape[1:], np.float32),
            Box(-1.0, 1.0, plants.action_space.shape, np.float32),
        )
        self.ended = 0

    def reset(self) -> NDArray[np.float32]:
        return self._signals.observe(self.venv.reset())

    def step_async(self, actions: Array) -> None:
        self.venv.step_async(self._signals.bound * np.asarray(actions, dtype=float))

    def step_wait(self) -> tuple[NDArray[np.float32], Array, Array, list[dict[str, Any]]]:
        states, rewards, dones, infos = self.venv.step_wait()
        self.ended += int(dones.sum())
        for info in infos:
            if "terminal_observation" in info:
                last = self._signals.observe(info["terminal_observation"][np.newaxis])
                info["terminal_observation"] = last[0]
        return self._signals.observe(states), self._factor * rewards, dones, infos


def off_policy(algorithm: str) -> Any:
    """The class of "sac" or "crossq"."""
    if algorithm == "sac":
        return SAC
    from sbx import CrossQ  # sb3-contrib has it too; this one takes a third of its processor time

    return CrossQ


def learn(
    values: Mapping[str, Any],
    algorithm: str,
    *,
    agent: str = "plain",
    reach: float = 1.0,
    reward: float = 1.0,
    environments: int = 1,
    episodes: int = 1,
    log_std_init: float = 0.0,
    **constants: Any,
) -> tuple[LocalPair, Law, int]:
    """The law of an agent after the rollouts of the budget, as of `benchmarks.methods.METHODS`.

    Parameters
    ----------
    values
        Resolved parameters.
    algorithm
        "ppo", "sac" or "crossq".
    agent, reach, reward
        As above.
    environments
        How many plants are advanced at the same time.
    episodes, log_std_init
        Of PPO: episodes of an update, a multiple of `environments`, and the logarithm of the first
        standard deviation.
    constants
        What the library's agent is called with; else its defaults.
    """
    set_num_threads(1)
    pair, plant = LocalPair(values), build_plant(values)
    horizon = plant.horizon
    plants = VecEnvironment(
        plant, num_envs=environments, divergence_penalty=PENALTY * mean_field_error(plant)
    )
    signals = AGENTS[agent](values, pair, float(plants.action_space.high[0]))
    signals = signals._replace(bound=reach * signals.bound)
    told = Episodes(plants, signals, reward)
    update = episodes if algorithm == "ppo" else environments
    own = {"policy": "MlpPolicy", "env": told, "seed": values["seed"], "device": "cpu", **constants}
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "You have specified a mini-batch size")
        made: Any = (
            PPO(
                n_steps=horizon * episodes // environments,
                policy_kwargs={"log_std_init": log_std_init},
                **own,
            )
            if algorithm == "ppo"
            else off_policy(algorithm)(**own)
        )
    made.set_logger(Logger(None, []))  # else each call of `learn` makes a folder
    told.seed(training_field(values, 0))
    while signals.paid + told.ended + update <= values["rollouts"]:
        made.learn(horizon * update, reset_num_timesteps=False)

    def law(k: int, states: Array) -> Array:
        actions, _ = made.predict(signals.observe(states), deterministic=True)
        return signals.bound * np.asarray(actions, dtype=float)

    return pair, law, signals.paid + told.ended
