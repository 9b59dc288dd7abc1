# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A plant that begins and stays at its target: every cost is 0, and no command divides by it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from pdeloop.cli import main
from tests.support.small import FEW_STEPS

RESTING = """
import numpy as np
import pdeloop

class Resting(pdeloop.Dynamics):
    n_z, n_a, horizon = 6, 2, 30

    def initial_state(self, rng):
        return np.zeros(6)

    def step(self, z, a):
        return 0.9 * z + np.eye(6, 2) @ a
"""


@pytest.mark.parametrize("optimizer", ["model_based", "two_point"])
def test_a_training_with_nothing_to_control_says_so_and_can_be_shown(
    optimizer: str, tmp_path: Path, capsys: Any, undrawn: None
) -> None:
    file, out = tmp_path / "resting.py", str(tmp_path / "run")
    file.write_text(RESTING)
    plant = ["--plant", f"{file}:Resting"]
    words = ["--in-process", "--optimizer", optimizer, "--rollouts", "7", "--out", out]
    if optimizer == "model_based":
        words += [word for own in FEW_STEPS.items() for word in ("--set", "{}={}".format(*own))]
    assert main(["train", *plant, *words]) == 0
    assert "there is nothing to control" in capsys.readouterr().out
    assert main(["compare", out, out]) == 0
    assert "nan" not in capsys.readouterr().out
    assert main(["report", out, *plant]) == 0
    assert main(["evaluate", out, *plant]) == 0
    assert "there is nothing to control" in capsys.readouterr().err
