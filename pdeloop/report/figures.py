"""The figures of a report about one problem: one function each, data in, a matplotlib figure out."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from pdeloop.report.data import Behaviour, ProblemData
from pdeloop.report.style import COLOURS, FIELD_MAP, GAIN_MAP, TITLES

Array = NDArray[np.float64]
Eigenvalues = NDArray[Any]


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
        A, B = model.A, model.B
        groups["none"].append(np.linalg.eigvals(A))
        groups["lqt"].append(np.linalg.eigvals(A + B @ model.K_a))
        for name, policies in problem.adapted.items():
            closed = A + B @ policies[s][:, : len(A)]
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
        detail.xaxis.set_major_locator(MaxNLocator(4))
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
