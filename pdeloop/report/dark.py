# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A figure for a dark page, from the same figure for a white one."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
from matplotlib.collections import Collection
from matplotlib.colors import LinearSegmentedColormap, to_rgba, to_rgba_array
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.text import Text

from pdeloop.messages.arrays import Array
from pdeloop.messages.colour_scale import DARK
from pdeloop.messages.controllers import CONTROLLERS
from pdeloop.report.style import FIELD_MAP, GAIN_MAP

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
