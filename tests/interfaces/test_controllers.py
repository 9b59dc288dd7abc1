# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Names and colours of the controllers: each its own, and told apart with any colour vision."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest

from pdeloop.messages.controllers import CONTROLLERS
from tuner_node.rollouts import EVALUATED

VISION = {
    "normal": np.eye(3),
    # Machado, Oliveira, Fernandes, IEEE Trans. Vis. Comput. Graph. 15(6), 2009, severity 1.
    "protanopia": np.array(
        [
            [0.152286, 1.052583, -0.204868],
            [0.114503, 0.786281, 0.099216],
            [-0.003882, -0.048116, 1.051998],
        ]
    ),
    "deuteranopia": np.array(
        [
            [0.367322, 0.860646, -0.227968],
            [0.280085, 0.672501, 0.047413],
            [-0.011820, 0.042940, 0.968881],
        ]
    ),
}
TOGETHER = [name for name in CONTROLLERS if name != "adapted"]
"""Those of one figure of a reproduction; `adapted` is there as `model_based`."""


def linear(colour: str) -> np.ndarray:
    """Linear sRGB of a hexadecimal colour."""
    value = np.array([int(colour[i : i + 2], 16) for i in (1, 3, 5)]) / 255
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)


def lab(rgb: np.ndarray) -> np.ndarray:
    """CIELAB (D65) of linear sRGB."""
    xyz = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])
    t = np.clip(xyz @ rgb, 0, None) / (0.95047, 1.0, 1.08883)
    f = np.where(t > (6 / 29) ** 3, np.cbrt(t), t / (3 * (6 / 29) ** 2) + 4 / 29)
    return np.array([116 * f[1] - 16, 500 * (f[0] - f[1]), 200 * (f[1] - f[2])])


def luminance(colour: str) -> float:
    return float(linear(colour) @ (0.2126, 0.7152, 0.0722))


def test_a_run_evaluates_controllers_that_have_a_name():
    assert set(EVALUATED) <= set(CONTROLLERS)
    names = [controller.name for controller in CONTROLLERS.values()]
    assert len(set(names)) == len(names)


@pytest.mark.parametrize("vision", VISION)
@pytest.mark.parametrize("background", ["colour", "on_dark"])
def test_the_controllers_of_one_figure_differ_with_any_colour_vision(vision, background):
    for a, b in combinations(TOGETHER, 2):
        one, other = (
            lab(VISION[vision] @ linear(getattr(CONTROLLERS[name], background))) for name in (a, b)
        )
        assert np.linalg.norm(one - other) > 15, (a, b)


def test_colours_stand_out_from_their_background():
    """The ratio (L1 + 0.05)/(L2 + 0.05) of the WCAG; black on white has 21."""
    for name, controller in CONTROLLERS.items():
        assert 1.05 / (luminance(controller.colour) + 0.05) > 2, name
        assert (luminance(controller.on_dark) + 0.05) / (luminance("#101318") + 0.05) > 5, name
