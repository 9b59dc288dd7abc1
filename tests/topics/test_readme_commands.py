# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The README's commands one after the other: each accepts what the one before it left."""

from __future__ import annotations

import json
import re

import numpy as np
import pytest

from tests.support.loop_harness import Processes
from tests.support.undrawn import report

pytestmark = pytest.mark.topics
LIMIT = 240.0
"""Seconds for one command; the first use of an equation may compile its kernel."""


def pdeloop(loop: Processes, *words: object) -> str:
    # As a user starts them, where the libraries they load, and when, decide on bits.
    loop.forks = words[0] == "identify"
    return loop.wait(loop.pdeloop(*map(str, words)), LIMIT)


def test_a_run_that_explored_again_is_verified_identified_from_evaluated_and_reported(
    loop: Processes, tmp_path
):
    run, model = tmp_path / "run", tmp_path / "model.npz"
    options = ("--optimizer", "two-point", "--rollouts", 26, "--seed", 1, "--evaluation-fields", 2)
    text = pdeloop(loop, "train", "burgers", "--record", *options, "--out", run)
    assert f"recorded in {run / 'bag'}" in text
    rows = [json.loads(line) for line in (run / "progress.jsonl").read_text().splitlines()]
    assert [row["event"] for row in rows].count("designed") == 2
    text = pdeloop(loop, "bag", "verify", run)
    assert "no difference, to the bit" in text
    assert "not followed" not in text and "incomplete" not in text
    (policies,) = re.findall(r"(\d+) policies", text)
    # All but the two explorations; the first again, and three controllers on two fields, at the end.
    assert int(policies) == 26 - 2 + 1 + 3 * 2

    text = pdeloop(loop, "identify", "--bag", run, "--environment", 0, "--out", model)
    assert "reduced model of order" in text
    with np.load(model) as identified, np.load(run / "policy.npz") as adapted:
        assert identified["K_a"].shape[0] == adapted["policy"].shape[1]

    costs = json.loads(pdeloop(loop, "evaluate", run, "--fields", 2, "--json"))
    result = json.loads((run / "result.json").read_text())
    assert costs["adapted"] == result["costs_by_field"]["adapted"]

    loop.forks = True
    report(loop, run, LIMIT)
    (page,) = run.rglob("*.html")
    assert "burgers" in page.read_text()
