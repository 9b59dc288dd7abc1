# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""PPO and SAC of stable-baselines3 on the Gymnasium environments: costs against rollouts.

It needs PyTorch, and so an environment of its own (docs/comparison.md), and is no part of any extra.

An episode begins with a field of the training's seed, and is paid for like any rollout, as are the
exploration and the check before it. What the agent is told and may do is chosen in its favour:

- observed is e = U'(z - z_r), U of the reduced model that all methods know, divided by the root mean
  square in the rollouts of the check, instead of the whole field;
- actions of magnitude 1 are `reach` times the largest one of LQ tracking there;
- rewards are `scale` under LQ tracking, on the average; a diverged episode costs `PENALTY` of those.

Its deterministic policy is measured on the validation and the test fields as it learns, which counts as
no rollout.
"""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.baselines import BUDGETS, TEST, VALIDATION, pairs
from benchmarks.methods import evaluation_fields, training_field
from benchmarks.warm_start import warm_start
from loop_interfaces.arrays import Array
from loop_interfaces.files import make_folder, write_atomically
from loop_interfaces.model_rows import unpack
from pdeloop.environments import VectorEnvironment
from pdeloop.episode import Law, projected_law, rollout
from pdeloop.in_process import LocalPair
from pdeloop.training_run import resolve

PENALTY = 100.0
MARKS = (20, 40, 80, 160, 320, 640, 1280, 2560, 5120, 10240, 20480, 40960)
"""Rollouts after which the policy is measured."""
CONSTANTS: dict[str, dict[str, Any]] = {
    "ppo": {"scale": 0.01, "policy_kwargs": {"log_std_init": -1.5}},
    "sac": {"scale": 1.0},
}
"""What is not the default of the library or of `run`."""


def run(
    problem: str = "burgers",
    *,
    algorithm: str = "ppo",
    seed: int = 0,
    minutes: float = 20.0,
    rollouts: int = MARKS[-1],
    settings: Sequence[str] = (),
    folder: Path | None = None,
) -> dict[str, Any]:
    """One learning curve, which ends where the policy costs less than LQ tracking, or with the time.

    The budgets of `benchmarks.baselines` are measured in any case.

    Parameters
    ----------
    problem
        What is controlled.
    algorithm
        "ppo" or "sac".
    seed
        Of the training, as in the other methods.
    minutes
        Of processor time, at most.
    rollouts
        Of the plant, at most.
    settings
        Words NAME=JSON: `reach`, `environments` (how many are advanced in a batch), `scale`, or what
        the library's agent is called with.
    folder
        That of `benchmarks.baselines`, for the costs after its budgets.

    Raises
    ------
    ValueError
        The library is not installed, or there is no such algorithm.
    """
    try:
        import stable_baselines3  # noqa: F401
        import torch
    except ModuleNotFoundError as error:
        raise ValueError(
            f"this needs {error.name}, which no extra installs: see docs/comparison.md"
        ) from error
    torch.set_num_threads(1)
    if algorithm not in CONSTANTS:
        raise ValueError(f"algorithm is {algorithm!r}; expected {' or '.join(CONSTANTS)}")
    constants = {"reach": 1.0, "environments": 4, **CONSTANTS[algorithm], **pairs(settings)}
    reach, environments, reward = (constants.pop(n) for n in ("reach", "environments", "scale"))
    values = resolve(problem, {"seed": seed, "seeds": 1})
    pair = LocalPair(values)
    training = warm_start(values, pair)
    assert training.models is not None
    plant, U = pair.plant, unpack(training.models[0], values["n_a"]).U
    known = training.measured[0][-1]  # of the check of LQ tracking
    scale = np.sqrt(np.mean(((known.states - plant.target) @ U) ** 2, axis=0))
    bound: float = reach * float(np.abs(known.actions).max())

    def observe(states: Array) -> Array:
        return np.asarray((states - plant.target) @ U / scale, dtype=np.float32)

    def measured(law: Law, split: int) -> list[float]:
        seeds = evaluation_fields({**values, "evaluation_seed": split})
        costs: list[float] = rollout(plant, law, seeds, keep=False).costs.mean.tolist()
        return costs

    lqt = measured(projected_law(plant, U, training.starts()[0]), VALIDATION)
    unit = float(np.mean(lqt))
    source = VectorEnvironment(problem, num_envs=environments, divergence_penalty=PENALTY * unit)
    first = [training_field(values, m) for m in range(environments)]
    episodes = batch_of_episodes(source, first, observe, bound, unit / reward)
    agent = make_agent(algorithm, episodes, seed, plant.horizon, constants)

    def law(k: int, states: Array) -> Array:
        return bound * np.asarray(
            agent.predict(observe(states), deterministic=True)[0], dtype=float
        )

    marks = [mark for mark in MARKS if mark <= rollouts]
    began, rows, best = time.process_time(), [], np.inf
    while marks and time.process_time() - began < 60 * minutes:
        if best < unit and marks[0] > BUDGETS[-1]:
            break
        paid = int(training.budget.paid[0]) + episodes.ended
        if paid + environments > marks[0]:
            mark = marks.pop(0)
            cost, tested = float(np.mean(measured(law, VALIDATION))), measured(law, TEST)
            best = min(best, cost)
            minute = (time.process_time() - began) / 60
            rows.append(
                {"rollouts": paid, "minutes": minute, "cost": cost, "test": float(np.mean(tested))}
            )
            print(f"{algorithm} {problem} {rows[-1]}", file=sys.stderr, flush=True)
            if folder is not None and mark in BUDGETS:
                place = folder / problem / str(mark) / values["problem"] / algorithm / str(seed)
                result = {"rollouts": [{"total": paid}], "costs_by_field": {"adapted": [tested]}}
                make_folder(place)
                write_atomically(place / "result.json", json.dumps(result).encode())
        agent.learn(environments * plant.horizon, reset_num_timesteps=False)
    given = {"problem": problem, "algorithm": algorithm, "seed": seed, "settings": list(settings)}
    return {**given, "lqt": unit, "rows": rows}


def make_agent(
    algorithm: str, episodes: Any, seed: int, horizon: int, constants: Mapping[str, Any]
) -> Any:
    """The agent; what is not said here is the library's default."""
    from stable_baselines3 import PPO, SAC

    common = {"policy": "MlpPolicy", "env": episodes, "seed": seed}
    batch = horizon * episodes.num_envs
    if algorithm == "sac":
        return SAC(**{**common, "learning_starts": batch, **constants})
    # An update after each batch of episodes.
    return PPO(**{**common, "n_steps": horizon, "batch_size": batch // 4, **constants})


def batch_of_episodes(
    source: VectorEnvironment,
    first: Sequence[int],
    observe: Callable[[Array], Array],
    bound: float,
    unit: float,
) -> Any:
    """The batch as a VecEnv of stable-baselines3, which begins anew in the step that ends an episode.

    `ended` counts the episodes. One that diverges begins anew a step later than the library thinks.
    """
    from gymnasium.spaces import Box
    from stable_baselines3.common.vec_env import VecEnv

    class Episodes(VecEnv):  # type: ignore[misc]  # untyped where the library is not installed
        def __init__(self) -> None:
            n_s = observe(source.reset(seed=first)[0]).shape[1]
            actions = Box(-1.0, 1.0, source.single_action_space.shape, np.float32)
            super().__init__(len(first), Box(-np.inf, np.inf, (n_s,), np.float32), actions)
            self.ended = 0
            self._actions = np.zeros((len(first), *actions.shape))

        def reset(self) -> Array:
            return observe(source.reset(seed=first if not self.ended else None)[0])

        def step_async(self, actions: Array) -> None:
            self._actions = bound * np.clip(np.asarray(actions, dtype=float), -1.0, 1.0)

        def step_wait(self) -> tuple[Array, Array, Array, list[dict[str, Any]]]:
            states, rewards, terminated, truncated, _ = source.step(self._actions)
            seen, ended = observe(states), terminated | truncated
            infos: list[dict[str, Any]] = [{} for _ in ended]
            for m in np.flatnonzero(ended):
                infos[m] = {
                    "terminal_observation": seen[m],
                    "TimeLimit.truncated": bool(truncated[m] and not terminated[m]),
                }
            self.ended += int(ended.sum())
            if ended.all():
                seen = observe(source.reset()[0])
            return seen, (rewards / unit).astype(np.float32), ended, infos

        def close(self) -> None:
            source.close()

        def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
            return [getattr(source, attr_name, None)] * self.num_envs

        def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
            raise AttributeError(f"a batch has no single environments to set {attr_name} of")

        def env_method(self, method_name: str, *args: Any, indices: Any = None, **kw: Any) -> Any:
            raise AttributeError(f"a batch has no single environments to call {method_name} of")

        def env_is_wrapped(self, wrapper_class: Any, indices: Any = None) -> list[bool]:
            return [False] * self.num_envs

    return Episodes()


def text(result: dict[str, Any]) -> str:
    """The curve as a Markdown table."""
    lines = [f"LQT: {result['lqt']:.4g}", "", "| rollouts | minutes | validation | test |"]
    lines += ["|---" * 4 + "|"]
    for row in result["rows"]:
        numbers = f"{row['minutes']:.1f} | {row['cost']:.4g} | {row['test']:.4g}"
        lines.append(f"| {row['rollouts']} | {numbers} |")
    return "\n".join(lines)
