# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Commands and nodes in the environment of a person who uses ROS for other work."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.support.loop_harness import Processes, until, without_domain
from tests.support.small import SMALL, paced

pytestmark = pytest.mark.topics
LIMIT = 240.0
TRAIN = ("train", str(SMALL), "--iterations", "1", "--evaluation-fields", "1")


def test_a_training_leaves_out_what_contradicts_it_and_says_so(loop: Processes) -> None:
    loop.forks = False  # ROS reads the first of them when it is loaded
    loop.environment |= {
        "RMW_IMPLEMENTATION": "rmw_cyclonedds_cpp",
        "ROS_AUTOMATIC_DISCOVERY_RANGE": "OFF",
        "ROS_STATIC_PEERS": "192.0.2.7",
        "RCUTILS_CONSOLE_OUTPUT_FORMAT": "{message}",
    }
    said = loop.wait(loop.pdeloop(*TRAIN), LIMIT)
    for name in ("RMW_IMPLEMENTATION", "ROS_AUTOMATIC_DISCOVERY_RANGE", "ROS_STATIC_PEERS"):
        assert sum(name in line for line in said.splitlines()) == 1


@pytest.mark.parametrize("node", ["pde_sim_node", "controller_node", "tuner_node", "recorder_node"])
def test_a_node_refuses_in_one_sentence_what_cannot_work(loop: Processes, node: str) -> None:
    loop.environment["ROS_SECURITY_ENABLE"] = "true"
    (line,) = loop.wait(loop.node(node), LIMIT, code=1).strip().splitlines()
    assert line.startswith(f"{node}: ROS_SECURITY_")


def test_a_node_without_a_home_writes_its_logs_elsewhere_and_says_where(
    loop: Processes, tmp_path: Path
) -> None:
    (tmp_path / "file").touch()
    loop.environment |= {"HOME": str(tmp_path / "file"), "TMPDIR": str(tmp_path)}
    del loop.environment["ROS_LOG_DIR"]
    loop.forks = False
    node = loop.node("controller_node", "-p", "problem:=stokes")
    said = loop.wait(node, LIMIT, code=1).splitlines()
    assert "cannot be written: logs go to" in said[0] and "ROS_LOG_DIR" in said[0]
    assert "unknown problem 'stokes'" in said[-1]


def test_two_trainings_at_once_do_not_end_each_other(loop: Processes, tmp_path: Path) -> None:
    with without_domain(loop):
        words = ("train", str(SMALL), "--iterations", "20")
        both = [loop.pdeloop(*words, "--out", str(tmp_path / name)) for name in ("a", "b")]
        for training in both:
            loop.wait(training, LIMIT)
    results = [(tmp_path / name / "policy.npz").read_bytes() for name in ("a", "b")]
    assert results[0] == results[1]


def test_a_second_training_in_a_domain_that_is_given_ends_at_once_and_the_first_goes_on(
    loop: Processes, tmp_path: Path
) -> None:
    slow = str(paced(tmp_path, 10.0))
    first = loop.pdeloop("train", slow, "--iterations", "100000", "--out", str(tmp_path / "a"))
    until(lambda: "adapt" in loop.output(first), LIMIT, "first training")
    second = loop.pdeloop(*TRAIN, "--out", str(tmp_path / "b"))
    said = loop.wait(second, LIMIT, code=1)
    assert "another training runs in ROS_DOMAIN_ID=" in said.splitlines()[-1]
    before = loop.output(first).count("rollouts, mean cost")
    until(
        lambda: loop.output(first).count("rollouts, mean cost") > before,
        LIMIT,
        "the first going on",
    )
