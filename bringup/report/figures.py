"""The figures of a report: one function each, data in, a matplotlib figure out.

The same colour (and line style) is the same controller everywhere. Colours are Okabe and Ito's,
fields are drawn with cividis, gains with straight lines in CIELAB from white to blue and to brown:
perceptually uniform, and readable with any colour vision.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullLocator
from numpy.typing import NDArray

from bringup.report.data import Behaviour, ProblemData
from pde_sim_node.plant import DIVERGED_COST

Array = NDArray[np.float64]
Eigenvalues = NDArray[Any]
COLOURS = {"none": "#8C8C8C", "lqt": "#0072B2", "lqt_po": "#D55E00", "pure_po": "#009E73"}
STYLES = {"none": ":", "lqt": "--", "lqt_po": "-", "pure_po": "-."}
TITLES = {"none": "no control", "lqt": "LQT", "lqt_po": "LQT-PO", "pure_po": "pure PO"}
PROBLEMS = {
    "burgers": "Burgers",
    "allen-cahn": "Allen-Cahn",
    "kdv": "Korteweg-de Vries",
    "kuramoto-sivashinsky": "Kuramoto-Sivashinsky",
    "fisher": "Fisher-KPP",
    "cahn-hilliard": "Cahn-Hilliard",
    "ginzburg-landau": "Ginzburg-Landau",
    "convection-diffusion-reaction": "convection-diffusion-reaction",
    "wave": "wave equation",
    "schrodinger": "Schrödinger",
}
FIELD_MAP = "cividis"
STYLE: dict[Any, Any] = {
    "font.family": "DejaVu Sans",
    "font.size": 9,
    "axes.titlesize": 9,
    "axes.labelsize": 9,
    "legend.fontsize": 8,
    "xtick.labelsize": 8,
    "ytick.labelsize": 8,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.linewidth": 0.7,
    "lines.linewidth": 1.5,
    "legend.frameon": False,
    "svg.fonttype": "none",
    "svg.hashsalt": "pdeloop",
    "savefig.dpi": 200,
    "figure.constrained_layout.use": True,
}


def _srgb(lab: Array) -> Array:
    """CIELAB (D65) to sRGB, shape (..., 3)."""
    f = (lab[..., 0] + 16) / 116
    xyz = np.stack([f + lab[..., 1] / 500, f, f - lab[..., 2] / 200], axis=-1)
    xyz = np.where(xyz > 6 / 29, xyz**3, 3 * (6 / 29) ** 2 * (xyz - 4 / 29))
    xyz = xyz * np.array([0.95047, 1.0, 1.08883])
    matrix = np.array(
        [[3.2406, -1.5372, -0.4986], [-0.9689, 1.8758, 0.0415], [0.0557, -0.2040, 1.0570]]
    )
    linear = np.clip(xyz @ matrix.T, 0.0, 1.0)
    gamma = 1.055 * linear ** (1 / 2.4) - 0.055
    srgb: Array = np.where(linear <= 0.0031308, 12.92 * linear, gamma)
    return srgb


def _diverging() -> ListedColormap:
    """Blue, white, brown, with equal steps in CIELAB."""
    blue, white, brown = (np.array(lab) for lab in ((32, 8, -44), (97, 0, 0), (32, 28, 42)))
    share = np.linspace(0.0, 1.0, 128)[:, None]
    return ListedColormap(
        np.vstack([_srgb(blue + share * (white - blue)), _srgb(white + share * (brown - white))])
    )


GAIN_MAP = _diverging()


def title_of(problem: ProblemData) -> str:
    """The problem's name as a reader writes it."""
    return PROBLEMS.get(problem.name, problem.name)


