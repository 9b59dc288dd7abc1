# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""An environment whose agent corrects a law: residual reinforcement learning.

Source: Johannink et al., "Residual Reinforcement Learning for Robot Control", ICRA 2019.
"""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np

from pdeloop.finished_run import FinishedRun
from pdeloop.messages.arrays import Array


class ResidualAction(gymnasium.Wrapper[Array, Array, Array, Array]):
    """Adds a run's law to the actions of an agent.

        a_k = P(law(y_k) + scale r_k)

    with the nearest action P(a) of the environment's space. An agent that answers r = 0 is the law.

    Parameters
    ----------
    env
        The environment, whose observations are what the law was trained to measure.
    run
        The run of the law, or `pdeloop.load_run` of its folder.
    which, seed
        As for `FinishedRun.law`.
    scale
        Factor of the residual r, whose space is as wide as that of the actions.

    Raises
    ------
    ValueError
        The law is of other sizes than the environment, or there is no such law or seed.

    Examples
    --------
    >>> import gymnasium, pdeloop, pdeloop.environments
    >>> run = pdeloop.train("burgers", optimizer="two_point", rollouts=5)
    >>> env = pdeloop.environments.ResidualAction(gymnasium.make("pdeloop/Burgers-v0"), run)
    >>> observation, _ = env.reset(seed=0)
    >>> observation, reward, *_ = env.step(np.zeros(env.action_space.shape))
    """

    def __init__(
        self,
        env: gymnasium.Env[Any, Any],
        run: FinishedRun,
        which: str = "adapted",
        seed: int | None = None,
        scale: float = 1.0,
    ) -> None:
        super().__init__(env)
        sizes = len(run.models[0].U), int(run.values["n_a"])
        own = env.observation_space.shape, env.action_space.shape
        if own != ((sizes[0],), (sizes[1],)):
            raise ValueError(
                f"the law measures {sizes[0]} numbers and has {sizes[1]} actuators, but the "
                f"environment has the shapes {own[0]} and {own[1]}"
            )
        space = env.action_space
        assert isinstance(space, gymnasium.spaces.Box)
        self._low, self._high = space.low, space.high
        width = np.asarray(space.high - space.low)
        residuals: Any = gymnasium.spaces.Box(-width, width, dtype=width.dtype.type)
        self.action_space = residuals
        self._law, self._scale, self._k = run.law(which, seed), scale, 0
        self._measured: Array = np.zeros(sizes[0])

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
        """Begin an episode.

        Parameters
        ----------
        seed, options
            As for the environment.

        Returns
        -------
        observation : (n_y,) array
        info : dict
        """
        observation, info = self.env.reset(seed=seed, options=options)
        self._measured, self._k = np.asarray(observation, dtype=np.float64), 0
        return observation, info

    def step(self, action: Array) -> tuple[Array, Any, bool, bool, dict[str, Any]]:
        """Act by the law and the residual.

        Parameters
        ----------
        action : (n_a,) array
            r_k.

        Returns
        -------
        observation : (n_y,) array
        reward : float
        terminated, truncated : bool
        info : dict
            That of the environment, and `law_action`, the law's own (n_a,).
        """
        own = self._law(self._k, self._measured[np.newaxis])[0]
        asked = np.clip(own + self._scale * np.asarray(action), self._low, self._high)
        observation, reward, terminated, truncated, info = self.env.step(asked)
        self._measured, self._k = np.asarray(observation, dtype=np.float64), self._k + 1
        return observation, reward, terminated, truncated, {**info, "law_action": own}
