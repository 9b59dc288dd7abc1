# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A run's law as the start of an agent of stable-baselines3."""

from __future__ import annotations

from typing import Any

import numpy as np

from pdeloop.environments.residual import ResidualAction
from pdeloop.finished_run import FinishedRun
from pdeloop.law_form import law_form


def warm_start(
    agent: Any, run: FinishedRun, which: str = "adapted", seed: int | None = None, std: float = 0.05
) -> None:
    """Make a run's law the mean action of an agent's policy.

    A linear path a = K U'y + b is put beside the policy's network, whose own output is 0 at first, and
    learns with it. The law is clipped as the action space is; of a policy with squashed actions (SAC,
    CrossQ) at 0.999 of its width. SAC then begins to act by the law instead of at random
    (`learning_starts` counts without actions drawn from the space).

    Parameters
    ----------
    agent
        A PPO, SAC or CrossQ with an MlpPolicy, not yet trained. Its environment observes what the law
        measures; its actions may be those of `RescaleAction`.
    run
        The run of the law, or `pdeloop.load_run` of its folder. The law must be affine.
    which, seed
        As for `FinishedRun.law`.
    std
        Standard deviation of the exploration, relative to half the width of the action space.

    Raises
    ------
    ValueError
        The agent is another one, its environment normalises what it observes, the law has other sizes
        or is not affine, or there is no such law or seed.
    """
    policy = getattr(agent, "policy", None)
    squashed = hasattr(getattr(policy, "actor", None), "mu")
    owner = policy.actor if squashed else policy  # type: ignore[union-attr]
    known = hasattr(owner, "log_std") and (squashed or hasattr(owner, "action_net"))
    if not known or getattr(agent, "use_sde", False) or hasattr(policy, "lstm_actor"):
        raise ValueError(
            f"the agent is {type(agent).__name__}; expected a PPO, SAC or CrossQ of stable-baselines3 "
            "with an MlpPolicy and without gSDE"
        )
    if "law" in agent.policy_kwargs:
        raise ValueError("the agent has a law already; make a new one")
    if not 0.0 < std < np.inf:
        raise ValueError(f"std is {std}; expected a positive number")
    form = law_form(run, which, seed)
    if form.kind != "affine":
        raise ValueError(
            f"the law '{run.values['law']}' has a memory, which an agent's policy has not; train with "
            "--law affine"
        )
    shapes = agent.observation_space.shape, agent.action_space.shape
    if shapes != ((form.n_y,), (form.n_a,)):
        raise ValueError(
            f"the law measures {form.n_y} numbers and has {form.n_a} actuators, but the agent's "
            f"environment has the shapes {shapes[0]} and {shapes[1]}"
        )
    own = plant_space(agent.get_env())
    # Of the plant's box to the agent's, which is [-1, 1] inside of a squashed policy.
    width, mid = (own.high - own.low) / 2.0, (own.high + own.low) / 2.0
    space = agent.action_space
    unit, offset = (space.high - space.low) / 2.0, (space.high + space.low) / 2.0
    K = form.arrays["K"] @ form.arrays["U"].T / width[:, None]
    b = (form.arrays["constant"] - mid) / width
    if not squashed:
        K, b = unit[:, None] * K, unit * b + offset
    from pdeloop.environments.law_policy import LawPolicy, add_path

    spread = std if squashed else std * float(unit.max())
    law = K, b, spread, squashed
    kind = type(policy)
    agent.policy_class = type(f"Law{kind.__name__}", (LawPolicy, kind), {})
    agent.policy_kwargs = {**agent.policy_kwargs, "law": law}
    add_path(policy, *law)
    if hasattr(agent, "learning_starts"):
        agent.learning_starts = 0


def plant_space(env: Any) -> Any:
    """The actions of the plant behind an agent's `VecEnv`; ValueError where they are not the law's."""
    from stable_baselines3.common.vec_env import VecNormalize, unwrap_vec_wrapper

    normalised = unwrap_vec_wrapper(env, VecNormalize)
    if normalised is not None and normalised.norm_obs:
        raise ValueError(
            "VecNormalize changes what the agent observes; make it with norm_obs=False, or leave it out"
        )
    if any(env.env_is_wrapped(ResidualAction)):
        raise ValueError(
            "the environment adds the law to the agent's actions (ResidualAction); use one of the two"
        )
    spaces: list[Any] = env.get_attr("action_space")
    if not hasattr(
        env.unwrapped, "environments"
    ):  # single ones, of which wrappers change the space
        spaces = [own.action_space for own in env.get_attr("unwrapped")]
    return spaces[0]
