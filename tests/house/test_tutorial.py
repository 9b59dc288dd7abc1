# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The cells of the tutorial run as they stand, on a smaller problem and with fewer steps."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np

from tests.support.small import FEW_FITS

NOTEBOOK = Path(__file__).resolve().parents[2] / "docs" / "tutorial.ipynb"
FEWER = {"ROLLOUTS": 9, "ITERATIONS": 3, "SIZE": {"n_z": 32, "horizon": 30, **FEW_FITS}}


def test_the_cells_of_the_tutorial_run() -> None:
    matplotlib.use("agg")
    import matplotlib.pyplot as plt

    cells = json.loads(NOTEBOOK.read_text())["cells"]
    code = ["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"]
    names: dict[str, Any] = {}
    for number, text in enumerate(code):
        exec(compile(text, f"cell {number}", "exec"), names)
        if number == 0:
            assert FEWER.keys() <= names.keys()
            names |= FEWER
    plt.close("all")
    assert np.array_equal(-names["returns"] / 30, names["tracked"].costs.mean)
    assert names["history"][-1] < names["tracked"].costs.mean[0]
