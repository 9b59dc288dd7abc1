# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Figure of an identification: orders, the model against the data, and the law on the model."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from pdeloop.identified import Identified
from pdeloop.messages.arrays import Array
from pdeloop.model_checks import simulated
from pdeloop.report.style import STYLE

CHANNELS = 5
"""Numbers of the state, and inputs, that are drawn."""


def draw(found: Identified, path: Path) -> None:
    """Write the picture; its suffix says in which format."""
    with matplotlib.rc_context(STYLE):
        figure = plot(found)
        # Without a format a folder would become the name of a file next to it.
        figure.savefig(path, dpi=150, format=path.suffix[1:] or "png")


def plot(found: Identified) -> Figure:
    """The figure; the lower half only where there is a law."""
    rows = 1 if found.closed_loop is None else 2
    figure = Figure(figsize=(8.0, 3.0 * rows), layout="constrained")
    axes = figure.subplots(rows, 2, squeeze=False)
    if found.model.d is not None and found.model.d.any():
        figure.suptitle(
            "the model has a constant term, which is in all simulations", fontsize="medium"
        )
    _orders(axes[0, 0], found.orders, len(found.model.A))
    step = found.sample_time or 1.0
    unit = "t (s)" if found.sample_time else "step"
    states, actions = found.trajectory
    shown = _spread(states.shape[1])
    _lines(axes[0, 1], states, shown, None, step, linewidth=3.0, alpha=0.35)
    drawn = simulated(found.simulated, states, actions)
    _lines(axes[0, 1], drawn, shown, found.channels.state, step)
    axes[0, 1].set(title=f"recorded (thick), simulated (thin): {found.kind}", xlabel=unit)
    axes[0, 1].legend(frameon=False, fontsize="small")
    loop = found.closed_loop
    if loop is not None:
        _lines(axes[1, 0], loop.states, shown, found.channels.state, step)
        for place, i in enumerate(shown):
            axes[1, 0].axhline(loop.target[i], color=f"C{place}", linestyle=":", linewidth=0.9)
        axes[1, 0].set(title="law on the model, and target (dotted)", xlabel=unit)
        chosen = _spread(loop.actions.shape[1])
        times = step * np.arange(len(loop.actions))
        for place, j in enumerate(chosen):
            axes[1, 1].step(
                times,
                loop.actions[:, j],
                where="post",
                color=f"C{place}",
                linewidth=0.9,
                label=found.channels.input(j),
            )
            for end in (actions[:, j].min(), actions[:, j].max()):
                axes[1, 1].axhline(end, color=f"C{place}", linestyle=":", linewidth=0.9)
        axes[1, 1].set(title="its actions, and the recorded range (dotted)", xlabel=unit)
        axes[1, 1].legend(frameon=False, fontsize="small")
    return figure


def _orders(ax: Axes, rows: Sequence[Mapping[str, float]], order: int) -> None:
    ax.set(title="errors on held-out steps", xlabel="order $n_s$", ylabel="relative to no change")
    ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    if not rows:
        ax.text(0.5, 0.5, "too few steps to hold some out", ha="center", transform=ax.transAxes)
        return
    for name, label in (("one_step_error", "one step"), ("rollout_error", "rollout")):
        if name in rows[0]:
            tried = [row["order"] for row in rows], [row[name] for row in rows]
            ax.semilogy(*tried, "o-", markersize=3, label=label)
    ax.axvline(order, color="0.5", linestyle=":", label=f"this model, {order}")
    ax.legend(frameon=False, fontsize="small")


def _lines(
    ax: Axes,
    values: Array,
    shown: Sequence[int],
    name: Callable[[int], str] | None,
    step: float,
    **style: Any,
) -> None:
    times = step * np.arange(len(values))
    for place, i in enumerate(shown):
        label = name(i) if name else None
        drawn = {"linewidth": 0.9, **style}
        ax.plot(times, values[:, i], color=f"C{place}", label=label, **drawn)


def _spread(count: int) -> list[int]:
    """A few of them, equally spaced."""
    few = np.linspace(0, count - 1, min(count, CHANNELS))
    return [int(i) for i in few.round()]
