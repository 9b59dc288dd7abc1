# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Marks beside a field in a figure: actuators, sensors and the target."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from numpy.typing import NDArray

from pde_sim_node.plant import Plant
from pdeloop.messages.arrays import Array
from pdeloop.messages.grid import Grid
from pdeloop.report.style import FIELD_MAP, image

HEIGHT = 0.06
"""Share of a curve's axes that the actuators' supports take."""


def supports_of(plant: Plant, component: int) -> Array | None:
    """Magnitude with which each actuator acts on a component, (points, n_a); None if unknown, or 0."""
    if plant.supports is None:
        return None
    everywhere = np.zeros((plant.n_z, plant.n_a))
    everywhere[plant.forced] = plant.supports
    own: Array = np.abs(everywhere[plant.grid.part(component)])
    return own if own.any() else None


def mark_places(ax: Axes, plant: Plant, component: int) -> None:
    """Mark actuators in grey and sensors as black points, in axes of a curve or a picture."""
    sensors = plant.instruments.sensors
    points = plant.grid.equally_spaced(sensors) if sensors else np.empty(0, dtype=np.int64)
    supports = supports_of(plant, component)
    if len(plant.grid.axes) > 1:
        _on_a_plane(ax, plant.grid, supports, points)
        return
    _, own, axis = plant.grid.parts[component]
    x, below = axis.points, ax.get_xaxis_transform()
    if plant.grid.lengths:
        points = points[(points >= own.start) & (points < own.stop)] - own.start
    for j, support in enumerate([] if supports is None else supports.T):
        if support.any():
            height, grey = HEIGHT * support / support.max(), ("0.55", "0.75")[j % 2]
            acts = support > 1e-3 * support.max()
            ax.fill_between(
                x, height, where=acts, transform=below, color=grey, step="mid", linewidth=0
            )
    if len(points):
        ax.plot(x[points], np.zeros(len(points)), "k.", transform=below, ms=4, clip_on=False)


def moving_target(plant: Plant) -> Array | None:
    """The target of each step, (T + 1, n_z); None where it is constant, or that of an output."""
    cost = plant.cost
    if cost.target.ndim < 2 or cost.output is not None:
        return None
    missing = plant.horizon + 1 - len(cost.target)
    return np.vstack([cost.target, *[cost.target[-1:]] * max(missing, 0)])


def beside(ax: Axes, target: Array, limits: tuple[float, float], length: float) -> None:
    """The target of a field on one axis, as a strip in its colours to the right of `ax`."""
    strip = ax.inset_axes((1.03, 0.0, 0.05, 1.0))
    extent = (0.0, 1.0, 0.0, length)
    image(
        strip,
        target[:, None],
        extent,
        origin="lower",
        cmap=FIELD_MAP,
        vmin=limits[0],
        vmax=limits[1],
    )
    strip.set(xticks=[], yticks=[])
    strip.set_xlabel("target", fontsize=7, labelpad=3)  # above, the title of `ax` may be wide


def _on_a_plane(ax: Axes, grid: Grid, supports: Array | None, points: NDArray[np.int64]) -> None:
    """Contours at half of each support's largest magnitude; of more than two axes of the middle."""
    y, x = grid.axes[-2:]
    plane = grid.shape[-2] * grid.shape[-1]
    first = plane * (grid.points // plane // 2)
    for support in [] if supports is None else supports[first : first + plane].T:
        level = 0.5 * float(support.max())
        if min(grid.shape[-2:]) > 1 and float(support.min()) < level:
            shape = support.reshape(grid.shape[-2:])
            ax.contour(x.points, y.points, shape, [level], colors="0.25", linewidths=0.8)
    if len(points):
        rows, columns = np.unravel_index(np.unique(points % plane), grid.shape[-2:])
        ax.plot(x.points[columns], y.points[rows], "k.", ms=4)
