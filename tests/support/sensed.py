# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Models of fields of which a few points are measured, with actuators that are alike."""

from __future__ import annotations

import numpy as np

from pdeloop.messages.arrays import Array
from pdeloop.method.models.sensed import Actuators, SensedModel

SENSORS = 8


def places_of(sensors: int) -> Array:
    return (np.arange(sensors) + 0.5) / sensors


PLACES = places_of(SENSORS)


def equally_spaced(n_a: int) -> Actuators:
    return Actuators((np.arange(n_a) + 0.5) / n_a, np.zeros(n_a))


def readings_of(model: SensedModel, actions: Array, field: Array) -> Array:
    """(T, n_y), from an initial field."""
    z, seen = field[None], []
    for action in actions:
        seen.append(model.observation @ z[0])
        z = model.step(z, action[None])
    return np.array(seen)


DECLARED = Actuators((np.arange(3) + 0.5) / 3, np.full(3, 0.5 / 3))
