# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The law that plans between few sensors, over topics: the bits of one process, through a kill."""

from __future__ import annotations

import os
import signal
from pathlib import Path

import pytest

import pdeloop
from tests.support.loop_harness import Processes, until
from tests.support.small import same_bits
from tests.support.small_loop import LIMIT, adapted
from tests.tools.test_own_law import policies

pytestmark = pytest.mark.topics

PARAMETERS = {
    "sensors": 8,
    "n_a": 3,
    "actuator_width": 0.2,
    "reduced_order": 4,
    "horizon": 10,
    "exploration_variance": 4.0,
    "rollouts": 9,
    "evaluation_fields": 3,
    "law": "predictive",
}
SETTINGS = {
    "optimizer_settings": {"iterations": 5, "mixtures": 2, "judging": 2},
    "law_settings": {"first_iterations": 20, "starts": 2},
}
BEFORE_PLANS = 3
"""Batches of the law without plans."""


def test_a_killed_controller_changes_no_bit_of_a_training_with_plans(
    loop: Processes, tmp_path: Path
) -> None:
    out = tmp_path / "run"
    words = [f"{name}={value}" for name, value in PARAMETERS.items()]
    words += [f"{of}.{name}={value}" for of, own in SETTINGS.items() for name, value in own.items()]
    flags = [word for setting in words for word in ("--set", setting)]
    run = loop.pdeloop("train", "allen-cahn", *flags, "--record", "--out", str(out))
    until(lambda: adapted(out) >= BEFORE_PLANS, LIMIT, "the rollouts of plans")
    (pid,) = loop.pids("controller_node")
    os.kill(pid, signal.SIGKILL)
    told = loop.wait(run, LIMIT)
    assert "controller_node was killed by SIGKILL; starting it again" in told
    here = pdeloop.train("allen-cahn", **PARAMETERS, **SETTINGS)
    assert here.values["law"] == "predictive_kalman" and here.laws[0].is_extended(here.policies[0])
    assert [own["law"] for own in here.result["acting"]] == ["predictive"]
    assert len(here.result["history"]) == BEFORE_PLANS + 1
    assert same_bits(policies(out), here.policies)
    verified = loop.wait(loop.pdeloop("bag", "verify", str(out)), LIMIT)
    assert "no difference, to the bit" in verified
