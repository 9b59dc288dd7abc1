# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The parameters of a problem with those of its plant, and the order of a model of few readings."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from pde_sim_node.build import complete
from pde_sim_node.plant import Plant
from pde_sim_node.plants.dynamics_plant import DynamicsPlant
from pdeloop.exploration_scale import scaled_exploration
from pdeloop.messages.action_set import ActionSet
from pdeloop.messages.arrays import Array
from pdeloop.messages.own_code import OwnCodeError
from pdeloop.messages.parameters import LAW
from pdeloop.messages.problem import find_problem, read_problem
from pdeloop.messages.spec import flatten
from pdeloop.method.models.sensed import SENSED_MOST
from pdeloop.method.reduce.input_delay import LATEST
from tuner_node.build import few_sensors
from tuner_node.optimizer_parameters import training_parameters

RESTS = 1e-9
"""Change of a state in a step, in units of the divergence bound, that rounding explains."""


def problem_values(name: str, options: Mapping[str, Any]) -> tuple[Plant, dict[str, Any]]:
    """The plant of a problem and its resolved parameters; nothing is compiled.

    ValueError if the plant cannot be built from them.
    """
    given = flatten(options)
    plant, values = complete(training_parameters(name, given), compiled=False)
    constants = plant.cost.target.ndim > 1 or _needs_offset(plant)  # which the plant itself may say
    if constants:
        values |= training_parameters(name, given, constants=True)
    late = training_parameters(name, given, constants=constants, late=True)
    other = late[LAW.name] != values[LAW.name] and not values["model"]
    if other and _acts_late(plant, values):
        values |= late
    resting, limits = plant.cost.action_target, (plant.action_set.low, plant.action_set.high)
    limited = any(np.isfinite(limit).any() for limit in limits)
    around = limited and resting.any() and not values["exploration_mean"]
    if around:
        values["exploration_mean"] = plant.action_set.inside(resting).tolist()
    if scaled := scaled_exploration(plant, values):
        values |= scaled
        if around:
            within = ActionSet.of({**values, "exploration_mean": []}).inside(resting)
            values["exploration_mean"] = within.tolist()
    if _is_order_sought(name, given, plant, values):
        values["reduced_order"] = 0
    return plant, values


def _needs_offset(plant: Plant) -> bool:
    """Whether a target of 0, where K_b s_r is 0, needs actions other than 0.

    They have a target of their own, or a plant of one's own leaves the state 0 by itself.
    """
    true = getattr(plant, "plant", plant)
    if plant.target.any():
        return False
    if plant.cost.action_target.any():
        return True
    if not (isinstance(true, DynamicsPlant) and true.settable):
        return False
    try:
        after, _ = true.evaluate(np.zeros((1, plant.n_z)), np.zeros((1, plant.n_a)))
    except OwnCodeError:  # a training says so where it matters
        return False
    return bool(np.abs(after).max() > RESTS * true.divergence_bound)


def _acts_late(plant: Plant, values: Mapping[str, Any]) -> bool:
    """Whether an action changes no state in the step that it is held in, but in a later one.

    Of a plant with a state of its own, from one initial state, with actions of the explored size.
    """
    true, admissible = getattr(plant, "plant", plant), ActionSet.of(values)
    if true.settable:
        return False
    size = np.sqrt(values["exploration_variance"] or admissible.exploration_variance)
    idle, *tried = admissible.explored(size * np.eye(1 + plant.n_a, plant.n_a, k=-1))

    def states(first: Array, steps: int) -> Array:
        true.reset(np.zeros(1, dtype=np.int64))
        return np.stack([true.step((idle if k else first)[None]) for k in range(steps)])

    steps = min(1 + LATEST, plant.horizon)
    try:
        rests = states(idle, 1)
        still = [first for first in tried if np.array_equal(states(first, 1), rests)]
        rests = states(idle, steps) if still else rests
        return any(not np.array_equal(states(first, steps), rests) for first in still)
    except OwnCodeError:  # a training says so where it matters
        return False


def _is_order_sought(
    name: str, given: Mapping[str, Any], plant: Plant, values: Mapping[str, Any]
) -> bool:
    """Whether held-out readings choose the order of a model of the readings.

    The order in a problem's file is that of a model of the whole state, unless the file identifies from
    readings. Where a model of the field between the sensors may follow, it suffices for the first law.
    """
    if values["identification"] != "subspace" or values["model"] or "reduced_order" in given:
        return False
    file = read_problem(find_problem(name)) if name else {}
    if not few_sensors(values) or file.get("identification") == "subspace":
        return False
    grid, most = plant.grid, SENSED_MOST
    between = grid.is_circle and len(grid.components) == 1
    return not (between and values["sensors"] <= most and values["sensor_delays"] == 1)
