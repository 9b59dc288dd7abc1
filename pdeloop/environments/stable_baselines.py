# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Many plants in one batch as a `VecEnv` of stable-baselines3, which has to be installed::

from stable_baselines3 import PPO
from pdeloop.environments.stable_baselines import VecEnvironment

agent = PPO("MlpPolicy", VecEnvironment("burgers", num_envs=4))
agent.learn(20_000)
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium.error import DependencyNotInstalled
from gymnasium.vector import AutoresetMode
from numpy.typing import NDArray

from pde_sim_node.plant import DIVERGED_COST
from pdeloop.environments.keywords import Source
from pdeloop.environments.signals import one
from pdeloop.environments.vector import VectorEnvironment
from pdeloop.messages.arrays import Array

try:
    from stable_baselines3.common.vec_env import VecEnv
except ImportError as error:
    raise DependencyNotInstalled(
        "VecEnvironment needs stable-baselines3: pip install 'pdeloop[rl]'"
    ) from error

__all__ = ["VecEnvironment"]

Indices = int | Iterable[int] | None


class VecEnvironment(VecEnv):  # type: ignore[misc, unused-ignore]  # untyped where it is not installed
    """M plants in one batch, which stable-baselines3 takes as it takes a `DummyVecEnv`.

    The bits are those of a `DummyVecEnv` of M environments as long as none diverges; the next episode
    of one that does is truncated together with the others'.

    Parameters
    ----------
    problem, num_envs, divergence_penalty, render_mode, parameters
        As for `pdeloop.environments.VectorEnvironment`.

    Attributes
    ----------
    environments : VectorEnvironment
        The batch.

    Raises
    ------
    ValueError
        What `VectorEnvironment` refuses.
    """

    def __init__(
        self,
        problem: Source,
        *,
        num_envs: int = 1,
        divergence_penalty: float = DIVERGED_COST,
        render_mode: str | None = None,
        **parameters: Any,
    ) -> None:
        self.environments = VectorEnvironment(
            problem,
            num_envs=num_envs,
            divergence_penalty=divergence_penalty,
            render_mode=render_mode,
            autoreset_mode=AutoresetMode.SAME_STEP,
            **parameters,
        )
        own = self.environments
        super().__init__(own.num_envs, own.single_observation_space, own.single_action_space)
        self._actions = np.zeros(own.action_space.shape or ())

    def reset(self) -> Array:
        """Begin M episodes, with the seeds and options that were set.

        Returns
        -------
        (M, state_size) array
            The states z_0, as they are measured; `reset_infos` has the rest.
        """
        states, info = self.environments.reset(seed=self._seeds, options=together(self._options))
        self.reset_infos = [one_of(info, m) for m in range(self.num_envs)]
        self._reset_seeds()
        self._reset_options()
        return states

    def step_async(self, actions: Array) -> None:
        """Take the actions of the next step, (M, n_a)."""
        self._actions = np.asarray(actions, dtype=float)

    def step_wait(self) -> tuple[Array, NDArray[np.float32], NDArray[Any], list[dict[str, Any]]]:
        """Hold the actions for a sampling time.

        Returns
        -------
        states : (M, state_size) array
            As they are measured; of an environment that has ended, those of its next episode.
        rewards : (M,) array
            As for `Environment.step`.
        dones : (M,) bool array
            Whether an environment diverged or the horizon is reached.
        infos : list of M dict
            cost, distance and target as for `Environment.step`, and TimeLimit.truncated; at the end of
            an episode its last state as terminal_observation.
        """
        states, rewards, terminated, truncated, info = self.environments.step(self._actions)
        dones, infos = terminated | truncated, []
        for m, done in enumerate(dones):
            own = one_of(info["final_info"] if done else info, m)
            if done:
                self.reset_infos[m] = one_of(info, m)
                own["terminal_observation"] = info["final_obs"][m]
            own["TimeLimit.truncated"] = bool(truncated[m] and not terminated[m])
            infos.append(own)
        return states, rewards.astype(np.float32), dones, infos

    def get_images(self) -> Sequence[NDArray[np.uint8]]:
        """A frame of each environment; `render` tiles them."""
        return self.environments.render() or ()

    def close(self) -> None:
        """Drop what `render` has kept; more than once does no harm."""
        self.environments.close()

    def get_attr(self, attr_name: str, indices: Indices = None) -> list[Any]:
        """An attribute of the batch, which is the same for each environment."""
        of_one = {"observation_space", "action_space"}
        name = f"single_{attr_name}" if attr_name in of_one else attr_name
        return [getattr(self.environments, name) for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: Indices = None) -> None:
        """Set an attribute of the batch; AttributeError if it is to be that of some environments."""
        if sorted(self._get_indices(indices)) != list(range(self.num_envs)):
            raise AttributeError(
                f"the environments are one batch, so {attr_name!r} can only be set for all of them"
            )
        setattr(self.environments, attr_name, value)

    def env_method(
        self, method_name: str, *method_args: Any, indices: Indices = None, **method_kwargs: Any
    ) -> list[Any]:
        """AttributeError: there are no single environments that have methods."""
        raise AttributeError(
            f"the environments are one batch, so {method_name!r} cannot be called for one of them; "
            "make_vec_env makes single ones"
        )

    def env_is_wrapped(self, wrapper_class: type[Any], indices: Indices = None) -> list[bool]:
        """No environment is wrapped."""
        return [False for _ in self._get_indices(indices)]


def one_of(info: Mapping[str, Any], m: int) -> dict[str, Any]:
    """The entries of environment m in a vector environment's info."""
    numbers = {name: info[name] for name in ("cost", "distance", "target")}
    return one(numbers, m)


def together(options: Sequence[Mapping[str, Any]]) -> dict[str, Any] | None:
    """The options of all environments as those of a batch. ValueError if only some have one."""
    names = {name for own in options for name in own}
    for name in names:
        if not all(name in own for own in options):
            raise ValueError(f"the option {name!r} is not given for every environment")
    return {name: np.stack([own[name] for own in options]) for name in names} or None
