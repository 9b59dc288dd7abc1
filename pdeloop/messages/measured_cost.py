# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The cost as a law knows it that is given readings in place of the state."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from pdeloop.messages.cost import Cost
from pdeloop.messages.grid import Grid


def measured_cost(values: Mapping[str, Any]) -> list[str]:
    """The texts of the parameter `cost`, of what the plant publishes.

    With few sensors that is o = sqrt(n_z / (n_y d)) [y_k, y_{k-1}, ...], and the state in the cost is
    the one that the newest readings suggest (`Grid.between`), or without outputs its distance from the
    target the one that theirs suggest: the target is known between the sensors, too.

    values: parameters of a plant or a run.
    """
    texts = list(values.get("cost", ()))
    sensors, delays = int(values.get("sensors", 0)), int(values.get("sensor_delays", 1))
    cost = Cost.parse(texts)
    if cost is None or cost.plain or not sensors:
        return texts
    text = str(values.get("grid", ""))
    grid = Grid.parse(text) if text else Grid(numbers=cost.n_z)
    between, target = grid.between(sensors), None
    newest = between / math.sqrt(grid.points / (sensors * delays))
    older = np.zeros((cost.n_z, newest.shape[1] * (delays - 1)))
    if cost.output is None:
        target = cost.target[..., grid.measured(sensors)] @ between.T
    return cost.through(np.hstack([newest, older]), target).packed
