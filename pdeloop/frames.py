# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Pictures of a plant at an instant: fields, target, actuators, sensors and actions. Needs Matplotlib.

The animation of a run (`pdeloop.animation`) and Gymnasium's rgb_array are made of them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from pde_sim_node.plant import Plant
from pdeloop.messages.arrays import Array
from pdeloop.messages.colour_scale import field_range
from pdeloop.messages.grid import middle
from pdeloop.report import planes
from pdeloop.report.places import beside, mark_places, moving_target
from pdeloop.report.style import field_image

DOTS = 100
"""Pixels of an inch."""
STYLE: dict[Any, Any] = {
    "font.family": "DejaVu Sans",
    "font.size": 8,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.linewidth": 0.7,
}
Show = Callable[[int, Array], None]
"""Draws a component at step k."""


class Frames:
    """Draws plants of one kind side by side on one canvas, each picture in place of the one before.

    plant: whose grid, target, actuators and sensors they are; titles: one for each that is drawn;
    colours: of their curves and actions; fields ((C, T + 1, n_z), optional): all that will be drawn:
    then the axes hold them from the first picture on, and fields on one axis are also drawn in space
    and time. Otherwise the axes grow with the data; largest: magnitude of the actions that the axes
    hold from the first picture on.
    """

    def __init__(
        self,
        plant: Plant,
        titles: Sequence[str] = ("",),
        colours: Sequence[str] = ("C0",),
        *,
        fields: Array | None = None,
        largest: float = 0.0,
    ) -> None:
        self._plant, self._fields, self._moving = plant, fields, moving_target(plant)
        grid, count = plant.grid, len(titles)
        self._flat = len(grid.axes) > 1
        kept = 0 if fields is None else 1
        rows = len(grid.parts) * (1 if self._flat else 1 + kept)
        with rc_context(STYLE):
            wide = 2.2 if self._flat or count > 1 else 4.0
            high = 1.75 if self._flat else 1.3
            figure = Figure((wide * count + 2.0 * self._flat + 0.9, high * rows + 1.6), dpi=DOTS)
            # Fixed, as a layout that follows the ticks would make the pictures of an episode jump.
            width, height = figure.get_size_inches()
            figure.subplots_adjust(
                left=0.62 / width,
                right=1 - 0.55 / width,
                bottom=0.45 / height,
                top=1 - 0.55 / height,
                hspace=0.62,
                wspace=0.28,
            )
            self._canvas: Any = FigureCanvasAgg(figure)
            axes = figure.subplots(
                rows + 1, count + self._flat, squeeze=False, height_ratios=[high] * rows + [1.0]
            )
            self._shows: list[list[Show]] = [[] for _ in titles]
            self._bars: list[tuple[Any, Axes]] = []
            for c, (title, colour) in enumerate(zip(titles, colours, strict=True)):
                for i in range(len(grid.parts)):
                    own = axes[i * rows // len(grid.parts) :, c].tolist()
                    self._shows[c].append(self._begin(own, c, i, colour))
                axes[0, c].set_title(title, fontsize=9)
                self._bars.append(_actions(axes[-1, c], plant, colour, largest))
            self._pictures = self._targets(axes[:, -1].tolist()) if self._flat else []
            for ax in axes[:, 1:count].ravel() if count > 1 else ():
                ax.set_ylabel("")
                ax.tick_params(labelleft=False)
            self._time = figure.text(0.62 / width, 1 - 0.2 / height, "", va="center", fontsize=9)

    def draw(self, states: Array, actions: Array, step: int) -> NDArray[np.uint8]:
        """The picture of states (C, n_z) at a step and the actions (C, n_a) taken there.

        Returns (height, width, 3): red, green and blue of each pixel.
        """
        grid = self._plant.grid
        for shows, state in zip(self._shows, states, strict=True):
            for i, show in enumerate(shows):
                show(step, grid.fields(state)[i] if self._flat else state[grid.part(i)])
        if self._moving is not None:
            target = grid.fields(self._moving[step])
            for picture, values in zip(self._pictures, target, strict=False):
                picture.set_data(middle(values))
        for (bars, ax), own in zip(self._bars, actions, strict=True):
            for bar, value in zip(bars, own, strict=True):
                bar.set_height(value)
            _grow(ax, own)
        self._time.set_text(f"t = {step * self._plant.sample_time:.3g} s")
        with rc_context(STYLE):  # in which ticks are made
            self._canvas.draw()
        return np.asarray(self._canvas.buffer_rgba())[..., :3].copy()

    def _begin(self, axes: Sequence[Axes], column: int, component: int, colour: str) -> Show:
        """A component of the field in one column, on the first of these axes or the first two."""
        if self._flat:
            return self._plane(axes[0], component)
        line = self._line(axes[0], column, component, colour)
        if self._fields is None:
            return line
        past = self._past(axes[1], column, component)

        def show(k: int, values: Array) -> None:
            line(k, values)
            past(k, values)

        return show

    def _line(self, ax: Axes, column: int, component: int, colour: str) -> Show:
        """A field on one axis, or a plain vector, as a curve over its dashed target."""
        grid, target = self._plant.grid, self._target(component)
        mark_places(ax, self._plant, component)
        (name, own, axis), moving = grid.parts[component], self._moving
        (dashes,) = ax.plot(axis.points, target, "--", color="0.45", lw=1)
        (line,) = ax.plot(axis.points, target, color=colour, lw=1.5)
        ax.set(ylabel=name, xlabel=axis.label, xlim=(0, axis.length))
        ax.set_ylim(_around(self._span(component)))
        if self._fields is not None:
            with np.errstate(invalid="ignore"):
                _grow(ax, self._fields[..., own])

        def show(k: int, values: Array) -> None:
            line.set_ydata(values)
            if moving is not None:
                dashes.set_ydata(moving[min(k, len(moving) - 1), own])
            _grow(ax, values)

        return show

    def _past(self, ax: Axes, column: int, component: int) -> Show:
        """The same in space and time, up to the current step."""
        assert self._fields is not None
        _, own, axis = self._plant.grid.parts[component]
        whole = self._fields[column, :, own].T
        end = self._plant.sample_time * (whole.shape[1] - 1)
        limits = field_range(self._fields[..., own], self._span(component))
        so_far = np.full_like(whole, np.nan)
        extent = (0.0, end, 0.0, axis.length)
        drawn = field_image(ax, so_far, extent, limits)
        ax.set_facecolor("0.88")
        ax.set(ylabel=axis.label, xlabel="t (s)")

        def show(k: int, values: Array) -> None:
            so_far[:, : k + 1], so_far[:, k + 1 :] = whole[:, : k + 1], np.nan
            drawn.set_data(so_far)

        if column == len(self._fields) - 1 and self._moving is None:
            beside(ax, self._target(component), limits, axis.length)
        return show

    def _plane(self, ax: Axes, component: int) -> Show:
        """A field on several axes as a picture; without `fields` its range grows."""
        grid, target = self._plant.grid, self._span(component)
        own = grid.part(component)
        known = np.empty(0) if self._fields is None else self._fields[..., own]
        low, high = field_range(known, target)
        if self._fields is None:
            low, high = field_range(target, target)
        picture = planes.plane(ax, grid, self._plant.field_target, component, low, high)
        mark_places(ax, self._plant, component)
        ax.set_ylabel(f"{grid.components[component]},  {grid.axes[-2].label}")

        def show(k: int, values: Array) -> None:
            nonlocal low, high
            if self._fields is None:
                least, most = field_range(values, target)
                if least < low or most > high:
                    low, high = min(least, low), max(most, high)
                    picture.set_clim(low, high)
            picture.set_data(middle(values))

        return show

    def _targets(self, axes: Sequence[Axes]) -> list[Any]:
        """The target of a field on several axes, in a column: the picture of each component."""
        pictures, first = [], self._plant.field_target if self._moving is None else self._moving[0]
        for i in range(len(self._plant.grid.components)):
            known = np.empty(0)
            if self._fields is not None:
                known = self._fields[..., self._plant.grid.part(i)]
            low, high = field_range(known, self._span(i))
            pictures.append(planes.plane(axes[i], self._plant.grid, first, i, low, high))
            axes[i].tick_params(labelleft=False)
        axes[0].set_title("target", fontsize=9)
        axes[-1].set_axis_off()
        return pictures

    def _target(self, component: int) -> Array:
        return self._plant.field_target[self._plant.grid.part(component)]

    def _span(self, component: int) -> Array:
        """The target of a component, of all steps where it moves."""
        own = self._plant.grid.part(component)
        return self._target(component) if self._moving is None else self._moving[:, own]


def _actions(ax: Axes, plant: Plant, colour: str, largest: float) -> tuple[Any, Axes]:
    """A bar for each actuator, and its bounds where they are not far away."""
    numbers, allowed = np.arange(1, plant.n_a + 1), plant.action_set
    bars = ax.bar(numbers, np.zeros(plant.n_a), color=colour)
    ax.axhline(0.0, color="0.5", lw=0.7)
    low, high = -1.05 * largest or -0.1, 1.05 * largest or 0.1
    for bound in (np.broadcast_to(b, plant.n_a) for b in (allowed.low, allowed.high)):
        bound = np.where(np.isfinite(bound), bound, np.nan)
        ax.hlines(bound, numbers - 0.45, numbers + 0.45, color="0.35", ls=":", lw=1.1)
    if allowed.low.min() >= 0.0:  # the half that no action reaches
        low = 0.1 * low
    if allowed.high.max() <= 0.0:
        high = 0.1 * high
    ax.set(xlabel="actuator", ylabel="action", ylim=(low, high))
    ax.xaxis.set_major_locator(MaxNLocator(6, integer=True, min_n_ticks=1))
    return bars, ax


def _around(values: Array) -> tuple[float, float]:
    """Limits of an axis with these values on it."""
    low, high = float(np.nanmin(values)), float(np.nanmax(values))
    margin = 0.1 * (high - low) or 0.1
    return low - margin, high + margin


def _grow(ax: Axes, values: Array) -> None:
    """Make the axis hold these values, so that the pictures of an episode do not jump."""
    seen = values[np.isfinite(values)]
    if not seen.size:
        return
    low, high = ax.get_ylim()
    if seen.min() < low or seen.max() > high:
        least, most = _around(seen)
        ax.set_ylim(min(low, least), max(high, most))
