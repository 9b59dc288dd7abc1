# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The figures of a report: one function each, data in, a matplotlib figure out."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from pde_sim_node.plant import DIVERGED_COST
from pdeloop.messages.arrays import Array
from pdeloop.messages.colour_scale import field_range
from pdeloop.messages.grid import Axis, Part
from pdeloop.messages.model_rows import ModelRows
from pdeloop.method.reduce.regression import OrderStudy
from pdeloop.report import places, planes
from pdeloop.report.data import Curve, ProblemData
from pdeloop.report.style import (
    COLOURS,
    GAIN_MAP,
    LINES,
    NAMES,
    field_image,
    image,
    panels,
    plain_log,
)

Eigenvalues = NDArray[Any]


def behaviour(problem: ProblemData) -> Figure:
    """From the mean initial field: the fields in space and time, the actions, the final profiles."""
    if len(problem.plant.grid.axes) > 1:
        return planes.behaviour(problem)
    shown, parts = problem.behaviours, problem.plant.grid.parts
    plant, moving = problem.plant, places.moving_target(problem.plant)
    count, fields = len(shown) + (moving is not None), len(parts)
    figure = Figure(figsize=(2.05 * count + 0.9, 1.5 + 2.0 * fields + 1.3 * (1 + fields)))
    grid = figure.subplots(
        2 * fields + 1,
        count,
        sharex="row",
        sharey="row",
        squeeze=False,
        height_ratios=(1.25,) * fields + (1,) * (1 + fields),
    )
    limits = places.action_range([b.actions for b in shown], plant.action_set)
    times = problem.first.values["sample_time"] * np.arange(len(shown[0].states))
    for column, b in enumerate(shown):
        grid[0, column].set_title(b.title)
        picture: Any = places.held_actions(
            grid[fields, column], times, b.actions, plant.action_set, limits
        )
        for ax in grid[:, column]:
            ax.xaxis.set_major_locator(MaxNLocator(3))
    places.name_actions(grid[fields, 0], plant.n_a)
    if picture is not None:
        row = grid[fields, : len(shown)].tolist()
        figure.colorbar(picture, ax=row, label="$a_j(t)$", aspect=10, pad=0.01)
    if moving is not None:
        grid[0, -1].set_title("target")
        for ax in grid[fields:, -1]:
            ax.set_axis_off()
    for i, part in enumerate(parts):
        _maps(figure, problem, part, grid[i], float(times[-1]))
        _profiles(problem, i, grid[fields + 1 + i, : len(shown)].tolist())
    figure.legend(
        *grid[fields + 1, 0].get_legend_handles_labels(), loc="outside lower center", ncols=3
    )
    return figure


def _maps(
    figure: Figure, problem: ProblemData, part: Part, axes: Sequence[Axes], end: float
) -> None:
    """A field of the state in space and time."""
    name, own, axis = part
    fields = [b.states[:, own] for b in problem.behaviours]
    target = problem.plant.field_target[own]
    moving = places.moving_target(problem.plant)
    limits = field_range(np.stack(fields), target if moving is None else moving[:, own])
    fields += [] if moving is None else [moving[:, own]]
    for ax, values in zip(axes, fields, strict=True):
        ax.set_facecolor("0.9")
        extent = (0.0, end, 0.0, axis.length)
        drawn = field_image(ax, values.T, extent, limits)
        ax.set_xlabel("t (s)")
    axes[0].set_ylabel(axis.label)
    if _numbered(axis):
        axes[0].yaxis.set_major_locator(MaxNLocator(6, integer=True, min_n_ticks=1))
    if moving is None:
        places.beside(axes[-1], target, limits, axis.length)
    figure.colorbar(drawn, ax=list(axes), label=f"{name}(x, t)", aspect=14, pad=0.01, extend="both")


