# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Shared by the tests of the interfaces: a finished run, and a copy that may be damaged."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from pdeloop.cli import main
from tests.support.made_once import made_once
from tests.support.small import FEW_STEPS, SMALL


@pytest.fixture(scope="module")
def finished(request, tmp_path_factory) -> Path:
    """The folder of a finished run of the small problem, by two_point or by the optimizer asked for."""
    optimizer = getattr(request, "param", "two_point")

    def make(folder: Path) -> Path:
        out = folder / "run"
        options = ["--in-process", "--optimizer", optimizer, "--rollouts", "15", "--out", str(out)]
        if optimizer == "model_based":
            options += [
                word for n, value in FEW_STEPS.items() for word in ("--set", f"{n}={value}")
            ]
        assert main(["train", str(SMALL), *options]) == 0
        return out

    return made_once(tmp_path_factory, f"run-by-{optimizer}", make)


@pytest.fixture
def run(finished, tmp_path) -> Path:
    """A copy of it that may be damaged."""
    return Path(shutil.copytree(finished, tmp_path / "run"))
