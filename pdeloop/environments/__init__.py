# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The shipped problems as Gymnasium environments: `import pdeloop.environments` registers them.

>>> import gymnasium
>>> import pdeloop.environments
>>> env = gymnasium.make("pdeloop/Burgers-v0", n_z=64, measurement_noise=0.01)
>>> observation, _ = env.reset(seed=3)
>>> observation, reward, terminated, truncated, info = env.step(env.action_space.sample())
>>> observation.shape, bool(reward < 0), sorted(info)
((64,), True, ['cost', 'distance', 'target'])

An observation is the state as it is measured, an action is held for a sampling time, and the reward
is minus the stage cost, (z - z_r)'Q(z - z_r) + a'R a of the state before the step. An episode is
truncated at the horizon, and terminated where the plant diverges, which also costs a penalty.

`reset(seed=s)` begins with the initial field of seed s, so that the episode is `Plant`'s to the bit;
resets without a seed draw the seeds of further fields. `gymnasium.make_vec(..., num_envs=M)` advances
M environments in one call of the compiled step, and so does
`pdeloop.environments.stable_baselines.VecEnvironment` for stable-baselines3.

A process that has not imported this module, such as the workers of a `SubprocVecEnv`, makes an
environment by `pdeloop.environments:pdeloop/Burgers-v0`.
"""

from __future__ import annotations

import gymnasium

from pdeloop.environments.agents import warm_start
from pdeloop.environments.residual import ResidualAction
from pdeloop.environments.single import Environment
from pdeloop.environments.vector import VectorEnvironment
from pdeloop.messages.problem import shipped_problems

__all__ = ["Environment", "ResidualAction", "VectorEnvironment", "environment_id", "warm_start"]


def environment_id(problem: str) -> str:
    """The id of a shipped problem.

    Parameters
    ----------
    problem
        Its name, such as allen-cahn.

    Returns
    -------
    str
        The id for `gymnasium.make`, such as pdeloop/AllenCahn-v0.
    """
    return f"pdeloop/{''.join(word.capitalize() for word in problem.split('-'))}-v0"


for name in shipped_problems():
    gymnasium.register(
        id=environment_id(name),
        entry_point="pdeloop.environments:Environment",
        vector_entry_point="pdeloop.environments:VectorEnvironment",
        kwargs={"problem": name},
    )
