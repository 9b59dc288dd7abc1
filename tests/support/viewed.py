# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Messages of a loop that a viewer is handed."""

from __future__ import annotations

from typing import Any

import numpy as np

from pdeloop.messages.frames import Frame
from pdeloop.messages.topics import COMPLETED

PLANT = 7


def frame(values: Any, *, step: int = 0, episode: int = 1, run: int = 5, dt: float = 0.1) -> Frame:
    array = np.array(values, dtype=np.float64)
    return Frame(run, episode, step, dt * step, array, PLANT)


def state(step: int, *, batch: int = 2, n_z: int = 4, episode: int = 1, run: int = 5) -> Frame:
    """u = 100 environment + step + point / 10: every number says where it belongs."""
    m, i = np.ogrid[:batch, :n_z]
    return frame(100 * m + step + i / 10, step=step, episode=episode, run=run)


def start(rows: Any, *, episode: int = 1, run: int = 5) -> Frame:
    return frame(rows, episode=episode, run=run)


def cost(
    means: Any, *, ended: int = COMPLETED, episode: int = 1, step: int = 3, run: int = 5
) -> Frame:
    rows = [[mean, step * mean, ended] for mean in means]
    return frame(rows, step=step, episode=episode, run=run)
