"""Plant and controller in compiled functions on a line: the same bytes, and their business only."""

from __future__ import annotations

import re
import signal
from pathlib import Path

import pytest

from tests.loop_harness import Processes
from tests.small import SMALL
from tests.topics.test_loop import LIMIT, assert_same_training, in_process, tuner_arguments

pytestmark = pytest.mark.topics


def test_plant_and_controller_flow_with_the_bytes_of_the_long_way(loop: Processes) -> None:
    text = loop.wait(loop.start("-m", "tests.flow_program", name="flow"), LIMIT)
    assert text.splitlines()[-1] == "done"  # the first to compile says so before


RESTLESS = """
import gc, sys, time
from loop_interfaces.ros.node_loop import NodeLoop
from loop_interfaces.protocol import QUIET, Tally
from {0}.node import main
from {0}.reflex import Reflex
taken_back, flow, patient = [], Reflex.flow, NodeLoop._flow
def restless(self, stream, until):
    return patient(self, stream, min(until, time.monotonic() + 0.0003))
def counted(self, *arguments):
    count, ended = flow(self, *arguments)
    if count and ended == QUIET:
        taken_back.append(count)
    return count, ended
Reflex.flow, NodeLoop._flow = counted, restless
code = main()
tallies = [found for found in gc.get_objects() if isinstance(found, Tally)]
print("taken back", len(taken_back), "times,", sum(t["states repeated"] for t in tallies), "repeated")
sys.exit(code)
"""


def test_a_stream_that_changes_hands_all_the_time_loses_nothing(
    loop: Processes, tmp_path: Path
) -> None:
    """The node's own thread takes it back every 0.3 ms, in the middle of whatever the other does."""
    patience = ("-p", "action_timeout:=10.0")  # what is lost is repeated, and seen
    arguments = ("--ros-args", "--params-file", str(SMALL), *patience)
    nodes = [
        loop.start("-c", RESTLESS.format(package), *arguments, name=package)
        for package in ("pde_sim_node", "controller_node")
    ]
    own = tuner_arguments(tmp_path / "run", iterations=200)
    loop.wait(loop.node("tuner_node", "--params-file", str(SMALL), *own), LIMIT)
    assert_same_training(tmp_path / "run", in_process(iterations=200))
    for node in nodes:
        node.send_signal(signal.SIGTERM)
        said = loop.wait(node, 10.0)
        ((count, repeated),) = re.findall(r"taken back (\d+) times, (\d+) repeated", said)
        assert int(count) > 500
        assert int(repeated) == 0
