# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Actions over time as the actuators applied them: curves of a few, a picture of many."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.transforms import ScaledTranslation

from pdeloop.messages.action_set import ActionSet
from pdeloop.messages.arrays import Array
from pdeloop.report.style import FIELD_MAP, image

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
    ax: Axes, times: Array, applied: Array, allowed: ActionSet, limits: tuple[float, float]
) -> object | None:
    """Draw the actions (T, n_a) of one environment; the picture, for a colour bar, if it is one."""
    n_a = applied.shape[1]
    ax.set_xlim(0.0, float(times[-1]))
    if n_a > FEW:
        extent = (0.0, float(times[-1]), 0.5, n_a + 0.5)
        drawn: object = image(
            ax, applied.T, extent, origin="lower", cmap=FIELD_MAP, vmin=limits[0], vmax=limits[1]
        )
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
