"""What all figures of a report share: colours, names, and where things go.

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
from numpy.typing import NDArray

from pdeloop.report.data import ProblemData

Array = NDArray[np.float64]
COLOURS = {
    "none": "#8C8C8C",
    "lqt": "#0072B2",
    "lqt_po": "#D55E00",
    "pure_po": "#009E73",
    "optimum": "#CC79A7",
    "open_loop": "#404040",
}
STYLES: dict[str, Any] = {
    "none": ":",
    "lqt": "--",
    "lqt_po": "-",
    "pure_po": "-.",
    "optimum": (0, (1, 1)),
}
TITLES = {
    "none": "no control",
    "lqt": "LQT",
    "lqt_po": "LQT-PO",
    "pure_po": "pure PO",
    "optimum": "best of class",
    "open_loop": "open-loop limit",
}
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


def panels(
    count: int, height: float, width: float = 2.35, least: float = 3.6
) -> tuple[Figure, list[Axes]]:
    """A row of so many axes of this width, in a figure that is not narrower than `least` (inches)."""
    figure = Figure(figsize=(max(width * count + 0.5, least), height))
    return figure, list(figure.subplots(1, count, squeeze=False)[0])


def log_ticks(ratio: float) -> tuple[float, ...]:
    """Where a logarithmic axis over this ratio has its ticks, within a decade."""
    if ratio > 30:
        return (1.0, 3.0)
    if ratio > 6:
        return (1.0, 2.0, 5.0)
    return (1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 8.0)


def legend_above(figure: Figure, axes: Sequence[Axes]) -> None:
    """One legend for all axes, above them."""
    entries = {
        label: handle
        for ax in axes
        for handle, label in zip(*ax.get_legend_handles_labels(), strict=True)
    }
    figure.legend(
        list(entries.values()), list(entries), loc="outside upper center", ncols=len(entries)
    )
