"""The figures about learning: cost against rollouts, the steps that were tried, the final costs."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullLocator
from numpy.typing import NDArray

from pde_sim_node.plant import DIVERGED_COST
from pdeloop.report.data import Curve, ProblemData, Steps
from pdeloop.report.style import COLOURS, STYLES, TITLES, legend_above, log_ticks, panels, title_of

Array = NDArray[np.float64]


def training_curves(problems: Sequence[ProblemData]) -> Figure:
    """Cost against rollouts, relative to LQT: mean and standard deviation over the seeds."""
    figure, axes = panels(len(problems), height=2.6, least=4.2)
    for ax, problem in zip(axes, problems, strict=True):
        ax.axhline(1.0, color=COLOURS["lqt"], linestyle=STYLES["lqt"], label=TITLES["lqt"])
        low, top = 1.0, 1.0
        for curve in problem.curves:
            below, above = _band(ax, curve)
            low, top = min(low, below), max(top, above)
        if (best := _relative_optimum(problem)) is not None:
            ax.axhline(
                best,
                color=COLOURS["optimum"],
                linestyle=STYLES["optimum"],
                label=TITLES["optimum"],
            )
            low = min(low, best)
        ax.set_yscale("log")
        ax.set_ylim(0.93 * min(low, 0.8), 1.08 * max(top, 1.25))
        _plain_log(ax, top / low)
        ax.set_xlim(left=0)
        ax.xaxis.set_major_locator(MaxNLocator(5, integer=True))
        ax.set_xlabel("rollouts")
        ax.set_title(title_of(problem))
    axes[0].set_ylabel(problems[0].curve_label)
    legend_above(figure, axes)
    return figure


def _band(ax: Axes, curve: Curve) -> tuple[float, float]:
    """Draw a curve with its band; returns the lowest and highest value of the band."""
    relative = curve.relative
    known = np.isfinite(relative).any(axis=1)
    mean, std = np.full(len(relative), np.nan), np.full(len(relative), np.nan)
    mean[known] = np.nanmean(relative[known], axis=1)
    std[known] = np.nanstd(relative[known], axis=1)
    colour = COLOURS[curve.controller]
    below = np.maximum(mean - std, mean / 10)  # the axis is logarithmic
    ax.fill_between(
        curve.rollouts,
        below,
        mean + std,
        color=colour,
        alpha=0.2,
        linewidth=0,
        step="post" if curve.held else None,
    )
    ax.plot(
        curve.rollouts,
        mean,
        color=colour,
        linestyle=STYLES[curve.controller],
        label=TITLES[curve.controller],
        drawstyle="steps-post" if curve.held else "default",
    )
    return float(np.nanmin(below, initial=1.0)), float(np.nanmax(mean + std, initial=1.0))


def _relative_optimum(problem: ProblemData) -> float | None:
    """The optimum of the policy class over LQT, the mean over the seeds; None if not known."""
    if problem.reference is None:
        return None
    first = int(problem.values["seed"])
    seeds = [first + s for s in range(problem.seeds)]
    if problem.share("lqt") is None or any(s not in problem.reference.optimum for s in seeds):
        return None
    ratios = [
        problem.reference.optimum[seed].mean() / costs.mean()
        for seed, costs in zip(seeds, problem.costs["lqt"], strict=True)
    ]
    return float(np.mean(ratios))


def steps(problem: ProblemData, shown: Steps) -> Figure:
    """Steps accepted and rejected, the damping, and the error of the model behind them."""
    figure = Figure(figsize=(6.4, 5.2))
    top, middle, bottom = figure.subplots(3, 1, sharex=True, height_ratios=(1.6, 1, 1))
    _candidates(top, shown)
    middle.step(shown.decided, shown.damping, where="post", color="0.25", linewidth=1)
    middle.plot(shown.decided, shown.damping, "o", color="0.25", markersize=3)
    middle.set_yscale("log")
    middle.set_ylabel("damping $\\lambda$")
    bottom.plot(shown.proposed, shown.mismatch, "o-", color="0.25", markersize=3, linewidth=1)
    bottom.axhline(1.0, color="0.6", linestyle=":", linewidth=1)
    bottom.set_title("dotted: no prediction at all", loc="right", fontsize=8, color="0.4", pad=2)
    bottom.set_yscale("log")
    low = min(0.4, 0.8 * float(np.nanmin(shown.mismatch)))
    bottom.set_ylim(max(low, 1e-4), 2.6)
    _plain_log(bottom, 2.6 / low)
    bottom.set_ylabel("model error E")
    bottom.set_xlabel("rollouts")
    bottom.set_xlim(0, 1.02 * float(shown.decided[-1]))
    bottom.xaxis.set_major_locator(MaxNLocator(8, steps=[1, 2, 5, 10], integer=True))
    figure.align_ylabels()
    return figure


def _candidates(ax: Axes, shown: Steps) -> None:
    """Cost of each candidate over the incumbent's; those beyond the axis stand at its edge."""
    edge = 1.5
    colour, rejected = COLOURS["lqt_po"], ~shown.accepted
    inside = rejected & (shown.relative < edge)
    # Without any number the run was recorded before it was kept: nothing to draw.
    outside = rejected & ~inside & np.isfinite(shown.relative).any()
    ax.axhline(1.0, color="0.6", linestyle=":", linewidth=1)
    ax.plot(
        shown.decided,
        shown.predicted,
        "D",
        markersize=4,
        color="0.5",
        markerfacecolor="none",
        label="predicted",
    )
    heights = np.where(outside, edge, shown.relative)
    for which, marker, tint, label in (
        (shown.accepted, "o", colour, "accepted"),
        (inside, "x", "black", "rejected"),
        (outside, "^", "black", f"rejected, above {edge:g} or diverged"),
    ):
        if which.any():
            where = shown.decided[which]
            ax.plot(where, heights[which], marker, color=tint, label=label, clip_on=False)
    known = np.concatenate([shown.relative[shown.accepted | inside], shown.predicted, [1.0]])
    top = edge if outside.any() else max(1.05, float(np.nanmax(known)) + 0.05)
    ax.set_ylim(min(0.9, float(np.nanmin(known)) - 0.05), top)
    ax.set_ylabel("candidate's cost over\nthe incumbent's")
    ax.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=4, handletextpad=0.2)


