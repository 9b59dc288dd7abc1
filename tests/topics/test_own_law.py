# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Laws of one's own, and with memory, over topics: the bits of one process, through faults."""

from __future__ import annotations

import os
import signal
from pathlib import Path
from typing import Any

import pytest

import pdeloop
from pdeloop.method.laws.registry import OWN_LAWS
from tests.support.loop_harness import Processes, until
from tests.support.small import SMALL, parameters, same_bits, train_here
from tests.support.small_loop import LIMIT, adapted, assert_same_training
from tests.tools.test_own_law import BUDGET, FLAGS, OWN, policies

pytestmark = pytest.mark.topics


def test_it_trains_over_topics_to_the_bits_of_one_process_and_is_recorded(
    loop: Processes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "run"
    limited = {"law_settings": {"limit": 0.05}, "field_model_settings": {"folds": 2}}
    settings = ["--set", "law_settings.limit=0.05", "--set", "field_model_settings.folds=2"]
    field = ["--identification", "field"]
    words = [str(SMALL), "--law", OWN, *field, *settings, *FLAGS, "--record", "--out", str(out)]
    loop.wait(loop.pdeloop("train", *words), LIMIT)
    monkeypatch.setenv(OWN_LAWS.variable, "")
    here = pdeloop.train(str(SMALL), law=OWN, identification="field", **limited, **BUDGET)
    assert same_bits(policies(out), here.policies)
    verified = loop.wait(loop.pdeloop("bag", "verify", str(out), "--law", OWN), LIMIT)
    assert "no difference, to the bit" in verified


@pytest.mark.parametrize(
    "given",
    [
        {"law": "observer", "identification": "subspace"},
        {"action_bounds": [*[-0.3] * 4, *[0.3] * 4, 0.0, *[0.05] * 3, 1e300]},
    ],
)
def test_a_controller_that_is_killed_under_a_law_with_memory_changes_nothing(
    loop: Processes, tmp_path: Path, given: dict[str, Any]
) -> None:
    out, problem = tmp_path / "run", tmp_path / "small.yaml"
    lines, flags = SMALL.read_text(), ["--iterations", "30", "--record", "--out", str(out)]
    for name, value in given.items():
        if name == "action_bounds":
            lines += f"    {name}: {value}\n"
        else:
            flags += [f"--{name}", value]
    problem.write_text(lines)
    run = loop.pdeloop("train", str(problem), *flags)
    until(lambda: adapted(out) >= 5, LIMIT, "iteration 5")
    (pid,) = loop.pids("controller_node")
    os.kill(pid, signal.SIGKILL)
    told = loop.wait(run, LIMIT)
    assert "controller_node was killed by SIGKILL; starting it again" in told
    assert_same_training(out, train_here(parameters(**given, iterations=30)))
    verified = loop.wait(loop.pdeloop("bag", "verify", str(out)), LIMIT)
    assert "no difference, to the bit" in verified
