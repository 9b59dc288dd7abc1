# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The picture of a problem: its initial fields, its target and its actuators' supports."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from pde_sim_node.plant import MEAN_FIELD
from pdeloop.problem_check import DRAWN, field_plant


def draw(values: Mapping[str, Any], path: Path) -> None:
    """A picture of the initial fields, the target and the actuators' supports."""
    from matplotlib import rc_context

    from pdeloop.report.style import STYLE

    with rc_context(STYLE):
        _draw(values, path)


def _draw(values: Mapping[str, Any], path: Path) -> None:
    from matplotlib.figure import Figure

    plant = field_plant(values, compiled=False)
    fields = plant.reset([MEAN_FIELD, *range(DRAWN)]).copy()
    grid = plant.grid
    if len(grid.axes) > 1:
        from pdeloop.report import planes

        figure = planes.fields(plant, fields[0], fields[1])
        figure.savefig(path, dpi=150, format=path.suffix[1:] or "png")
        return
    parts = grid.parts
    figure = Figure(figsize=(7.0, 0.6 + 2.4 * len(parts)), layout="constrained")
    actuated = 0
    every = figure.subplots(len(parts), 1, sharex=not grid.lengths, squeeze=False)[:, 0]
    for i, (ax, (name, own, axis)) in enumerate(zip(every, parts, strict=True)):
        x = axis.points
        ax.plot(x, fields[1:, own].T, color="0.7", linewidth=0.8)
        ax.plot(x, fields[0, own], color="0.35", label="initial field: mean, and five drawn")
        ax.plot(x, plant.field_target[own], color="black", linestyle="--", label="target")
        if own == plant.forced and plant.supports is not None:
            actuated = i
            below = ax.get_xaxis_transform()
            for j, support in enumerate(plant.supports.T):
                height = 0.12 * support / max(float(np.abs(support).max()), 1e-300)
                label = "supports of the actuators" if j == 0 else None
                ax.fill_between(
                    x, height, transform=below, color="#d55e00", alpha=0.45, label=label
                )
        ax.set_ylabel(f"{name}(x)")
        ax.set_xlim(0, axis.length)
    ax.set_xlabel(axis.label)
    known = figure.axes[actuated].get_legend_handles_labels()
    figure.legend(*known, loc="outside upper center", ncols=3, frameon=False)
    # Without a format a folder would become the name of a file next to it.
    figure.savefig(path, dpi=150, format=path.suffix[1:] or "png")