def bars(problems: Sequence[ProblemData]) -> Figure:
    """Mean stage cost of each controller over seeds and fields, with the standard deviation."""
    shown = [_with_limits(problem) for problem in problems]
    widest = max(len(costs) for costs in shown)
    figure, axes = panels(len(problems), height=2.8, width=0.35 + 0.55 * widest)
    for ax, problem, by_name in zip(axes, problems, shown, strict=True):
        high = 0.0
        for i, (name, costs) in enumerate(by_name.items()):
            good = costs[costs < DIVERGED_COST]
            if not good.size:
                ax.text(i, 0, "diverged", ha="center", va="bottom", rotation=90)
                continue
            mean, std = float(good.mean()), float(good.std())
            ax.bar(i, mean, color=COLOURS[name], width=0.72)
            ax.errorbar(i, mean, std, color="black", linewidth=0.9, capsize=3)
            number = f"{mean:#.3g}".rstrip(".")
            ax.text(i, mean + std, number, ha="center", va="bottom", fontsize=8)
            high = max(high, mean + std)
        ax.set_ylim(0, 1.12 * high)
        ax.set_xticks(range(len(by_name)), [TITLES[n].replace(" ", "\n", 1) for n in by_name])
        ax.tick_params(axis="x", length=0)
        ax.set_title(title_of(problem))
    axes[0].set_ylabel("mean stage cost")
    return figure


def _with_limits(problem: ProblemData) -> dict[str, Array]:
    """The costs by controller, and behind them the limits where they are known."""
    costs = dict(problem.costs)
    if problem.reference is not None and problem.share("lqt") is not None:
        first = int(problem.values["seed"])
        known = problem.reference.optimum
        rows = [known[s] for s in range(first, first + problem.seeds) if s in known]
        costs |= {"optimum": np.stack(rows), "open_loop": problem.reference.open_loop}
    return costs


def _plain_log(ax: Axes, ratio: float) -> None:
    """Ticks of a logarithmic axis over this ratio, written as plain numbers."""
    ax.yaxis.set_major_locator(LogLocator(10, subs=log_ticks(ratio)))
    ax.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    ax.yaxis.set_minor_locator(NullLocator())
