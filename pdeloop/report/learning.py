# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The figures about learning: cost against rollouts, the steps that were tried, the final costs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from loop_interfaces.arrays import Array
from pde_sim_node.plant import DIVERGED_COST
from pdeloop.report.data import Curve, ProblemData
from pdeloop.report.style import COLOURS, LINES, NAMES, panels, plain_log

Rows = Sequence[Mapping[str, Any]]
EDGE = 1.5
"""Candidates that cost more, relative to the incumbent, or diverged stand at this height."""

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
        if over_lqt:
            ax.axhline(1.0, color=COLOURS["lqt"], linestyle=LINES["lqt"], label=NAMES["lqt"])
            reached += [0.8 / 0.93, 1.0, 1.25 / 1.08]
        low, top = min(reached), max(reached)
        if low > 0:
            plain_log(ax, top / low)
        ax.set_ylim(0.93 * low, 1.08 * top or 1.0)
        ax.set_xlim(left=0)
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


def has_steps(history: Rows) -> bool:
    """True for the rows of an optimiser that judges its steps as `steps` shows them."""
    decided = [row for row in history if "accepted" in row]
    return (
        bool(decided)
        and all("relative_cost" in row and row.get("damping", 0.0) > 0 for row in decided)
        and any("mismatch" in row and "predicted_fall" in row for row in history)
    )


def steps(history: Rows, colour: str) -> Figure:
    """Steps accepted and rejected, the damping, and the error of the model behind them.

    history: the rows of one seed whose optimiser judges its steps.
    """
    decided = [row for row in history if "accepted" in row]
    proposed = [row for row in history if "mismatch" in row]
    figure = Figure(figsize=(6.4, 5.2))
    top, middle, bottom = figure.subplots(3, 1, sharex=True, height_ratios=(1.6, 1, 1))
    _candidates(top, decided, proposed, colour)
    used = _column(decided, "rollouts")
    damping = _column(decided, "damping")
    middle.step(used, damping, "o-", where="post", color="0.25", ms=3, lw=1)
    plain_log(middle, float(np.max(damping) / np.min(damping)))
    middle.set_ylabel("damping $\\lambda$")
    mismatch = np.maximum(_column(proposed, "mismatch"), 1e-16)  # exact up to rounding, or to noise
    bottom.plot(_column(proposed, "rollouts"), mismatch, "o-", color="0.25", ms=3, lw=1)
    bottom.axhline(1.0, color="0.6", linestyle=":", linewidth=1)
    bottom.set_title("dotted: no prediction at all", loc="right", fontsize=8, color="0.4", pad=2)
    low = min(0.4, 0.5 * float(np.nanmin(mismatch)))
    plain_log(bottom, 2.6 / low)
    bottom.set_ylim(low, 2.6)
    bottom.set_ylabel("model error E")
    bottom.set_xlabel("rollouts of the adaptation")
    bottom.set_xlim(0, 1.02 * float(used[-1]))
    bottom.xaxis.set_major_locator(MaxNLocator(8, steps=[1, 2, 5, 10], integer=True))
    figure.align_ylabels()
    return figure


def _candidates(ax: Axes, decided: Rows, proposed: Rows, colour: str) -> None:
    """Cost of each candidate over the incumbent's, as it was predicted and as it came out."""
    used, relative = _column(decided, "rollouts"), _column(decided, "relative_cost")
    heights = np.where(relative < EDGE, relative, EDGE)
    accepted = np.array([bool(row["accepted"]) for row in decided])
    # The step that was decided is the last one proposed before; a first law is none.
    last = np.searchsorted(_column(proposed, "rollouts"), used)
    falls = _column(proposed, "predicted_fall") / _column(proposed, "cost")
    predicted = 1 - np.concatenate([[np.nan], falls])[last]
    ax.axhline(1.0, color="0.6", linestyle=":", linewidth=1)
    ax.plot(used, predicted, "D", ms=4, color="0.5", mfc="none", label="predicted")
    for which, marker, tint, label in (
        (accepted, "o", colour, "accepted"),
        (~accepted, "x", "black", "rejected"),
    ):
        if which.any():  # an empty line that is not clipped has no extent to lay out
            ax.plot(used[which], heights[which], marker, color=tint, label=label, clip_on=False)
    known = np.concatenate([heights, predicted, [1.0]])
    ax.set_ylim(min(0.9, float(np.nanmin(known)) - 0.05), min(EDGE, np.nanmax(known) + 0.05))
    ax.set_ylabel("candidate's cost over\nthe incumbent's")
    ax.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=3, handletextpad=0.2)


def _column(rows: Rows, name: str) -> Array:
    return np.array([row.get(name, np.nan) for row in rows], dtype=np.float64)


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
        labels = [NAMES[n].replace(" ", "\n", 1).replace("-N", "-\nN") for n in problem.costs]
        ax.set_xticks(range(len(labels)), labels, fontsize=7.5)
        ax.set_xlim(-0.6, len(labels) - 0.4)
        ax.tick_params(axis="x", length=0)
        ax.set_title(problem.name)
    axes[0].set_ylabel("mean stage cost")
    return figure
