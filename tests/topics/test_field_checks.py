# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Trainings of the tests check the types of their messages' fields, which Jazzy does not by default."""

from __future__ import annotations

from pathlib import Path

import pytest

from pdeloop.bags.verify import verify
from tests.support.loop_harness import Processes
from tests.support.small import RECORDED
from tests.support.small_loop import LIMIT, assert_same_training, in_process

pytestmark = pytest.mark.topics
REFUSED = """
from std_msgs.msg import Float64
try:
    Float64(data=1)
except AssertionError:
    print("an int is refused")
"""


def test_a_recorded_training_with_checked_fields(loop: Processes, recorded: Path) -> None:
    """`recorded` was trained in processes of this environment, with the messages imported here."""
    assert loop.environment["ROS_PYTHON_CHECK_FIELDS"] == "1"
    assert "an int is refused" in loop.wait(loop.start("-c", REFUSED, name="refused"), LIMIT)
    assert_same_training(recorded, in_process(iterations=int(RECORDED["iterations"]), seeds=2))
    report = verify(recorded)
    assert (report.count, report.missing, report.incomplete) == (0, [], [])
