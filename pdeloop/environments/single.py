# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""One plant as a Gymnasium environment."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from pde_sim_node.plant import DIVERGED_COST
from pdeloop.environments import keywords
from pdeloop.environments.keywords import Source, Specified
from pdeloop.environments.picture import FRAMES_PER_SECOND, Picture
from pdeloop.environments.signals import (
    field_seed,
    first_fields,
    one,
    spaces,
    told,
)
from pdeloop.messages.arrays import Array


class Environment(Specified, gymnasium.Env[Array, Array]):
    """One plant.

    The action space is bounded as the plant's actions are. Without bounds the plant takes any action,
    and the space is bounded by the magnitude at which all n_a actions cost as much as the error of the
    mean initial field, so that algorithms which need a bounded space have one of a useful size.

    Parameters
    ----------
    problem
        Name or YAML file, as for `pdeloop.problem`; or a `Problem`, a `Plant`, which is then the
        environment's own, or a `Dynamics`.
    divergence_penalty
        Subtracted from the reward of the step that diverges.
    render_mode : {"rgb_array"}, optional
        How `render` draws the field, which needs Matplotlib (the extra `report`); None: not drawn.
    parameters
        As for `pdeloop.problem`, those of the plant: n_z, horizon, measurement_noise, action_limit,
        sensors, physical={"viscosity": 1e-3}, ...

    Raises
    ------
    ValueError
        There is no such problem or parameter, one that has no effect on the plant, or a value is out of
        range.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012  # as the base class declares it
        "render_modes": ["rgb_array"],
        "render_fps": FRAMES_PER_SECOND,
    }

    def __init__(
        self,
        problem: Source,
        *,
        divergence_penalty: float = DIVERGED_COST,
        render_mode: str | None = None,
        **parameters: Any,
    ) -> None:
        self.render_mode = keywords.render_mode(render_mode)
        self._penalty = keywords.penalty(divergence_penalty)
        self.plant = keywords.plant_of(problem, parameters, 1)
        self.observation_space, self.action_space = spaces(self.plant)
        self._picture = Picture()

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
        """Begin an episode.

        Parameters
        ----------
        seed
            Seed of the initial field, which is drawn if none is given.
        options
            {"field": z_0}, (n_z,), begins with this field instead.

        Returns
        -------
        observation : (state_size,) array
            z_0, as it is measured.
        info : dict
            As for `step`, with a cost of 0.

        Raises
        ------
        ValueError
            There is no such option, or the field has another shape or is not finite.
        """
        super().reset(seed=seed)
        given = first_fields(options, (self.plant.n_z,))
        if given is None:
            states = self.plant.reset([field_seed(self.np_random) if seed is None else seed])
        else:
            states = self.plant.reset(given[np.newaxis])
        return states[0].copy(), one(told(self.plant, np.zeros(1)), 0)

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
            cost: the stage cost; distance: root mean square of z_{k+1} - z_r over the grid, of the true
            field; target: z_r, as it is observed.
        """
        plant = self.plant
        plant.totals.fill(0.0)  # so that they are those of this step, to the bit
        states = plant.step(np.asarray(action)[np.newaxis])
        cost, terminated = plant.totals.copy(), bool(plant.diverged_step[0] >= 0)
        reward = -float(cost[0]) - self._penalty * terminated
        ended = plant.step_index >= plant.horizon
        return states[0].copy(), reward, terminated, ended, one(told(plant, cost), 0)

    def render(self) -> NDArray[np.uint8] | None:
        """The field, its target and the actions.

        Returns
        -------
        (height, width, 3) array of uint8, or None
            None without a `render_mode`.
        """
        return None if self.render_mode is None else self._picture.frame(self.plant, 0)

    def close(self) -> None:
        """Drop what `render` has kept; more than once does no harm."""
        self._picture = Picture()
