# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The shipped problems as Gymnasium environments: `import pdeloop.environments` registers them.

>>> import gymnasium
>>> import pdeloop.environments
>>> env = gymnasium.make("pdeloop/Burgers-v0", n_z=64, measurement_noise=0.01)
>>> observation, _ = env.reset(seed=3)
>>> observation, reward, terminated, truncated, _ = env.step(env.action_space.sample())
>>> observation.shape, bool(reward < 0)
((64,), True)

An observation is the state as it is measured, an action is held for a sampling time, and the reward
is minus the stage cost, (z - z_r)'Q(z - z_r) + a'R a of the state before the step. An episode is
truncated at the horizon, and terminated where the plant diverges, which costs a penalty besides.

`reset(seed=s)` begins with the initial field of seed s, so that the episode is `Plant`'s to the bit;
resets without a seed draw the seeds of further fields. `gymnasium.make_vec(..., num_envs=M)` advances
M environments in one call of the compiled step.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Space
from gymnasium.utils.seeding import np_random
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

import pdeloop
from loop_interfaces.arrays import Array
from loop_interfaces.problem import shipped_problems
from pde_sim_node.plant import DIVERGED_COST, Plant

__all__ = ["Environment", "VectorEnvironment", "environment_id"]


class Environment(gymnasium.Env[Array, Array]):
    """One plant.

    Parameters
    ----------
    problem
        Name or YAML file, as of `pdeloop.problem`.
    divergence_penalty
        Subtracted from the reward of the step that diverges.
    parameters
        As of `pdeloop.problem`: n_z, horizon, measurement_noise, action_limit, sensors, ...

    Raises
    ------
    ValueError
        There is no such problem or parameter, or a value is out of range.
    """

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012  # as the base class declares it

    def __init__(
        self, problem: str, *, divergence_penalty: float = DIVERGED_COST, **parameters: Any
    ) -> None:
        self.plant = pdeloop.problem(problem, **parameters).plant()
        self.observation_space, self.action_space = spaces(self.plant)
        self._penalty = penalty(divergence_penalty)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
        """Begin an episode.

        Parameters
        ----------
        seed
            Of the initial field; without one it is drawn.
        options
            Not used.

        Returns
        -------
        observation : (state_size,) array
            z_0, as it is measured.
        info : dict
            Empty.
        """
        super().reset(seed=seed)
        states = self.plant.reset([field_seed(self.np_random) if seed is None else seed])
        return states[0].copy(), {}

    def step(self, action: Array) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        """Hold the action for a sampling time.

        Parameters
        ----------
        action : (n_a,) array
            a_k.

        Returns
        -------
        observation : (state_size,) array
            z_{k+1}, as it is measured.
        reward : float
            Minus the stage cost of z_k and a_k, and minus the penalty if the plant diverged.
        terminated, truncated : bool
            Whether the plant diverged, and whether the horizon is reached.
        info : dict
            Empty.
        """
        plant = self.plant
        plant.totals.fill(0.0)  # so that they are those of this step, to the bit
        states = plant.step(np.asarray(action)[np.newaxis])
        terminated = bool(plant.diverged_step[0] >= 0)
        reward = -float(plant.totals[0]) - self._penalty * terminated
        return states[0].copy(), reward, terminated, plant.step_index >= plant.horizon, {}