def _profiles(problem: ProblemData, component: int, axes: Sequence[Axes]) -> None:
    """Its initial and final profiles, the target, and where actuators act and sensors measure."""
    name, own, axis = problem.plant.grid.parts[component]
    moving = places.moving_target(problem.plant)
    target = problem.plant.field_target[own] if moving is None else moving[-1, own]
    for ax, b in zip(axes, problem.behaviours, strict=True):
        places.mark_places(ax, problem.plant, component)
        first, last = b.states[0, own], b.states[-1, own]
        ax.plot(axis.points, first, ":", color="0.45", linewidth=1, label="initial field")
        ax.plot(axis.points, target, color="black", linewidth=0.9, label="target")
        ax.plot(axis.points, last, color=COLOURS[b.controller], label="final field")
        ax.set_xlim(0, axis.length)
        ax.set_xlabel(axis.label)
    if _numbered(axis):
        axes[0].xaxis.set_major_locator(MaxNLocator(3, integer=True, min_n_ticks=1))
    axes[0].set_ylabel(f"{name}(x, T)")


def _numbered(axis: Axis) -> bool:
    """Whether its points are the numbers of a vector, which have none in between."""
    return not (axis.points % 1.0).any()


def gains(problem: ProblemData) -> Figure:
    """The gains K_a and K_b of each controller: LQT's before, the adapted ones after learning.

    K_b is left out where it is zero, as its target is.
    """
    n_a, n_s = problem.models[0].B.T.shape
    policies = {
        name: own.reshape(n_a, 2 * n_s) for name, own in problem.policies.items() if name != "none"
    }
    symbols = (
        ["$K_a$", "$K_b$"] if any(own[:, n_s:].any() for own in policies.values()) else ["$K_a$"]
    )
    size = 3.2 * len(symbols), 0.5 + len(policies) * max(1.1, 0.11 * n_a + 0.5)
    figure = Figure(figsize=size)
    grid = figure.subplots(len(policies), len(symbols), sharex=True, sharey=True, squeeze=False)
    for part, symbol in enumerate(symbols):
        blocks = {name: own[:, part * n_s : (part + 1) * n_s] for name, own in policies.items()}
        largest = max(float(np.abs(block).max()) for block in blocks.values()) or 1.0
        for ax, (name, block) in zip(grid[:, part], blocks.items(), strict=True):
            extent = (0.5, n_s + 0.5, n_a + 0.5, 0.5)
            drawn = image(ax, block, extent, cmap=GAIN_MAP, vmin=-largest, vmax=largest)
            when = "before" if name == "lqt" else "after"
            ax.set_title(f"{symbol}, {NAMES[name]} ({when})")
            for axis in (ax.xaxis, ax.yaxis):
                axis.set_major_locator(MaxNLocator(6, integer=True, min_n_ticks=1))
            if part == 0:
                ax.set_ylabel("actuator j")
        grid[-1, part].set_xlabel("mode of the reduced state")
        label = f"entry of {symbol}"
        figure.colorbar(drawn, ax=grid[:, part].tolist(), label=label, aspect=40, pad=0.03)
    return figure


def orders(study: OrderStudy, used: int) -> Figure:
    """Singular values of the exploratory states, and held-out errors of each order."""
    figure = Figure(figsize=(6.8, 2.9))
    left, right = figure.subplots(1, 2)
    values = study.singular_values[: 2 * int(study.orders[-1])]
    left.semilogy(np.arange(1, len(values) + 1), values / values[0], ".", color="0.25")
    left.set_ylim(bottom=max(1e-12, 0.5 * float(values[-1] / values[0])))
    left.set_ylabel("singular value of Z', relative")
    left.set_xlabel("mode")
    lines = ((study.one_step, "o-", "0.25", "one step"), (study.rollout, "s--", "0.6", "rollout"))
    for errors, style, grey, label in lines:
        right.plot(study.orders, errors, style, color=grey, ms=3.5, lw=1, label=label)
    known = np.concatenate([study.one_step, study.rollout])
    known = known[np.isfinite(known)]
    plain_log(right, float(known.max() / max(known.min(), 1e-12)))
    right.set_ylabel("held-out error")
    right.set_xlabel("order $n_s$")
    right.legend()
    for ax in (left, right):
        ax.axvline(used, color="black", linewidth=0.8)
        ax.axvline(study.suggested, color="black", linewidth=0.8, linestyle=":")
    return figure


