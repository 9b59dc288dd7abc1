# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Figures of fields on more than one axis: snapshots as pictures, where curves over x do not do."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pde_sim_node.plant import Plant
from pdeloop.messages.arrays import Array
from pdeloop.messages.colour_scale import field_range
from pdeloop.messages.grid import Grid, middle
from pdeloop.report import places
from pdeloop.report.style import FIELD_MAP

if TYPE_CHECKING:
    from pdeloop.episode import EpisodeRecord
    from pdeloop.report.data import ProblemData

SHARES = (0.0, 0.25, 1.0)
"""Shares of an episode after which a field is shown."""


def behaviour(problem: ProblemData) -> Figure:
    """From the mean initial field: each controller's fields, the target, and the actions."""
    plant, shown, moving = problem.plant, problem.behaviours, places.moving_target(problem.plant)
    grid, count = plant.grid, len(shown)
    rows = len(SHARES) * len(grid.components)
    figure = Figure(figsize=(2.05 * (count + 1) + 0.9, 1.6 * rows + 1.8))
    axes = figure.subplots(rows + 1, count + 1, squeeze=False)
    steps = len(shown[0].states) - 1
    for i, name in enumerate(grid.components):
        low, high = _range([b.states[:, grid.part(i)] for b in shown], plant, i)
        for s, share in enumerate(SHARES):
            row, k = axes[len(SHARES) * i + s], round(share * steps)
            for ax, b in zip(row, shown, strict=False):
                drawn = plane(ax, grid, b.states[k], i, low, high)
                places.mark_places(ax, plant, i)
            row[0].set_ylabel(f"t = {k * plant.sample_time:.3g} s\n{grid.axes[-2].label}")
            if moving is None and share < 1.0:
                row[-1].set_axis_off()
                continue
            plane(row[-1], grid, plant.field_target if moving is None else moving[k], i, low, high)
            row[-1].set_title("target")
        own = axes[len(SHARES) * i : len(SHARES) * (i + 1)].ravel().tolist()
        figure.colorbar(drawn, ax=own, label=name, pad=0.01, extend="both")
    times = plant.sample_time * np.arange(steps + 1, dtype=np.float64)
    limits = places.action_range([b.actions for b in shown], plant.action_set)
    for column, b in enumerate(shown):
        axes[0, column].set_title(b.title)
        places.held_actions(axes[-1, column], times, b.actions, plant.action_set, limits)
    places.name_actions(axes[-1, 0], plant.n_a)
    axes[-1, -1].set_axis_off()
    return figure


def episode(plant: Plant, record: EpisodeRecord, environment: int) -> Figure:
    """One environment of an episode: fields at some instants, and the actions."""
    grid, fields = plant.grid, record.fields[:, environment]
    components, steps = grid.components, len(fields) - 1
    figure = Figure(figsize=(2.3 * len(SHARES) + 1.0, 2.0 * len(components) + 1.8))
    axes = figure.subplots(
        len(components) + 1, len(SHARES), squeeze=False, gridspec_kw={"hspace": 0.5}
    )
    for i, name in enumerate(components):
        low, high = _range([fields[:, grid.part(i)]], plant, i)
        for ax, share in zip(axes[i], SHARES, strict=True):
            k = round(share * steps)
            drawn = plane(ax, grid, fields[k], i, low, high)
            places.mark_places(ax, plant, i)
            ax.set_title(f"t = {k * plant.sample_time:.3g} s")
        axes[i, 0].set_ylabel(grid.axes[-2].label)
        figure.colorbar(drawn, ax=axes[i].tolist(), label=name, pad=0.01)
    for ax in axes[-1]:
        ax.remove()
    below = figure.add_subplot(len(components) + 1, 1, len(components) + 1)
    times = plant.sample_time * np.arange(steps + 1, dtype=np.float64)
    applied = record.applied[:, environment]
    limits = places.action_range([applied], plant.action_set)
    places.held_actions(below, times, applied, plant.action_set, limits)
    places.name_actions(below, plant.n_a)
    return figure


def fields(plant: Plant, mean: Array, drawn: Array) -> Figure:
    """The mean initial field, a drawn one, the target and where the actuators act."""
    grid, components = plant.grid, plant.grid.components
    figure = Figure(figsize=(9.5, 0.6 + 2.2 * len(components)), layout="constrained")
    axes = figure.subplots(len(components), 4, squeeze=False)
    for i, name in enumerate(components):
        low, high = _range([mean[None, grid.part(i)], drawn[None, grid.part(i)]], plant, i)
        shown = {"mean initial field": mean, "a drawn one": drawn, "target": plant.field_target}
        for ax, (title, field) in zip(axes[i], shown.items(), strict=False):
            picture = plane(ax, grid, field, i, low, high)
            ax.set_title(title)
        figure.colorbar(picture, ax=axes[i, :3].tolist(), label=name)
        axes[i, 0].set_ylabel(grid.axes[-2].label)
        supports = places.supports_of(plant, i)
        axes[i, 3].set_axis_off()
        if supports is not None:
            axes[i, 3].set_axis_on()
            largest = supports.max(axis=1)
            plane(axes[i, 3], grid, np.tile(largest, len(components)), i, 0.0, largest.max())
            axes[i, 3].set_title("actuators")
    return figure


def plane(ax: Axes, grid: Grid, state: Array, component: int, low: float, high: float) -> Any:
    """Draw a component of a state as a picture over the last two axes; of others the middle."""
    y, x = grid.axes[-2:]
    ax.set_facecolor("0.9")
    ax.set_xlabel(x.label)
    ax.spines[["top", "right"]].set_visible(True)
    return ax.imshow(
        middle(grid.fields(state)[component]),
        cmap=FIELD_MAP,
        extent=(0.0, x.length, 0.0, y.length),
        origin="lower",
        vmin=low,
        vmax=high if high > low else low + 1.0,
    )


def _range(parts: Sequence[Array], plant: Plant, component: int) -> tuple[float, float]:
    values = np.concatenate([part.ravel() for part in parts])
    moving, own = places.moving_target(plant), plant.grid.part(component)
    return field_range(values, plant.field_target[own] if moving is None else moving[:, own])
