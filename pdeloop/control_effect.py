# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""What actions do to the states, and a first law to the cost, for `pdeloop check`."""

from __future__ import annotations

import numpy as np

from pde_sim_node.plant import Plant
from pde_sim_node.plants.dynamics_plant import DynamicsPlant
from pdeloop.messages.arrays import Array

LITTLE = 0.02
"""Share of the cost without control; a law that changes it by less does next to nothing."""
SMALL = 1e-6
"""Size of actions, relative to the explored ones, within any bounds."""
SOME_BEYOND, MOST_BEYOND = 0.05, 0.5
"""Shares of the exploratory actions beyond the bounds that are worth a note, and too many."""


MORE = 10.0
"""Factor of actions that are tried where the explored ones do nothing."""


def idle_actuators(plant: Plant, states: Array, actions: Array) -> list[int]:
    """The actuators that move none of the states (N, n_z) in a step, each with its actions (N, n_a)."""
    still = plant.evaluate(states, np.zeros_like(actions))[0]
    idle = []
    for j in range(plant.n_a):
        alone = np.zeros_like(actions)
        alone[:, j] = actions[:, j]
        if np.array_equal(plant.evaluate(states, alone)[0], still):
            idle.append(j)
    return idle


def without_effect(plant: Plant, states: Array, actions: Array) -> str:
    """Which actuators, by explored actions (N, n_a), move no state (N, n_z), and what to do."""
    idle = idle_actuators(plant, states, actions)
    if not idle:
        return ""
    every = len(idle) == plant.n_a
    if set(idle) - set(idle_actuators(plant, states, MORE * actions)):
        which = "no explored action moves" if every else f"explored actions of {idle} do not move"
        return (
            f"{which} the state, larger ones do: set an exploration_variance beyond what the actuators "
            "do not answer to"
        )
    which = "no action moves" if every else f"actuators {idle} do not move"
    return f"{which} the state: check how step uses its argument a"


def beyond_bounds(plant: Plant, actions: Array) -> tuple[bool, str]:
    """Whether bounds of a user's actuators change few of the actions (N, n_a), and how many, in words.

    Empty where next to none are. What they do to small actions too models know, as they know declared
    bounds.
    """
    if not (isinstance(plant, DynamicsPlant) and plant.actuated):
        return True, ""
    linear = plant.applied(SMALL * actions) / SMALL
    changed = ~np.isclose(plant.applied(actions), linear, rtol=1e-6, atol=1e-9)
    share = float(changed.any(axis=1).mean())
    told = (
        f"{100 * share:.0f} % of the exploratory actions exceed the bounds of `actuated`, which the "
        "models do not include: lower exploration_variance"
    )
    return share <= MOST_BEYOND, told if share > SOME_BEYOND else ""


def judged(none: float, law: float, *, compared: bool = False) -> tuple[bool, str]:
    """Whether a first law will do, from mean costs without control and with it, and what to do if not.

    compared: the optimiser compares it with no control itself, and need not begin with it.

    >>> judged(10.0, 2.0)
    (True, '')
    """
    if not none:
        return False, (
            "there is nothing to control, as these fields are at the target; draw others, or set "
            "another target"
        )
    if abs(none - law) < LITTLE * none:
        return law < none or compared, (
            "the law has almost no effect: its actions hardly move the states, are expensive "
            "(lower action_weight), or cannot reach the target"
        )
    if law < none:
        return True, ""
    if compared and np.isfinite(none):
        return (
            True,
            "the law does not help; the adaptation compares it with no control, and designs others",
        )
    return False, "the adaptation begins with a law that does not help; try another order"