def training_curves(problems: Sequence[ProblemData]) -> Figure:
    """Cost while learning, relative to LQT: mean and standard deviation over the seeds."""
    figure, axes = _panels(len(problems), height=2.6)
    for ax, problem in zip(axes, problems, strict=True):
        ax.axhline(1.0, color=COLOURS["lqt"], linestyle=STYLES["lqt"], label=TITLES["lqt"])
        low, top = 1.0, 1.0
        for curve in problem.curves:
            relative = curve.relative
            known = np.isfinite(relative).any(axis=1)
            mean, std = np.full(len(relative), np.nan), np.full(len(relative), np.nan)
            mean[known] = np.nanmean(relative[known], axis=1)
            std[known] = np.nanstd(relative[known], axis=1)
            colour = COLOURS[curve.controller]
            below = np.maximum(mean - std, mean / 10)  # the axis is logarithmic
            ax.fill_between(
                curve.iterations, below, mean + std, color=colour, alpha=0.2, linewidth=0
            )
            ax.plot(
                curve.iterations,
                mean,
                color=colour,
                linestyle=STYLES[curve.controller],
                label=TITLES[curve.controller],
            )
            top = max(top, float(np.nanmax(mean + std, initial=1.0)))
            low = min(low, float(np.nanmin(below, initial=1.0)))
        ax.set_yscale("log")
        ax.set_ylim(0.93 * min(low, 0.8), 1.08 * max(top, 1.25))
        ax.yaxis.set_major_locator(LogLocator(10, subs=_ticks(top / low)))
        ax.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        ax.yaxis.set_minor_locator(NullLocator())
        ax.set_xlabel("iteration")
        ax.set_title(title_of(problem))
    axes[0].set_ylabel(problems[0].curve_label)
    _legend_above(figure, axes)
    return figure


def bars(problems: Sequence[ProblemData]) -> Figure:
    """Mean stage cost of each controller over seeds and fields, with the standard deviation."""
    figure, axes = _panels(len(problems), height=2.8)
    for ax, problem in zip(axes, problems, strict=True):
        names = list(problem.costs)
        high = 0.0
        for i, name in enumerate(names):
            costs = problem.costs[name]
            good = costs[costs < DIVERGED_COST]
            if not good.size:
                ax.text(i, 0, "diverged", ha="center", va="bottom", rotation=90)
                continue
            mean, std = float(good.mean()), float(good.std())
            ax.bar(i, mean, color=COLOURS[name], width=0.72)
            ax.errorbar(i, mean, std, color="black", linewidth=0.9, capsize=3)
            ax.text(i, mean + std, f"{mean:.3g}", ha="center", va="bottom", fontsize=8)
            high = max(high, mean + std)
        ax.set_ylim(0, 1.12 * high)
        ax.set_xticks(range(len(names)), [TITLES[name].replace(" ", "\n", 1) for name in names])
        ax.tick_params(axis="x", length=0)
        ax.set_title(title_of(problem))
    axes[0].set_ylabel("mean stage cost")
    return figure


def behaviour(problem: ProblemData) -> Figure:
    """From the mean initial field: the fields in space and time, the actions, the final profiles."""
    shown, components = problem.behaviours, problem.components
    count, fields = len(shown), len(components)
    figure = Figure(figsize=(2.05 * count + 0.9, 1.3 + 2.0 * fields + 1.3 * (1 + fields)))
    grid = figure.subplots(
        2 * fields + 1,
        count,
        sharex="row",
        sharey="row",
        squeeze=False,
        height_ratios=(1.25,) * fields + (1,) * (1 + fields),
    )
    largest = max(float(np.abs(b.actions).max()) for b in shown) or 1.0
    for column, b in enumerate(shown):
        top = grid[0, column]
        top.set_title(f"{TITLES[b.controller]}\nmean stage cost {b.cost:.3g}")
        if b.diverged >= 0:
            top.set_title(f"{TITLES[b.controller]}\ndiverged at step {b.diverged}")
        _actions(grid[fields, column], b, largest)
        grid[fields, column].set_xlabel("t (s)")
        for ax in grid[:, column]:
            ax.xaxis.set_major_locator(MaxNLocator(3))
    grid[fields, 0].set_ylabel("actions $a_j$")
    for i, name in enumerate(components):
        _component(figure, problem, i, grid[i], grid[fields + 1 + i], name)
    return figure


