# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The plant that the keywords of an environment ask for; each keyword is used or refused."""

from __future__ import annotations

from collections.abc import Mapping
from copy import copy
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium.envs.registration import EnvSpec

import pdeloop
from pde_sim_node.dynamics import Dynamics
from pde_sim_node.plant import Plant
from pde_sim_node.plants.loading import as_plant
from pdeloop.api import Problem
from pdeloop.messages.parameters import PROBLEM, table

Source = str | Path | Problem | Plant | Dynamics
"""The source of an environment: a problem's name or file, or a Python object."""

OTHERS = {
    "dt": "sample_time (the time that an action is held) or integration_time (the internal step)",
    "max_episode_steps": "horizon, the steps of an episode",
    "n_actions": "n_a",
    "n_envs": "num_envs",
    "n_steps": "horizon, the steps of an episode",
    "nu": "the equation's own parameter, like physical={'viscosity': 1e-3}",
    "num_envs": "gymnasium.make_vec, which makes several environments",
    "seed": "reset(seed=...), which begins with the initial field of that seed",
}
"""Names of other environments' keywords here."""


def plant_of(source: Source, parameters: Mapping[str, Any], num_envs: int) -> Plant:
    """The plant of these keywords, of `num_envs` environments.

    ValueError for a problem that does not exist, a value out of range, and a keyword that would have no
    effect on the plant.
    """
    plants_own = {spec.name for spec in PROBLEM if "P" in spec.nodes}
    known = {spec.name for spec in table()}
    for name in parameters:
        if name in OTHERS:
            raise ValueError(
                f"an environment has no parameter {name!r}; did you mean {OTHERS[name]}?"
            )
        if name in known - plants_own:
            raise ValueError(
                f"{name!r} is a parameter of the nodes or of the method that adapts a law, and has no "
                "effect on an environment; leave it out"
            )
    if isinstance(source, str | Path):
        return pdeloop.problem(source, **parameters).plant(num_envs)
    if parameters:
        raise ValueError(f"{next(iter(parameters))!r} is given with {source!r}, which has its own")
    plant = source.plant(num_envs) if isinstance(source, Problem) else as_plant(source)
    plant.reset(np.arange(num_envs))
    return plant


def penalty(given: float) -> float:
    """The divergence penalty. ValueError unless it is a finite number of 0 or more."""
    if isinstance(given, bool) or not isinstance(given, int | float | np.number):
        raise ValueError(f"divergence_penalty is {given!r}; expected a number")
    if not 0 <= given < np.inf:
        raise ValueError(f"divergence_penalty is {given!r}; expected a finite number of 0 or more")
    return float(given)


def render_mode(given: str | None) -> str | None:
    """Check the render mode. ValueError unless it is "rgb_array" or None."""
    if given not in (None, "rgb_array"):
        raise ValueError(f"render_mode is {given!r}; expected 'rgb_array' or None")
    return given


class Specified:
    """An environment whose specification has its own horizon as the limit of an episode."""

    plant: Plant
    _spec: EnvSpec | None = None

    @property
    def spec(self) -> EnvSpec | None:
        """What `gymnasium.make` made it from; its `max_episode_steps` is the horizon."""
        return self._spec

    @spec.setter
    def spec(self, given: EnvSpec | None) -> None:
        self._spec = copy(given)
        if self._spec is not None:
            self._spec.max_episode_steps = self.plant.horizon
