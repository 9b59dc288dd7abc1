# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Signals between an environment and its agent: the spaces, `info`, and initial fields."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from numbers import Integral
from typing import Any

import numpy as np
from gymnasium.spaces import Box, Space
from numpy.typing import NDArray

from pde_sim_node.plant import MEAN_FIELD, Plant
from pdeloop.messages.arrays import Array, float_array


def spaces(plant: Plant) -> tuple[Space[Any], Space[Any]]:
    """The spaces of an observation (state_size,) and of an action (n_a,)."""
    own = plant.instruments
    bound = np.inf if own.measurement_noise or own.sensors else plant.divergence_bound
    low, high = (np.broadcast_to(b, plant.n_a).copy() for b in bounds_of(plant))
    observation = Box(-bound, bound, (plant.state_size,), np.float64)
    return observation, Box(low, high, (plant.n_a,), np.float64)


def bounds_of(plant: Plant) -> tuple[Array, Array]:
    """The actuators' bounds; where there are none, `action_scale` from 0 or the other bound."""
    low, high = plant.action_set.low, plant.action_set.high
    if np.isfinite([low, high]).all():
        return low, high
    scale = action_scale(plant)
    least = np.where(np.isfinite(low), low, np.minimum(high, 0.0) - scale)
    return least, np.where(np.isfinite(high), high, np.maximum(low, 0.0) + scale)


def action_scale(plant: Plant) -> float:
    """The magnitude at which all n_a actions cost as much as the error of the mean initial state.

    b with b^2 1'R1 = (z_0 - z_r)'Q(z_0 - z_r): a law that costs less than no control seldom leaves
    [-b, b]. 1 if that state is the target. The plant begins an episode.
    """
    _, of_ones = plant.evaluate(plant.field_target[np.newaxis], np.ones((1, plant.n_a)))
    return float(np.sqrt(mean_field_error(plant) / of_ones[0])) or 1.0


def mean_field_error(plant: Plant) -> float:
    """(z_0 - z_r)'Q(z_0 - z_r) of the mean initial state. The plant begins an episode."""
    batch = plant.batch
    plant.reset([MEAN_FIELD])
    _, costs = plant.evaluate(plant.states, np.zeros((1, plant.n_a)))
    if batch:
        plant.reset(np.arange(batch))
    return float(costs[0])


def told(plant: Plant, costs: Array) -> dict[str, Array]:
    """The `info` of each environment.

    cost (M,): the stage cost of the step that ended; distance (M,): root mean square over the grid of
    z - z_r, of the field itself; target (M, state_size), read-only: z_r as it is observed.
    """
    now, seen, cost = plant.field_target, plant.target, plant.cost
    if cost.target.ndim > 1 and cost.output is None:  # it moves
        now = seen = cost.wanted(plant.step_index)
    error = plant.states - now
    distance = np.sqrt(np.einsum("mi,mi->m", error, error) / plant.n_z)
    target = np.broadcast_to(seen, (len(costs), plant.state_size))
    return {"cost": costs, "distance": distance, "target": target}


def one(info: Mapping[str, Array], m: int) -> dict[str, Any]:
    """The info of environment m, with Python numbers."""
    return {
        name: value[m].copy() if value.ndim > 1 else float(value[m]) for name, value in info.items()
    }


def masked(info: Mapping[str, Array], mask: NDArray[np.bool_]) -> dict[str, Any]:
    """The info of the environments of a mask, in the form of Gymnasium's vector environments.

    Zeros elsewhere, and with each entry `name` its mask `_name`.
    """
    found: dict[str, Any] = {}
    whole = mask.all()
    for name, value in info.items():
        kept = value if whole else np.where(mask if value.ndim == 1 else mask[:, None], value, 0.0)
        found[name], found[f"_{name}"] = kept, mask.copy()
    return found


def field_seed(generator: np.random.Generator) -> int:
    """The seed of the next initial field."""
    return int(generator.integers(2**53))


def seed_of_each(seed: int | Sequence[int | None] | None, num_envs: int) -> list[int | None]:
    """s, s + 1, ..., or those of a list; None: to be drawn. ValueError unless there are M."""
    if seed is None:
        return [None] * num_envs
    if isinstance(seed, Integral):
        return [int(seed) + m for m in range(num_envs)]
    given: list[int | None] = np.asarray(seed, dtype=object).ravel().tolist()
    if len(given) != num_envs:
        raise ValueError(f"expected {num_envs} seeds, one per environment, got {len(given)}")
    return given


def first_fields(options: Mapping[str, Any] | None, shape: tuple[int, ...]) -> Array | None:
    """The initial fields that the options of a reset give. ValueError for other options or shapes."""
    others = sorted(set(options or {}) - {"field"})
    if others:
        raise ValueError(f"unknown option {others[0]!r} of reset; expected 'field'")
    if not options:
        return None
    field = float_array("options['field']", options["field"])
    if field.shape != shape:
        raise ValueError(f"options['field'] must have shape {shape}, got {field.shape}")
    return field
