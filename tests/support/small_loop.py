# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The small problem over topics: its nodes, how far its training is, and what must come of it."""

from __future__ import annotations

import json
import subprocess
from functools import cache
from pathlib import Path

import numpy as np

from tests.support.loop_harness import Processes
from tests.support.small import SMALL, parameters, same_bits, train_here
from tuner_node.training import Training

LIMIT = 240.0
"""Seconds after which a small training has failed, however busy the machine; an idle one needs 5."""
PARAMETERS = ("--params-file", str(SMALL))


@cache
def in_process(seed: int = 0, iterations: int = 20, seeds: int = 1) -> Training:
    return train_here(parameters(seed=seed, iterations=iterations, seeds=seeds))


def assert_same_training(folder: Path, expected: Training) -> None:
    """The run in `folder` has the policy, the model and the costs of `expected`, bit for bit."""
    with np.load(folder / "policy.npz") as arrays:
        assert same_bits(arrays["model"], expected.models)
        assert same_bits(arrays["policy"], expected.policies())
    result = json.loads((folder / "result.json").read_text())
    costs = np.array([result["costs_by_field"][name] for name in ("none", "lqt", "adapted")])
    assert same_bits(costs.transpose(1, 0, 2).copy(), expected.evaluation)


def tuner_arguments(out: Path, **options: object) -> list[str]:
    budget = {} if "rollouts" in options else {"iterations": 20}
    values = {**budget, "out": out, **options}
    return [word for name, value in values.items() for word in ("-p", f"{name}:={value}")]


def adapted(folder: Path) -> int:
    """Batches that the optimisers of the run in `folder` have been told."""
    path = folder / "progress.jsonl"
    return path.read_text().count('"event": "adapted"') if path.exists() else 0


def start_pair(loop: Processes, **plant: object) -> dict[str, subprocess.Popen[bytes]]:
    own = [word for name, value in plant.items() for word in ("-p", f"{name}:={value}")]
    return {
        "plant": loop.node("pde_sim_node", *PARAMETERS, *own),
        "controller": loop.node("controller_node", *PARAMETERS),
    }


def start_tuner(
    loop: Processes, out: Path, *words: str, **options: object
) -> subprocess.Popen[bytes]:
    return loop.node("tuner_node", *PARAMETERS, *words, *tuner_arguments(out, **options))
