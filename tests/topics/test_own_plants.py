# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Plants of a user's own in a process of their own: the bits of one process, recorded, and failures."""

from __future__ import annotations

import json
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.support.interpreter import ROOT
from tests.support.loop_harness import Processes
from tests.support.small import FEW_FITS, same_bits
from tests.support.small_loop import LIMIT

pytestmark = pytest.mark.topics
PLANTS = ROOT / "examples" / "plants"
LINEAR, PLATE = f"{PLANTS}/random_linear.py:RandomLinear", f"{PLANTS}/plate.py:Plate"
PENDULUM = f"{PLANTS}/pendulum.py:upright"
BUDGET: dict[str, Any] = {"rollouts": 9, "evaluation_fields": 2, "reduced_order": 6}


def solver(module: str, name: str, given: dict[str, Any]) -> Any:
    """A case of an example that needs the extra `solvers`."""
    lacking = pytest.mark.skipif(
        find_spec(module) is None, reason=f"{module} is not installed: extra solvers"
    )
    return pytest.param(f"{PLANTS}/{name}", given, "two_point", marks=lacking)


def flags(budget: dict[str, Any]) -> list[str]:
    named = [(f"--{name.replace('_', '-')}", str(value)) for name, value in budget.items()]
    return [word for pair in named for word in pair]


def policies(folder: Path) -> np.ndarray:
    with np.load(folder / "policy.npz") as arrays:
        return np.asarray(arrays["policy"])


def plant_of(folder: Path) -> object:
    return json.loads((folder / "result.json").read_text())["plant"]


@pytest.mark.parametrize(
    ("name", "given", "optimizer"),
    [
        (LINEAR, {"radius": 0.9}, "two_point"),
        (PLATE, {"nx": 6, "ny": 4}, "model_based"),
        (PENDULUM, {"horizon": 20}, "model_based"),
        (f"{PLANTS}/plate_skfem.py:Plate", {"refinements": 1}, "two_point"),
        solver("pde", "swift_hohenberg_pypde.py:SwiftHohenberg", {"points": 6}),
        solver("exponax", "burgers_exponax.py:Burgers", {"points": 16}),
    ],
)
def test_a_plant_of_ones_own_is_trained_over_topics_to_the_same_bits_and_recorded(
    loop: Processes, tmp_path: Path, name: str, given: dict[str, Any], optimizer: str
) -> None:
    if "exponax" in name:  # JAX has threads, which do not survive a fork
        loop.forks = False
    problem = tmp_path / "own.yaml"
    few = FEW_FITS if optimizer != "two_point" else {}
    problem.write_text(json.dumps({"/**": {"ros__parameters": {"physical": given, **few}}}))
    out, here = tmp_path / "run", tmp_path / "here"
    budget = {**BUDGET, "optimizer": optimizer}
    if optimizer == "model_based":  # its last rollouts compare laws: with 9 no step is confirmed
        budget["rollouts"] = 12
    words = [str(problem), "--plant", name, *flags(budget)]
    loop.wait(loop.pdeloop("train", *words, "--record", "--out", str(out)), LIMIT)
    loop.wait(loop.pdeloop("train", *words, "--in-process", "--out", str(here)), LIMIT)
    assert same_bits(policies(out), policies(here))
    assert plant_of(out) == plant_of(here)
    verified = loop.wait(loop.pdeloop("bag", "verify", str(out), "--plant", name), LIMIT)
    assert "no difference, to the bit" in verified
    refused = loop.wait(loop.pdeloop("bag", "verify", str(out)), LIMIT, code=1)
    assert "is code, which is not run merely because a file names it" in refused


def test_a_plant_that_fails_ends_its_node_and_the_training_with_the_cause(
    loop: Processes, tmp_path: Path
) -> None:
    own = tmp_path / "own.py"
    own.write_text(
        (PLANTS / "random_linear.py")
        .read_text()
        .replace(
            "        return self.A @ z",
            "        assert abs(z).max() < 3.5, 'too hot'\n        return self.A @ z",
        )
    )
    words = ["--plant", f"{own}:RandomLinear", *flags(BUDGET), "--out", str(tmp_path / "run")]
    told = loop.wait(loop.pdeloop("train", *words), LIMIT, code=1)
    assert f"pde_sim_node: RandomLinear.step fails: {own}, line 21: AssertionError: too hot" in told
    assert "Traceback" not in told
