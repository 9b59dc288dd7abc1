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
resets without a seed draw the seeds of further fields. `gymnasium.make_vec(..., num_envs=M)` makes
Gymnasium's own vector environments of them.
"""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Space
from numpy.typing import NDArray

import pdeloop
from loop_interfaces.problem import shipped_problems
from pde_sim_node.measurement import InstrumentedPlant
from pde_sim_node.plant import DIVERGED_COST, Plant

__all__ = ["Environment", "environment_id"]

Array = NDArray[np.float64]


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
        if not 0 <= divergence_penalty < np.inf:
            raise ValueError(
                f"divergence_penalty is {divergence_penalty!r}; expected a finite number of 0 or more"
            )
        self.plant = pdeloop.problem(problem, **parameters).plant()
        self.observation_space, self.action_space = spaces(self.plant)
        self._penalty = divergence_penalty

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
        field = int(self.np_random.integers(2**53)) if seed is None else seed
        states = self.plant.reset([field])
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


def spaces(plant: Plant) -> tuple[Space[Any], Space[Any]]:
    """Of an observation (state_size,) and of an action (n_a,)."""
    bound, limit = plant.divergence_bound, 0.0
    if isinstance(plant, InstrumentedPlant):
        limit = plant.instruments.action_limit
        if plant.instruments.measurement_noise or plant.instruments.sensors:
            bound = np.inf
    observation = Box(-bound, bound, (plant.state_size,), np.float64)
    return observation, Box(-(limit or np.inf), limit or np.inf, (plant.n_a,), np.float64)


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
        kwargs={"problem": name},
    )
