# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The common style of a report's figures. A controller's colour: pdeloop.messages.controllers.

Fields are drawn in the colours of pdeloop.messages.colour_scale and gains with PuOr, which any colour
vision can read.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
from matplotlib import rcParamsDefault
from matplotlib.axes import Axes
from matplotlib.collections import Collection
from matplotlib.colors import LinearSegmentedColormap, to_rgba, to_rgba_array
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.text import Text
from matplotlib.ticker import FuncFormatter, LogLocator, NullLocator

from pdeloop.messages.arrays import Array
from pdeloop.messages.colour_scale import DARK, LIGHT
from pdeloop.messages.controllers import CONTROLLERS

COLOURS = {key: controller.colour for key, controller in CONTROLLERS.items()}
NAMES = {key: controller.name for key, controller in CONTROLLERS.items()}
LINES: dict[str, Any] = {"lqt": "--", "pure_po": "-.", "model_based": (0, (5, 1))}
"""Line styles; the others are solid."""
_LOOKS = (
    "axes.", "contour.", "errorbar.", "figure.", "font.", "grid.", "hatch.", "image.", "legend.",
    "lines.", "markers.", "mathtext.", "patch.", "path.", "pcolor.", "savefig.", "scatter.", "svg.",
    "text.", "xtick.", "ytick.",
)  # fmt: skip
"""How the parameters of Matplotlib begin that are all set: a reader's file may ask for TeX."""
FIELD_MAP, GAIN_MAP = LinearSegmentedColormap.from_list("field", LIGHT), "PuOr"
STYLE: dict[Any, Any] = {
    **{name: value for name, value in rcParamsDefault.items() if name.startswith(_LOOKS)},
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


def panels(count: int, height: float, width: float, least: float) -> tuple[Figure, list[Axes]]:
    """A row of this many axes of this width, in a figure that is not narrower than `least` (inches)."""
    figure = Figure(figsize=(max(width * count + 0.5, least), height))
    return figure, list(figure.subplots(1, count, squeeze=False)[0])


def image(ax: Axes, values: Array, extent: tuple[float, float, float, float], **more: Any) -> Any:
    """Draw a matrix as a picture over `extent`, inside a frame."""
    ax.spines[["top", "right"]].set_visible(True)
    return ax.imshow(values, aspect="auto", interpolation="nearest", extent=extent, **more)


def field_image(
    ax: Axes,
    values: Array,
    extent: tuple[float, float, float, float],
    limits: tuple[float, float],
) -> Any:
    """Draw a matrix in the colours of fields between these limits, its first row below."""
    low, high = limits
    return image(ax, values, extent, origin="lower", cmap=FIELD_MAP, vmin=low, vmax=high)


def plain_log(ax: Axes, ratio: float) -> None:
    """A logarithmic axis over this ratio, its ticks written as plain numbers."""
    ax.set_yscale("log")
    subs = (
        (1.0,)
        if ratio > 1e4
        else (1.0, 3.0)
        if ratio > 30
        else (1.0, 2.0, 5.0)
        if ratio > 6
        else (1.0, 1.5, 2, 3, 4, 6, 8)
    )
    ax.yaxis.set_major_locator(LogLocator(10, subs=subs))
    ax.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    ax.yaxis.set_minor_locator(NullLocator())


BACK, INK = "#14171c", "#e8eaee"
"""Substitutes for white and black; the page has the same."""
GREY = 0.03
"""Differences of red, green and blue up to which a colour counts as a grey."""
MAPS = {
    FIELD_MAP.name: LinearSegmentedColormap.from_list("field on dark", DARK),
    GAIN_MAP: LinearSegmentedColormap.from_list(
        "gain on dark", ("#ffc46b", "#a8651a", "#1b1f26", "#6f63ad", "#d3c8ff")
    ),
}


def darken(figure: Figure) -> None:
    """Change the colours of a drawn figure to those on a dark background.

    Greys are turned around, the colours of controllers and of maps are those for a dark background, and
    others stay.
    """
    for drawn in figure.findobj(AxesImage):
        if drawn.get_cmap().name in MAPS:
            drawn.set_cmap(MAPS[drawn.get_cmap().name])  # its bar follows
    for artist in figure.findobj():
        _darken(artist)


def _darken(artist: Any) -> None:
    match artist:
        case Line2D():
            artist.set_color(_one(artist.get_color()))
            artist.set_markerfacecolor(_one(artist.get_markerfacecolor()))
            artist.set_markeredgecolor(_one(artist.get_markeredgecolor()))
        case Text():
            artist.set_color(_one(artist.get_color()))
        case Patch():
            artist.set_edgecolor(_one(artist.get_edgecolor()))
            artist.set_facecolor(_one(artist.get_facecolor()))
        case Collection() if artist.get_array() is None:
            edges, faces = artist.get_edgecolor(), artist.get_facecolor()
            artist.set_edgecolor([_one(colour) for colour in to_rgba_array(edges)])
            artist.set_facecolor([_one(colour) for colour in to_rgba_array(faces)])


def _one(colour: Any) -> Any:
    """A colour on dark."""
    if isinstance(colour, str) and colour == "none":
        return colour
    return _on_dark(to_rgba(colour))


@cache
def _on_dark(colour: tuple[float, float, float, float]) -> tuple[float, float, float, float]:
    """A figure has thousands of artists in a dozen colours."""
    rgba = np.array(colour)
    for controller in CONTROLLERS.values():
        if np.allclose(rgba[:3], to_rgba(controller.colour)[:3], atol=2e-3):
            return (*to_rgba(controller.on_dark)[:3], float(rgba[3]))
    if np.ptp(rgba[:3]) > GREY:
        return colour
    level = float(rgba[:3].mean())
    turned: Array = level * np.array(to_rgba(BACK)[:3]) + (1 - level) * np.array(to_rgba(INK)[:3])
    return (*turned.tolist(), float(rgba[3]))
