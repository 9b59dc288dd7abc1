# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The figures about learning: cost against rollouts, the final costs."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from pde_sim_node.plant import DIVERGED_COST
from pdeloop.report.data import Curve, ProblemData
from pdeloop.report.style import COLOURS, LINES, NAMES, panels, plain_log

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
