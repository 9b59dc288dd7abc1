# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""What actions do to the states, and a first law to the cost, for `pdeloop check`."""

from __future__ import annotations

import numpy as np

from loop_interfaces.arrays import Array
from pde_sim_node.plant import Plant

LITTLE = 0.02
"""Share of the cost without control; a law that changes it by less does next to nothing."""


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


def judged(none: float, law: float) -> tuple[bool, str]:
    """Whether a first law helps, from mean costs without control and with it, and what to do if not.

    >>> judged(10.0, 2.0)
    (True, '')
    """
    if not none:
        return False, (
            "nothing is to be controlled, as these fields are at the target; draw others, or set "
            "another target"
        )
    if abs(none - law) < LITTLE * none:
        return law < none, (
            "the law does next to nothing: its actions hardly move the states, are dear (lower "
            "action_weight), or cannot reach the target"
        )
    if law < none:
        return True, ""
    return False, "the adaptation begins with a law that does not help; try another order"