def _component(
    figure: Figure,
    problem: ProblemData,
    index: int,
    maps: Sequence[Axes],
    profiles: Sequence[Axes],
    name: str,
) -> None:
    """A component of the state: its maps in space and time, and its final profiles."""
    n_x = len(problem.x)
    own = slice(index * n_x, (index + 1) * n_x)
    fields = [b.states[:, own] for b in problem.behaviours]
    target = problem.target[own]
    # A few extreme points, a shock's tip, would leave no contrast to the rest.
    low, high = (float(v) for v in np.percentile(np.stack(fields), (0.3, 99.7)))
    length = float(problem.values["length"])
    for b, field, top, bottom in zip(problem.behaviours, fields, maps, profiles, strict=True):
        image = _field(top, length, float(b.t[-1]), field, low, high)
        top.set_xlabel("t (s)")
        bottom.plot(problem.x, target, color="black", linewidth=0.9, label="target")
        bottom.plot(problem.x, field[-1], color=COLOURS[b.controller], label="final field")
        bottom.set_xlim(0, length)
        bottom.set_xlabel("x (m)")
    maps[0].set_ylabel("x (m)")
    profiles[0].set_ylabel(f"{name}(x, T)")
    if index == 0:
        _room_for_legend(profiles[0], [field[-1] for field in fields], target)
        profiles[0].legend(loc="upper left", ncols=1, handlelength=1.4)
    figure.colorbar(image, ax=list(maps), label=f"{name}(x, t)", aspect=14, pad=0.01, extend="both")


def gains(problem: ProblemData) -> Figure:
    """The gains K_a and K_b of each controller: LQT's before, the adapted ones after learning."""
    names = [name for name in problem.policies if name != "none"]
    n_a, n_s = problem.models[0].B.T.shape
    figure = Figure(figsize=(6.4, 0.5 + len(names) * max(1.1, 0.11 * n_a + 0.5)))
    grid = figure.subplots(len(names), 2, sharex=True, sharey=True, squeeze=False)
    for part, (symbol, columns) in enumerate(
        (("$K_a$", slice(0, n_s)), ("$K_b$", slice(n_s, 2 * n_s)))
    ):
        largest = max(float(np.abs(problem.policies[n][:, columns]).max()) for n in names) or 1.0
        for row, name in enumerate(names):
            ax = grid[row, part]
            image = ax.imshow(
                problem.policies[name][:, columns],
                cmap=GAIN_MAP,
                vmin=-largest,
                vmax=largest,
                aspect="auto",
                interpolation="nearest",
                extent=(0.5, n_s + 0.5, n_a + 0.5, 0.5),
            )
            for side in ("top", "right"):
                ax.spines[side].set_visible(True)
            when = "before" if name == "lqt" else "after"
            ax.set_title(f"{symbol}, {TITLES[name]} ({when})", color=COLOURS[name])
            if part == 0:
                ax.set_ylabel("actuator j")
        grid[-1, part].set_xlabel("mode of the reduced state")
        label = f"entry of {symbol}"
        figure.colorbar(image, ax=grid[:, part].tolist(), label=label, aspect=40, pad=0.03)
    grid[0, 0].set_xticks(_whole(n_s))
    grid[0, 0].set_yticks(_whole(n_a))
    return figure


