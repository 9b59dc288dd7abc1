# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Frames of an environment: its state, the target and the actions. They need Matplotlib."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
from gymnasium.error import DependencyNotInstalled
from numpy.typing import NDArray

from loop_interfaces.arrays import Array
from loop_interfaces.grid import Grid
from pde_sim_node.plant import Plant

if TYPE_CHECKING:
    from matplotlib.axes import Axes

FRAMES_PER_SECOND = 20
WIDTH, HEIGHT, DOTS = 4.8, 3.2, 100
"""Inches, and pixels of an inch."""
Show = Callable[[Array], None]
"""Draws the values of a component."""


class Picture:
    """The frames of one environment, drawn on one canvas; the axes grow with what is drawn.

    A copy, or what a pickle gives, begins with a new canvas.
    """

    def __init__(self) -> None:
        self._canvas: Any = None
        self._shows: list[Show] = []
        self._bars: Any = None

    def __reduce__(self) -> tuple[type[Picture], tuple[()]]:
        return Picture, ()

    def frame(self, plant: Plant, environment: int) -> NDArray[np.uint8]:
        """What environment m of the plant looks like, (height, width, 3)."""
        field, actions = plant.states[environment], plant.actions[environment]
        if self._canvas is None:
            self._begin(plant)
        for show, values in zip(self._shows, plant.grid.fields(field), strict=True):
            show(values)
        bars, below = self._bars
        for bar, value in zip(bars, actions, strict=True):
            bar.set_height(value)
        _grow(below, actions)
        self._canvas.draw()
        drawn: NDArray[np.uint8] = np.asarray(self._canvas.buffer_rgba())[..., :3].copy()
        return drawn

    def _begin(self, plant: Plant) -> None:
        try:
            from matplotlib import rc_context
            from matplotlib.backends.backend_agg import FigureCanvasAgg
            from matplotlib.figure import Figure
        except ModuleNotFoundError as error:
            raise DependencyNotInstalled(
                "drawing needs Matplotlib: pip install 'pdeloop[report]'"
            ) from error
        grid = plant.grid
        targets = grid.fields(plant.field_target)
        show = _image if len(grid.axes) > 1 else _line
        with rc_context({"font.size": 8, "axes.spines.top": False, "axes.spines.right": False}):
            figure = Figure((WIDTH, HEIGHT), dpi=DOTS)
            # Fixed, as a layout that follows the ticks would make the pictures of an episode jump.
            figure.subplots_adjust(left=0.15, right=0.98, bottom=0.13, top=0.98, hspace=0.3)
            self._canvas = FigureCanvasAgg(figure)
            *above, below = figure.subplots(
                len(targets) + 1, 1, height_ratios=[2.0] * len(targets) + [1.0]
            )
            for axes, name, target in zip(above, grid.components, targets, strict=True):
                axes.set_ylabel(name)
                self._shows.append(show(axes, grid, target))
            bars = below.bar(np.arange(1, plant.n_a + 1), np.zeros(plant.n_a), color="C1")
            below.axhline(0.0, color="0.5", lw=0.7)
            below.set(xlabel="actuator", ylabel="action", ylim=(-0.1, 0.1))
            self._bars = bars, below


def _line(axes: Axes, grid: Grid, target: Array) -> Show:
    """A field on one axis, or a plain vector, as a line over its dashed target."""
    x = grid.axes[0].points if grid.axes else np.arange(len(target))
    axes.plot(x, target, "--", color="0.5", lw=1)
    (line,) = axes.plot(x, target, color="C0", lw=1.5)
    axes.set_ylim(_around(target))

    def show(values: Array) -> None:
        line.set_ydata(values)
        _grow(axes, values)

    return show


def _image(axes: Axes, grid: Grid, target: Array) -> Show:
    """The error of a field on several axes: the first one upwards, the others in a row."""
    rows = target.reshape(len(target), -1)
    image = axes.imshow(np.zeros_like(rows), cmap="RdBu_r", origin="lower", aspect="auto")
    largest = 0.0

    def show(values: Array) -> None:
        nonlocal largest
        error = values.reshape(rows.shape) - rows
        largest = max(largest, float(np.abs(error).max()), 1e-12)
        image.set_data(error)
        image.set_clim(-largest, largest)

    return show


def _around(values: Array) -> tuple[float, float]:
    """Limits of an axis with these values on it."""
    low, high = float(values.min()), float(values.max())
    margin = 0.1 * (high - low) or 0.1
    return low - margin, high + margin


def _grow(axes: Axes, values: Array) -> None:
    """Make the axis hold these values, so that the pictures of an episode do not jump."""
    low, high = axes.get_ylim()
    least, most = _around(values)
    if least < low or most > high:
        axes.set_ylim(min(low, least), max(high, most))
