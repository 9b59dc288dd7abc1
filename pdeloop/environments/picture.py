# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The rgb_array of an environment. It needs Matplotlib."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from gymnasium.error import DependencyNotInstalled
from numpy.typing import NDArray

from pde_sim_node.plant import Plant

if TYPE_CHECKING:
    from pdeloop.frames import Frames

FRAMES_PER_SECOND = 20


class Picture:
    """The frames of one environment, drawn on one canvas; the axes grow with the data.

    A copy, or what a pickle gives, begins with a new canvas.
    """

    def __init__(self) -> None:
        self._frames: Frames | None = None

    def __reduce__(self) -> tuple[type[Picture], tuple[()]]:
        return Picture, ()

    def frame(self, plant: Plant, environment: int) -> NDArray[np.uint8]:
        """A picture of the plant's environment m, (height, width, 3)."""
        if self._frames is None:
            try:
                from pdeloop.frames import Frames
            except ModuleNotFoundError as error:
                raise DependencyNotInstalled(
                    "drawing needs Matplotlib: pip install 'pdeloop[report]'"
                ) from error
            self._frames = Frames(plant)
        own = slice(environment, environment + 1)
        return self._frames.draw(plant.states[own], plant.actions[own], plant.step_index)