def spectrum(problem: ProblemData) -> Figure:
    """Eigenvalues of the reduced model, without control and with the gains before and after."""
    groups: dict[str, list[Eigenvalues]] = {"none": [], "lqt": []}
    for s, model in enumerate(problem.models):
        n_s = len(model.A)
        groups["none"].append(np.linalg.eigvals(model.A))
        groups["lqt"].append(np.linalg.eigvals(model.A + model.B @ model.K_a))
        for name, policies in problem.adapted.items():
            closed = model.A + model.B @ policies[s][:, :n_s]
            groups.setdefault(name, []).append(np.linalg.eigvals(closed))
    everything = np.concatenate([values for found in groups.values() for values in found])
    near = everything[(np.abs(everything) > 0.8) & (everything.real > 0.5)]
    reach = 1.08 * max(1.0, float(np.abs(everything).max()))
    width = float(np.maximum(1 - near.real, np.abs(near.imag) / 0.6).max(initial=0.01)) * 1.12
    figure = Figure(figsize=(1.9 * len(groups) + 0.5, 4.5))
    grid = figure.subplots(2, len(groups), sharex="row", sharey="row", squeeze=False)
    symbols = {"none": "A", "lqt": "A + B $K_a$"}
    for (whole, detail), (name, found) in zip(grid.T, groups.items(), strict=True):
        for ax in (whole, detail):
            _eigenvalues(ax, found, name, problem.shown)
        whole.set_xlim(-reach, reach)
        whole.set_ylim(-reach, reach)
        detail.set_xlim(1 - width, 1 + 0.3 * width)
        detail.set_ylim(-0.65 * width, 0.65 * width)
        radius = float(np.abs(found[problem.shown]).max())
        whole.set_title(f"{TITLES[name]}: {symbols.get(name, symbols['lqt'])}\nradius {radius:.4f}")
        detail.set_title("around 1")
        detail.set_xlabel("real part")
        detail.tick_params(axis="x", rotation=30)
    for ax in grid[:, 0]:
        ax.set_ylabel("imaginary part")
    return figure


def _eigenvalues(ax: Axes, found: Sequence[Eigenvalues], name: str, shown: int) -> None:
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
            markerfacecolor=COLOURS[name] if s == shown else "none",
            markeredgecolor=COLOURS[name],
            markeredgewidth=0.8,
            alpha=1.0 if s == shown else 0.6,
            zorder=3 if s == shown else 2,
        )
    ax.set_aspect("equal")


def _panels(count: int, height: float) -> tuple[Figure, list[Axes]]:
    figure = Figure(figsize=(max(2.35 * count + 0.5, 3.6), height))
    return figure, list(figure.subplots(1, count, squeeze=False)[0])


def _ticks(ratio: float) -> tuple[float, ...]:
    """Where a logarithmic axis over this ratio has its ticks, within a decade."""
    if ratio > 30:
        return (1.0, 3.0)
    if ratio > 6:
        return (1.0, 2.0, 5.0)
    return (1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 8.0)


def _legend_above(figure: Figure, axes: Sequence[Axes]) -> None:
    entries = {
        label: handle
        for ax in axes
        for handle, label in zip(*ax.get_legend_handles_labels(), strict=True)
    }
    figure.legend(
        list(entries.values()), list(entries), loc="outside upper center", ncols=len(entries)
    )


def _field(
    ax: Axes, length: float, duration: float, field: Array, low: float, high: float
) -> AxesImage:
    for side in ("top", "right"):
        ax.spines[side].set_visible(True)
    return ax.imshow(
        field.T,
        origin="lower",
        aspect="auto",
        cmap=FIELD_MAP,
        vmin=low,
        vmax=high,
        interpolation="nearest",
        extent=(0.0, duration, 0.0, length),
    )


def _actions(ax: Axes, b: Behaviour, largest: float) -> None:
    held = np.vstack([b.actions, b.actions[-1:]])
    for own in held.T:
        ax.step(b.t, own, where="post", color=COLOURS[b.controller], linewidth=0.7, alpha=0.75)
    ax.set_xlim(0, float(b.t[-1]))
    ax.set_ylim(-1.08 * largest, 1.08 * largest)


def _room_for_legend(ax: Axes, finals: Sequence[Array], target: Array) -> None:
    low = min(float(target.min()), *(float(final.min()) for final in finals))
    high = max(float(target.max()), *(float(final.max()) for final in finals))
    span = (high - low) or 1.0
    ax.set_ylim(low - 0.06 * span, high + 0.7 * span)


def _whole(count: int) -> list[int]:
    step = max(1, -(-count // 6))
    return list(range(1, count + 1, step))
