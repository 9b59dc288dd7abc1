"""The examples of docs/bring-your-own.md, run as the page says."""

from __future__ import annotations

import importlib.util
import re
import shlex
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from loop_interfaces.problem import load_parameters
from pde_sim_node.build import build_plant
from tests.loop_harness import ROOT, Processes
from tests.topics.test_loop import LIMIT
from tuner_node.seeds import Purpose, derive

pytestmark = pytest.mark.topics
PAGE = (ROOT / "docs" / "bring-your-own.md").read_text()
EXAMPLES = ROOT / "examples"


def commands(mark: str) -> list[list[str]]:
    """The lines of the shell block of the page that contains `mark`, as words."""
    blocks = re.findall(r"```sh\n(.*?)```", PAGE, flags=re.DOTALL)
    (block,) = [block for block in blocks if mark in block]
    return [shlex.split(line) for line in block.replace("\\\n", " ").splitlines()]


def ros_arguments(mark: str, start: str) -> list[str]:
    (words,) = [line for line in commands(mark) if line[: len(start.split())] == start.split()]
    return words[words.index("--ros-args") + 1 :]


def example(name: str) -> Any:
    spec = importlib.util.spec_from_file_location(name, EXAMPLES / f"{name}.py")
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_a_controller_of_ones_own_is_tuned(loop: Processes, tmp_path: Path) -> None:
    source = (EXAMPLES / "saturated_controller.py").read_text()
    assert not re.search(r"import (loop_interfaces|pde_sim_node|controller_node|bringup)", source)
    mark = "examples/saturated_controller.py"
    problem = str(ROOT / "config" / "problems" / "burgers.yaml")

    def arguments(start: str) -> list[str]:
        given = ros_arguments(mark, start)
        return [problem if word == "config/problems/burgers.yaml" else word for word in given]

    loop.node("pde_sim_node", *arguments("pde_sim_node"))
    controller = arguments("python examples/saturated_controller.py")
    loop.start(str(EXAMPLES / "saturated_controller.py"), "--ros-args", *controller)
    out = tmp_path / "run"
    tuner = loop.node("tuner_node", *arguments("tuner_node"), "-p", f"out:={out}")
    text = loop.wait(tuner, 3 * LIMIT)

    with np.load(out / "policy.npz") as arrays:
        first, adapted = arrays["lqt"][0], arrays["policy"][0]
    module = example("saturated_controller")
    assert np.array_equal(first, np.tile([module.P, module.F], (6, 1)))
    # The costs that came over the topics are those of the law on the plant.
    plant = build_plant(load_parameters("burgers", {}))
    seeds = [derive(0, Purpose.EVALUATION_FIELD, i) for i in range(10)]

    def cost(policy: np.ndarray) -> float:
        z = plant.reset(seeds)
        for _ in range(plant.horizon):
            actions = module.law(np.repeat(policy[None], 10, axis=0), z, plant.target)
            assert np.abs(actions).max() <= module.A_MAX
            z = plant.step(actions)
        return float(plant.episode_costs().mean.mean())

    found = re.search(
        r"done: cost ([\d.]+) without control, ([\d.]+) with LQT, ([\d.]+) adapted", text
    )
    assert found
    # A policy of zeros is no control for this law, too.
    expected = [cost(0 * first), cost(first), cost(adapted)]
    np.testing.assert_allclose([float(word) for word in found.groups()], expected, rtol=1e-5)
    assert expected[2] < expected[1] < expected[0]
    assert found.group() in PAGE
