# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Small trainings whose laws plan, or have a network, on a chaotic plant: made once for all tests."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

import pytest

import pdeloop
from tests.support.made_once import made_once
from tests.support.small import FEW_FITS

PROBLEM = "kuramoto-sivashinsky-22"
FEW_STARTS = {"first_iterations": 20, "starts": 2}
SHARED = {"n_z": 32, "reduced_order": 8, "evaluation_fields": 2, **FEW_FITS}
PLANNED: Mapping[str, Mapping[str, Any]] = MappingProxyType(
    {
        "auto": {**SHARED, "horizon": 40, "rollouts": 15, "law_settings": FEW_STARTS},
        "neural": {
            **{**SHARED, "horizon": 25, "rollouts": 12, "seed": 1},
            "law_settings": {"neurons": 8, "iterations": 40},
        },
    }
)
"""The parameters of each, by the law."""


def trained(factory: pytest.TempPathFactory, law: str) -> Path:
    """The folder of the finished training with this law."""

    def make(folder: Path) -> Path:
        pdeloop.train(PROBLEM, **PLANNED[law], law=law, out=folder / "run")
        return folder / "run"

    return made_once(factory, f"planned-{law}", make)
