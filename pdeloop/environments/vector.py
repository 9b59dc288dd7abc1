# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Many plants in one batch as a vector environment of Gymnasium."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from gymnasium.utils.seeding import np_random
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from pde_sim_node.plant import DIVERGED_COST
from pdeloop.environments import keywords
from pdeloop.environments.keywords import Source, Specified
from pdeloop.environments.picture import FRAMES_PER_SECOND, Picture
from pdeloop.environments.signals import (
    field_seed,
    first_fields,
    masked,
    seed_of_each,
    spaces,
    told,
)
from pdeloop.messages.arrays import Array

Flags = NDArray[np.bool_]


class VectorEnvironment(Specified, VectorEnv[Array, Array, NDArray[Any]]):
    """M plants in one batch, each as an `Environment`.

    All share one horizon: where a plant diverges, its next episode is truncated together with the
    others'. Until then the bits are those of M single environments with the seeds s, s + 1, ...

    Parameters
    ----------
    problem, divergence_penalty, render_mode, parameters
        As for `Environment`.
    num_envs
        M.
    autoreset_mode : {"NextStep", "SameStep", "Disabled"}
        When an environment that has ended begins again, as in Gymnasium's own vector environments: with
        the next step, in the same step, or when `reset` is called.

    Raises
    ------
    ValueError
        num_envs is not a whole number of 1 or more, there is no such mode, or what `Environment`
        refuses.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012
        "render_modes": ["rgb_array"],
        "render_fps": FRAMES_PER_SECOND,
        "autoreset_mode": AutoresetMode.NEXT_STEP,
    }

    def __init__(
        self,
        problem: Source,
        *,
        num_envs: int = 1,
        divergence_penalty: float = DIVERGED_COST,
        render_mode: str | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        **parameters: Any,
    ) -> None:
        if isinstance(num_envs, bool) or not isinstance(num_envs, int | np.integer) or num_envs < 1:
            raise ValueError(f"num_envs is {num_envs!r}; expected a whole number of 1 or more")
        self.num_envs = int(num_envs)
        self.render_mode = keywords.render_mode(render_mode)
        self._penalty = keywords.penalty(divergence_penalty)
        self._mode = mode_of(autoreset_mode)
        self.metadata = {**self.metadata, "autoreset_mode": self._mode}
        self.plant = keywords.plant_of(problem, parameters, self.num_envs)
        self.single_observation_space, self.single_action_space = spaces(self.plant)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self._generators = [np_random()[0] for _ in range(self.num_envs)]
        self._ended = np.zeros(self.num_envs, dtype=np.bool_)
        self._everybody = np.ones(self.num_envs, dtype=np.bool_)
        self._pictures = [Picture() for _ in range(self.num_envs)]

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[Array, dict[str, Any]]:
        """Begin M episodes.

        Parameters
        ----------
        seed
            s of the initial fields s, s + 1, ..., or a list of M; without one they are drawn.
        options
            {"field": z_0}, (M, n_z), begins with these fields instead; {"reset_mask": mask}, (M,) bool,
            begins only those environments again.

        Returns
        -------
        observations : (M, state_size) array
            The states z_0, as they are measured.
        info : dict
            As for `step`, with costs of 0.

        Raises
        ------
        ValueError
            There are not M seeds, or an option does not exist or does not fit.
        """
        options = dict(options or {})
        mask = reset_mask(options.pop("reset_mask", None), self.num_envs)
        fields = first_fields(options, (self.num_envs, self.plant.n_z))
        seeds = seed_of_each(seed, self.num_envs)
        if not (mask.all() or self.plant.step_index < self.plant.horizon):
            raise ValueError(
                f"the {self.num_envs} environments share a horizon, which has been reached: "
                "reset_mask must choose all of them"
            )
        return self._begin(mask, seeds, fields), masked(self._told_at_first(), mask)

    def step(
        self, actions: Array
    ) -> tuple[Array, NDArray[Any], NDArray[Any], NDArray[Any], dict[str, Any]]:
        """Hold the actions for a sampling time.

        Parameters
        ----------
        actions : (M, n_a) array
            a_k; those of environments that begin again with this step do not count.

        Returns
        -------
        observations : (M, state_size) array
            The states z_{k+1}, as they are measured.
        rewards : (M,) array
            As for `Environment.step`.
        terminated, truncated : (M,) bool arrays
            Whether an environment diverged, and whether the horizon is reached.
        info : dict
            cost, distance (M,) and target (M, state_size) as for `Environment.step`, each with a mask.
            final_obs and final_info of environments that begin again in the step that ended them.

        Raises
        ------
        RuntimeError
            Environments have ended and begin again only with `reset`.
        """
        plant, again = self.plant, self._ended.copy()
        if self._mode is AutoresetMode.DISABLED and again.any():
            raise RuntimeError(
                f"environments {np.flatnonzero(again).tolist()} have ended: call "
                "reset(options={'reset_mask': ...})"
            )
        if again.all():
            states, info = self.reset()
            nobody = np.zeros(self.num_envs, dtype=np.bool_)
            return states, np.zeros(self.num_envs), nobody, nobody.copy(), info
        plant.totals.fill(0.0)
        states = plant.step(actions)
        if again.any():
            states = plant.restart(
                np.flatnonzero(again), self._fields(again, [None] * self.num_envs)
            )
        terminated = plant.diverged_step >= 0
        truncated = np.full(self.num_envs, plant.step_index >= plant.horizon)
        rewards = -plant.totals - self._penalty * terminated
        found = told(plant, plant.totals.copy())
        self._ended = terminated | truncated
        if self._mode is not AutoresetMode.SAME_STEP or not self._ended.any():
            return states.copy(), rewards, terminated, truncated, masked(found, self._everybody)
        return self._begun_again(states.copy(), found, rewards, terminated, truncated)

    def _begun_again(
        self,
        last: Array,
        found: dict[str, Array],
        rewards: Array,
        terminated: Flags,
        truncated: Flags,
    ) -> tuple[Array, Array, Flags, Flags, dict[str, Any]]:
        """The result of `step` where some environments begin again in the same step."""
        ended = self._ended.copy()
        states = self._begin(ended, [None] * self.num_envs, None)
        first = self._told_at_first()
        now = {name: np.where(_column(ended, v), first[name], v) for name, v in found.items()}
        final = np.full(self.num_envs, None, dtype=object)
        for m in np.flatnonzero(ended):
            final[m] = last[m]
        finals = {
            "final_obs": final,
            "_final_obs": ended,
            "final_info": masked(found, ended),
            "_final_info": ended.copy(),
        }
        info = {**masked(now, self._everybody), **finals}
        return states, rewards, terminated, truncated, info

    def _begin(self, mask: Flags, seeds: Sequence[int | None], fields: Array | None) -> Array:
        """Begin these environments again; the states now."""
        chosen = np.flatnonzero(mask)
        for m in chosen.tolist():
            if seeds[m] is not None:
                self._generators[m] = np_random(seeds[m])[0]
        given = self._fields(mask, seeds) if fields is None else fields[chosen]
        states = self.plant.reset(given) if mask.all() else self.plant.restart(chosen, given)
        self._ended[mask] = False
        return states.copy()

    def _fields(self, mask: Flags, seeds: Sequence[int | None]) -> list[int]:
        """The seeds of the fields of these environments, drawn where none is given."""
        known = [(m, seeds[m]) for m in np.flatnonzero(mask).tolist()]
        return [field_seed(self._generators[m]) if seed is None else seed for m, seed in known]

    def _told_at_first(self) -> dict[str, Array]:
        return told(self.plant, np.zeros(self.num_envs))

    def render(self) -> tuple[NDArray[np.uint8], ...] | None:
        """A frame of each environment, as `Environment.render` draws it.

        Returns
        -------
        tuple of (height, width, 3) uint8 arrays, or None
            None without a `render_mode`.
        """
        if self.render_mode is None:
            return None
        return tuple(picture.frame(self.plant, m) for m, picture in enumerate(self._pictures))

    def close_extras(self, **kwargs: Any) -> None:
        """Drop what `render` has kept.

        Parameters
        ----------
        kwargs
            Not used; Gymnasium's interface has it.
        """
        self._pictures = [Picture() for _ in range(self.num_envs)]


def _column(mask: Flags, values: Array) -> Flags:
    """The mask in the shape of values of one or more numbers for each environment."""
    return mask if values.ndim == 1 else mask[:, np.newaxis]


def mode_of(given: AutoresetMode | str) -> AutoresetMode:
    """The mode that a word stands for. ValueError if there is none."""
    try:
        return AutoresetMode(given)
    except ValueError as error:
        words = ", ".join(mode.value for mode in AutoresetMode)
        raise ValueError(f"autoreset_mode is {given!r}; expected one of {words}") from error


def reset_mask(given: Any, num_envs: int) -> Flags:
    """The mask of environments to reset; all if not given. ValueError for another mask."""
    if given is None:
        return np.ones(num_envs, dtype=np.bool_)
    mask = np.asarray(given)
    if mask.shape != (num_envs,) or mask.dtype != np.bool_ or not mask.any():
        raise ValueError(
            f"options['reset_mask'] must be an array of {num_envs} booleans, one of them True, "
            f"got {given!r}"
        )
    return mask
