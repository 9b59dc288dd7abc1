# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The fast paths of plant and controller: the same bytes, and the expected messages only."""

from __future__ import annotations

import re
import signal
import sys
from pathlib import Path

import pytest

from tests.support.loop_harness import Processes
from tests.support.small_loop import (
    LIMIT,
    PARAMETERS,
    assert_same_training,
    in_process,
    start_tuner,
)

pytestmark = pytest.mark.topics


def test_plant_and_controller_answer_with_the_bytes_of_the_ordinary_path(loop: Processes) -> None:
    text = loop.wait(loop.start("-m", "tests.support.fast_path_program", name="fast_path"), LIMIT)
    assert text.splitlines()[-1] == "done"  # the first to compile says so before


RESTLESS = """
import gc, math, sys, time
from collections import Counter
from pdeloop.fast_path.handler import FastPath
from pdeloop.ros.node_loop import NodeLoop
from {0}.node import main
interrupted, disarm, run = [], FastPath.disarm, NodeLoop.run
def restless(self, housekeeping, *, deadline=lambda: None, **others):
    def soon():
        due = deadline()
        return min(math.inf if due is None else due, time.monotonic() + 0.0003)
    return run(self, housekeeping, deadline=soon, **others)
def counted(self):
    count = disarm(self)
    if count:
        interrupted.append(count)
    return count
FastPath.disarm, NodeLoop.run = counted, restless
code = main()
counters = [found for found in gc.get_objects() if isinstance(found, Counter)]
repeated = sum(found["states repeated"] for found in counters)
print("interrupted", len(interrupted), "times,", repeated, "repeated")
sys.exit(code)
"""


def test_a_protocol_that_changes_hands_all_the_time_loses_nothing(
    loop: Processes, tmp_path: Path
) -> None:
    """The node's own thread wakes up every 0.3 ms, in the middle of whatever the other does."""
    patience = ("-p", "action_timeout:=10.0")  # what is lost is repeated, and seen
    arguments = ("--ros-args", *PARAMETERS, *patience)
    nodes = [
        loop.start("-c", RESTLESS.format(package), *arguments, name=package)
        for package in ("pde_sim_node", "controller_node")
    ]
    loop.wait(start_tuner(loop, tmp_path / "run", iterations=120), LIMIT)
    assert_same_training(tmp_path / "run", in_process(iterations=120))
    for node in nodes:
        node.send_signal(signal.SIGTERM)
        said = loop.wait(node, LIMIT)
        ((count, repeated),) = re.findall(r"interrupted (\d+) times, (\d+) repeated", said)
        assert int(count) > 100  # of some 15,000 states and actions, on a loaded machine
        assert int(repeated) == 0


WITHOUT = """
import sys
sys.modules["pdeloop.fast_path"] = None
from {0}.node import FAST_PATH, main
assert FAST_PATH is None
sys.exit(main())
"""


def test_nodes_are_complete_without_the_fast_path(loop: Processes, tmp_path: Path) -> None:
    """The package is not there: every message goes through the protocols, and gives the same bits."""
    for package in ("pde_sim_node", "controller_node"):
        words = "-c", WITHOUT.format(package), "--ros-args", *PARAMETERS
        loop.program(sys.executable, *words, name=package)
    loop.wait(start_tuner(loop, tmp_path / "run"), LIMIT)
    assert_same_training(tmp_path / "run", in_process())