def spectrum(problem: ProblemData) -> Figure:
    """Eigenvalues of the reduced model, without control and with the gains of each controller."""
    groups: dict[str, list[Eigenvalues]] = {
        "none": [np.linalg.eigvals(model.A) for model in problem.models],
        "lqt": [_closed_loop(model, model.policy) for model in problem.models],
    }
    for name, run in problem.runs.items():
        groups[name] = [_closed_loop(m, p) for m, p in zip(run.models, run.policies, strict=True)]
    everything = np.concatenate([values for found in groups.values() for values in found])
    near = everything[(np.abs(np.abs(everything) - 1) < 0.2) & (everything.real > 0.5)]
    reach = 1.08 * max(1.0, float(np.abs(everything).max()))
    width = float(np.maximum(1 - near.real, np.abs(near.imag) / 0.6).max(initial=0.01)) * 1.12
    figure = Figure(figsize=(1.9 * len(groups) + 0.5, 4.5))
    grid = figure.subplots(2, len(groups), sharex="row", sharey="row", squeeze=False)
    for (whole, detail), (name, found) in zip(grid.T, groups.items(), strict=True):
        for ax in (whole, detail):
            _eigenvalues(ax, found, COLOURS[name], problem.shown)
        whole.set_xlim(-reach, reach)
        whole.set_ylim(-reach, reach)
        detail.set_xlim(1 - width, 1 + 0.3 * width)
        detail.set_ylim(-0.65 * width, 0.65 * width)
        radius = float(np.abs(found[problem.shown]).max())
        matrix = "A" if name == "none" else "A + B $K_a$"
        whole.set_title(f"{NAMES[name]}: {matrix}\nradius {radius:.4f}")
        detail.set_title("around 1")
        detail.set_xlabel("real part")
        detail.xaxis.set_major_locator(MaxNLocator(4))
    for ax in grid[:, 0]:
        ax.set_ylabel("imaginary part")
    return figure


def _closed_loop(model: ModelRows, policy: Array) -> Eigenvalues:
    """Eigenvalues of A + B K_a with the gains of a policy [K_a K_b], or of its rows in a vector."""
    K_a = policy.reshape(model.policy.shape)[:, : len(model.A)]
    return np.linalg.eigvals(model.A + model.B @ K_a)


def _eigenvalues(ax: Axes, found: Sequence[Eigenvalues], colour: str, shown: int) -> None:
    """The unit circle and the eigenvalues of every seed, those of the shown one filled, on top."""
    circle = np.exp(1j * np.linspace(0, 2 * np.pi, 3601))
    ax.plot(circle.real, circle.imag, color="black", linewidth=0.7)
    ax.axhline(0, color="0.85", linewidth=0.6, zorder=0)
    for s, values in enumerate(found):
        ax.plot(
            values.real,
            values.imag,
            marker="o",
            linestyle="none",
            markersize=4.5 if s == shown else 3.5,
            markerfacecolor=colour if s == shown else "none",
            markeredgecolor=colour,
            markeredgewidth=0.8,
            alpha=1.0 if s == shown else 0.6,
            zorder=3 if s == shown else 2,
        )
    ax.set_aspect("equal")


TENFOLD = 10.0
"""Ratio of costs beyond which their axis is logarithmic."""


