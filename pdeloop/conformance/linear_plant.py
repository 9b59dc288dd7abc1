# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The linear plant that `pdeloop check controller` plays. Pure."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from pdeloop.messages.arrays import Array
from pdeloop.messages.frames import Frame
from pdeloop.messages.topics import COMPLETED


class LinearPlant:
    """Advection and diffusion on a ring, z+ = A z + B a; one mode grows. number: fingerprint."""

    def __init__(self, number: int, n_z: int, n_a: int) -> None:
        rng = np.random.default_rng(number)
        self.number, self.n_z, self.target = number, n_z, rng.uniform(0.2, 0.8, n_z)
        shift = np.roll(np.eye(n_z), 1, axis=0)
        self.A = 0.75 * np.eye(n_z) + 0.2 * shift + 0.06 * shift.T
        self.B = rng.standard_normal((n_z, n_a)) / np.sqrt(n_z)


@dataclass(frozen=True)
class Explored:
    """An exploratory episode: its start, and states and actions of steps 0 to T."""

    start: Frame
    plant: LinearPlant
    states: Array
    actions: Array

    def cost(self, ended: float = COMPLETED) -> Frame:
        """Its cost. ended: in each row."""
        steps, mean = len(self.states) - 1, 1e9 if ended >= 0 else 1.0
        rows = np.tile([mean, steps * mean, ended], (len(self.start.values), 1))
        return replace(self.start, step=steps, values=rows, plant=self.plant.number)
