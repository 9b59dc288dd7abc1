"""The README's commands one after the other: each accepts what the one before it left."""

from __future__ import annotations

import json
import re
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from tests.loop_harness import Processes

pytestmark = pytest.mark.topics
LIMIT = 240.0
"""Seconds for one command; the first use of an equation may compile its kernel."""


def explorations(run: Path) -> list[int]:
    """How often each seed of the run in the folder `run` was explored."""
    rows = [json.loads(line) for line in (run / "progress.jsonl").read_text().splitlines()]
    counts = Counter(row["seed"] for row in rows if row.get("event") == "designed")
    return [counts[seed] for seed in sorted(counts)]


def recorded(loop: Processes, run: Path, problem: str, optimizer: str, *more: int) -> None:
    """Record a training with a small budget, and verify its bag."""
    rollouts, seed, seeds = more
    options = ("--optimizer", optimizer, "--rollouts", rollouts, "--seed", seed, "--seeds", seeds)
    text = pdeloop(loop, "train", problem, "--record", *options, "--out", run)
    assert f"recorded in {run / 'bag'}" in text
    text = pdeloop(loop, "bag", "verify", run)
    assert "no difference, to the bit" in text
    assert "not followed" not in text and "incomplete" not in text
    (policies,) = re.findall(r"(\d+) policies", text)
    assert int(policies) >= 30 * seeds  # the closing evaluation alone has three on ten fields


def pdeloop(loop: Processes, *words: object) -> str:
    loop.forks = False  # as a user starts them: the libraries they load, and when, decide on bits
    return loop.wait(loop.pdeloop(*map(str, words)), LIMIT)


def test_a_run_that_explored_again_is_verified_identified_from_evaluated_and_reported(
    loop: Processes, tmp_path
):
    run, model = tmp_path / "run", tmp_path / "model.npz"
    recorded(loop, run, "burgers", "two-point", 26, 1, 2)
    assert explorations(run) == [2, 1]

    text = pdeloop(loop, "identify", "--bag", run, "--environment", 0, "--out", model)
    assert "reduced model of order" in text
    with np.load(model) as identified, np.load(run / "policy.npz") as adapted:
        assert identified["K_a"].shape[0] == adapted["policy"].shape[1]

    costs = json.loads(pdeloop(loop, "evaluate", run, "--json"))
    result = json.loads((run / "result.json").read_text())
    assert costs["adapted"] == result["costs_by_field"]["adapted"]

    pdeloop(loop, "report", run)
    (page,) = run.rglob("*.html")
    assert "burgers" in page.read_text()


@pytest.mark.parametrize(("problem", "seed"), [("allen-cahn", 0), ("kdv", 0)])
def test_a_run_that_explored_once_is_verified(loop: Processes, tmp_path, problem, seed):
    recorded(loop, tmp_path / "run", problem, "gauss-newton", 14, seed, 1)
    assert explorations(tmp_path / "run") == [1]