class VectorEnvironment(VectorEnv[Array, Array, NDArray[Any]]):
    """M plants in one batch, each as an `Environment`; ended ones begin again with the next step.

    All share one horizon: where a plant diverges, its next episode is truncated together with the
    others'. Until then the bits are those of M single environments with the seeds s, s + 1, ...

    Parameters
    ----------
    problem, divergence_penalty, parameters
        As of `Environment`.
    num_envs
        M.

    Raises
    ------
    ValueError
        num_envs is no whole number of 1 or more, or what `Environment` refuses.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012
        "render_modes": [],
        "autoreset_mode": AutoresetMode.NEXT_STEP,
    }

    def __init__(
        self,
        problem: str,
        *,
        num_envs: int = 1,
        divergence_penalty: float = DIVERGED_COST,
        **parameters: Any,
    ) -> None:
        if not isinstance(num_envs, int) or num_envs < 1:
            raise ValueError(f"num_envs is {num_envs!r}; expected a whole number of 1 or more")
        self.num_envs = num_envs
        self.plant = pdeloop.problem(problem, **parameters).plant(num_envs)
        self.single_observation_space, self.single_action_space = spaces(self.plant)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._penalty = penalty(divergence_penalty)
        self._generators = [np_random()[0] for _ in range(num_envs)]
        self._ended = np.zeros(num_envs, dtype=np.bool_)

    def reset(
        self,
        *,
        seed: int | Sequence[int] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[Array, dict[str, Any]]:
        """Begin M episodes.

        Parameters
        ----------
        seed
            s of the initial fields s, s + 1, ..., or a list of M; without one they are drawn.
        options
            Not used.

        Returns
        -------
        observations : (M, state_size) array
            The states z_0, as they are measured.
        info : dict
            Empty.

        Raises
        ------
        ValueError
            A list of other than M seeds.
        """
        if seed is None:
            seeds = self._field_seeds(range(self.num_envs))
        else:
            given = np.atleast_1d(seed).tolist()
            seeds = given if np.ndim(seed) else [given[0] + m for m in range(self.num_envs)]
            if len(seeds) != self.num_envs:
                raise ValueError(f"expected {self.num_envs} seeds, one for each, got {len(seeds)}")
            self._generators = [np_random(own)[0] for own in seeds]
        self._ended[:] = False
        return self.plant.reset(seeds).copy(), {}

    def step(
        self, actions: Array
    ) -> tuple[Array, NDArray[Any], NDArray[Any], NDArray[Any], dict[str, Any]]:
        """Hold the actions for a sampling time.

        Parameters
        ----------
        actions : (M, n_a) array
            a_k; those of ended environments do not count.

        Returns
        -------
        observations : (M, state_size) array
            The states z_{k+1}, as they are measured.
        rewards : (M,) array
            As of `Environment.step`.
        terminated, truncated : (M,) bool arrays
            Whether an environment diverged, and whether the horizon is reached.
        info : dict
            Empty.
        """
        plant, again = self.plant, np.flatnonzero(self._ended)
        if len(again) == self.num_envs:
            states, info = self.reset()
            none = np.zeros(self.num_envs, dtype=np.bool_)
            return states, np.zeros(self.num_envs), none, none.copy(), info
        plant.totals.fill(0.0)
        states = plant.step(actions)
        if again.size:
            states = plant.restart(again, self._field_seeds(again))
        terminated = plant.diverged_step >= 0
        truncated = np.full(self.num_envs, plant.step_index >= plant.horizon)
        self._ended = terminated | truncated
        rewards = -plant.totals - self._penalty * terminated
        return states.copy(), rewards, terminated, truncated, {}

    def _field_seeds(self, environments: Sequence[int] | NDArray[np.int64]) -> list[int]:
        return [field_seed(self._generators[m]) for m in environments]


def field_seed(generator: np.random.Generator) -> int:
    """The seed of the next initial field."""
    return int(generator.integers(2**53))


def penalty(given: float) -> float:
    """The divergence penalty. ValueError unless it is a finite number of 0 or more."""
    if not 0 <= given < np.inf:
        raise ValueError(f"divergence_penalty is {given!r}; expected a finite number of 0 or more")
    return given


def spaces(plant: Plant) -> tuple[Space[Any], Space[Any]]:
    """Of an observation (state_size,) and of an action (n_a,)."""
    own = plant.instruments
    bound = np.inf if own.measurement_noise or own.sensors else plant.divergence_bound
    limit = own.action_limit or np.inf
    observation = Box(-bound, bound, (plant.state_size,), np.float64)
    return observation, Box(-limit, limit, (plant.n_a,), np.float64)


def environment_id(problem: str) -> str:
    """The id of a shipped problem.

    Parameters
    ----------
    problem
        Its name, like allen-cahn.

    Returns
    -------
    str
        Of `gymnasium.make`, like pdeloop/AllenCahn-v0.
    """
    return f"pdeloop/{''.join(word.capitalize() for word in problem.split('-'))}-v0"


for name in shipped_problems():
    gymnasium.register(
        id=environment_id(name),
        entry_point="pdeloop.environments:Environment",
        vector_entry_point="pdeloop.environments:VectorEnvironment",
        kwargs={"problem": name},
    )
