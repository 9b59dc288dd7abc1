# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""What the documents say is enough: their examples and commands run as they stand."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
from scipy.linalg import solve_discrete_are

from pdeloop.messages.model_rows import unpack
from pdeloop.method.seeds import Purpose, derive
from tests.support.loop_harness import ROOT, Processes
from tests.support.small_loop import LIMIT

pytestmark = pytest.mark.topics
STAND_IN = (ROOT / "docs" / "stand-in.md").read_text()
PLANT = ROOT / "examples" / "linear_plant.py"


def code_block(page: str, language: str, mark: str) -> str:
    """The code block of `page` in `language` that contains `mark`."""
    blocks = re.findall(rf"```{language}\n(.*?)```", page, flags=re.DOTALL)
    (block,) = [block for block in blocks if mark in block]
    return str(block)


def documented_command(mark: str) -> list[str]:
    """The ROS arguments of the documented shell line that starts with `mark`."""
    block = code_block(STAND_IN, "sh", "python examples/linear_plant.py").replace("\\\n", " ")
    (line,) = [line for line in block.splitlines() if line.startswith(mark)]
    return line.split("--ros-args")[1].split()


def test_a_linear_plant_of_ordinary_messages_is_identified_and_tuned(
    loop: Processes, tmp_path: Path
) -> None:
    source = PLANT.read_text()
    assert "pdeloop" not in re.sub(r'#.*|"""[^"]*"""', "", source)
    assert not re.search(r"import (pde_sim_node|controller_node|pdeloop)", source)
    space: dict[str, np.ndarray] = {"__name__": "linear_plant"}
    exec(compile(source.split("VOLATILE =")[0], "linear_plant", "exec"), space)
    A, B, target = (np.asarray(space[name]) for name in ("A", "B", "TARGET"))

    loop.start(str(PLANT), name="linear_plant")
    check = loop.start("-m", "pdeloop", "check", "plant", "--n-a", "2", name="check")
    assert "BAD" not in loop.wait(check, LIMIT)
    # Least squares in the plant's own coordinates: what Riccati's equation is compared with below.
    method = "-p", "identification:=regression"
    loop.node("controller_node", *documented_command("controller_node"), *method)
    out = tmp_path / "run"
    command = *documented_command("tuner_node"), *method
    tuner = loop.node("tuner_node", *command, "-p", f"out:={out}")
    text = loop.wait(tuner, LIMIT)

    # Identified: in the plant's own coordinates the reduced model is the plant.
    with np.load(out / "policy.npz") as arrays:
        rows, lqt, adapted = arrays["model"][0], arrays["lqt"][0], arrays["policy"][0]
    model = unpack(rows, n_a=2)
    assert np.allclose(model.U @ model.A @ model.U.T, A, atol=1e-9)
    assert np.allclose(model.U @ model.B, B, atol=1e-9)
    assert np.allclose(model.s_r, model.U.T @ target)

    # Designed: the feedback is that of the Riccati equation of the true plant.
    P = solve_discrete_are(A, B, np.eye(3), np.eye(2))
    K = -np.linalg.solve(np.eye(2) + B.T @ P @ B, B.T @ P @ A)
    assert np.allclose(model.K_a @ model.U.T, K, atol=1e-8)
    K_b = np.linalg.solve(
        np.eye(2) + B.T @ P @ B, B.T @ np.linalg.solve(np.eye(3) - (A + B @ K).T, target)
    )
    assert np.allclose(model.K_b @ model.s_r, K_b, atol=1e-8)

    # Tuned: the costs that came over the topics are those of the policies on the plant.
    def cost(policy: np.ndarray) -> float:
        costs = []
        for i in range(10):
            seed = derive(0, Purpose.EVALUATION_FIELD, i)
            z = np.array([1.0, 0, 0]) + 0.1 * np.random.default_rng(seed).normal(size=3)
            total = 0.0
            for _ in range(50):
                a = policy @ np.concatenate([model.U.T @ z, model.s_r])
                total += float((z - target) @ (z - target) + a @ a)
                z = A @ z + B @ a
            costs.append(total / 50)
        return float(np.mean(costs))

    (found,) = re.findall(r"seed 0: cost [\d.]+ without control, [\d.]+ with LQT, .* adapted", text)
    expected = (cost(0 * lqt), cost(lqt), cost(adapted))
    told = json.loads((tmp_path / "run" / "result.json").read_text())["mean_cost"]
    assert np.allclose([told[name] for name in ("none", "lqt", "adapted")], expected, rtol=1e-9)
    assert not np.array_equal(lqt, adapted)
    assert found in STAND_IN