def training_curves(problems: Sequence[ProblemData]) -> Figure:
    """Cost against rollouts: mean and standard deviation over the seeds.

    Relative to LQT where the curves are; else LQT's cost, which is one on other fields, is not drawn.
    """
    figure, axes = panels(len(problems), height=2.8, width=2.35, least=4.2)
    over_lqt = all(curve.over_lqt for problem in problems for curve in problem.curves)
    for ax, problem in zip(axes, problems, strict=True):
        reached = [bound for curve in problem.curves for bound in _band(ax, curve)]
        used, costs = problem.explored
        if used.size:
            ax.plot(used, costs, "x", color="0.5", label="exploration")
            reached += [float(costs.min()), float(costs.max())]
        if over_lqt:
            ax.axhline(1.0, color=COLOURS["lqt"], linestyle=LINES["lqt"], label=NAMES["lqt"])
            reached += [0.8 / 0.93, 1.0, 1.25 / 1.08]
        low, top = min(reached), max(reached)
        if low > 0:
            plain_log(ax, top / low)
        ax.set_ylim(0.93 * low, 1.08 * top or 1.0)
        ax.set_xlim(left=1.1 * used.min(initial=0.0))
        ax.xaxis.set_major_locator(MaxNLocator(5, integer=True))
        ax.set_xlabel("rollouts of the adaptation")
        ax.set_title(problem.name)
    axes[0].set_ylabel(
        "cost relative to LQT,\nsame fields"
        if over_lqt
        else "mean stage cost,\nthe training's fields"
    )
    legend = {
        label: line
        for ax in axes
        for line, label in zip(*ax.get_legend_handles_labels(), strict=True)
    }
    figure.legend(legend.values(), legend, loc="outside upper center", ncols=len(legend))
    return figure


def _band(ax: Axes, curve: Curve) -> tuple[float, float]:
    """Draw a curve with its band; returns the lowest and highest value of the band."""
    known = np.isfinite(curve.costs).any(axis=1)
    used, costs = curve.rollouts[known], curve.costs[known]
    mean, std = np.nanmean(costs, axis=1), np.nanstd(costs, axis=1)
    below = np.maximum(mean - std, mean / 10)  # the axis is logarithmic
    name = curve.controller
    colour = COLOURS[name]
    ax.fill_between(used, below, mean + std, color=colour, alpha=0.2, linewidth=0, step="post")
    ax.step(used, mean, where="post", color=colour, linestyle=LINES.get(name), label=NAMES[name])
    if len(used) == 1:
        ax.plot(used, mean, "o", color=colour)
    return float(below.min()), float((mean + std).max())


def bars(problems: Sequence[ProblemData]) -> Figure:
    """Mean stage cost of each controller over seeds and fields, with the standard deviation."""
    widest = max(len(problem.costs) for problem in problems)
    figure, axes = panels(len(problems), height=2.8, width=0.35 + 0.58 * widest, least=3.6)
    for ax, problem in zip(axes, problems, strict=True):
        high, most, low = 0.0, 0.0, np.inf
        for i, (name, costs) in enumerate(problem.costs.items()):
            good = costs[costs < DIVERGED_COST]
            if not good.size:
                ax.text(i, 0, " diverged", ha="center", va="bottom", rotation=90)
                continue
            mean, std = float(good.mean()), float(good.std())
            star = "*" * bool(good.size < costs.size)
            ax.bar(i, mean, color=COLOURS[name], width=0.72)
            below = min(std, 0.9 * mean)  # the axis may be logarithmic
            ax.errorbar(i, mean, [[below], [std]], color="0.5", linewidth=0.9, capsize=3)
            number = f"{mean:#.3g}".rstrip(".") + star
            ax.annotate(
                number,
                (i, mean + std),
                xytext=(0, 2),
                textcoords="offset points",
                ha="center",
                va="bottom",
                fontsize=8,
            )
            high, most, low = max(high, mean + std), max(most, mean), min(low, mean)
        if most > TENFOLD * low > 0:  # else the bars of the good ones could not be told apart
            plain_log(ax, 2 * high / low)
            ax.set_ylim(0.5 * low, 1.5 * high)
        else:
            ax.set_ylim(0, 1.12 * high or 1.0)
        labels = [NAMES[n].replace(" ", "\n", 1).replace("-b", "-\nb") for n in problem.costs]
        ax.set_xticks(range(len(labels)), labels, fontsize=7.5)
        ax.set_xlim(-0.6, len(labels) - 0.4)
        ax.tick_params(axis="x", length=0)
        ax.set_title(problem.name)
    axes[0].set_ylabel("mean stage cost")
    return figure
