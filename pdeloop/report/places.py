# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Marks beside a field in a figure: actuators, sensors and the target; and actions as applied."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.transforms import ScaledTranslation
from numpy.typing import NDArray

from pde_sim_node.plant import Plant
from pdeloop.messages.action_set import ActionSet
from pdeloop.messages.arrays import Array
from pdeloop.messages.grid import Grid
from pdeloop.report.style import field_image

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
    field_image(strip, target[:, None], extent, limits)
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


FEW = 6
"""Actuators whose curves are told apart by colour; of more the actions are drawn as a picture."""
CURVES = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9")
"""Okabe, Ito, Color Universal Design, 2008."""


def saturated(applied: Array, allowed: ActionSet) -> float:
    """Share of applied actions (T, .., n_a) at a bound or rate limit of their actuator."""
    known = np.isfinite(applied)
    return float((known & allowed.held_back(applied)).sum() / max(known.sum(), 1))


def share_text(applied: Array, allowed: ActionSet) -> str:
    """The share in words; empty without bounds."""
    if not (allowed.rated or np.isfinite([allowed.low, allowed.high]).any()):
        return ""
    limits = " or rate limit" * allowed.rated
    return f"{100 * saturated(applied, allowed):.3g} % at a bound{limits}"


def action_range(parts: list[Array], allowed: ActionSet) -> tuple[float, float]:
    """The common range of actions, with 0 and the bounds that some come near to."""
    values = np.concatenate([part.ravel() for part in parts])
    values = values[np.isfinite(values)]
    low, high = float(values.min(initial=0.0)), float(values.max(initial=0.0))
    return (low, high) if high > low else (low - 1.0, high + 1.0)


def held_actions(
    ax: Axes,
    times: Array,
    applied: Array,
    allowed: ActionSet,
    limits: tuple[float, float],
    fontsize: float = 7,
) -> object | None:
    """Draw the actions (T, n_a) of one environment; the picture, for a colour bar, if it is one.

    fontsize: of the share of actions at a bound, above them.
    """
    n_a = applied.shape[1]
    ax.set_xlabel("t (s)")
    ax.set_xlim(0.0, float(times[-1]))
    if text := share_text(applied, allowed):
        ax.set_title(text, loc="right", fontsize=fontsize, color="0.4", pad=2)
    if n_a > FEW:
        extent = (0.0, float(times[-1]), 0.5, n_a + 0.5)
        drawn: object = field_image(ax, applied.T, extent, limits)
        ax.set_facecolor("0.9")
        step = max(1, -(-n_a // 12))
        ax.set_yticks(range(1, n_a + 1, step))
        ax.tick_params(axis="y", labelsize=6.5)
        return drawn
    margin = 0.06 * (limits[1] - limits[0])
    ax.set_ylim(limits[0] - margin, limits[1] + margin)
    bounds = [np.broadcast_to(bound, n_a) for bound in (allowed.low, allowed.high)]
    for bound in np.unique([b for own in bounds for b in own if np.isfinite(b)]):
        ax.axhline(float(bound), color="0.35", linestyle=":", linewidth=0.8)
    for j, a in enumerate(applied.T):
        ax.step(
            times,
            np.r_[a, a[-1:]],
            where="post",
            color=CURVES[j],
            linewidth=0.9,
            label=f"$a_{{{j + 1}}}$",
        )
    return None


def name_actions(ax: Axes, n_a: int) -> None:
    """The label of an axis on which actions are drawn, with a legend of the curves.

    The legend is above the text at the right, which has to be there before.
    """
    if n_a > FEW:
        ax.set_ylabel("actuator j")
        return
    ax.set_ylabel("actions $a_j$")
    if n_a > 1:
        above = ScaledTranslation(0.0, 11.0 / 72.0, ax.figure.dpi_scale_trans)
        ax.legend(
            loc="lower left",
            bbox_to_anchor=(0.0, 0.97),
            bbox_transform=ax.transAxes + above if ax.get_title("right") else ax.transAxes,
            ncols=n_a,
            fontsize=7,
            handlelength=0.8,
            handletextpad=0.3,
            columnspacing=0.7,
            borderpad=0.0,
        )
