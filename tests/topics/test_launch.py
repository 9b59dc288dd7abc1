# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The package as colcon installs it, started by its launch files, over real topics.

ROS's own `launch` and `launch_ros` read them where an installation of ROS is. They are not on PyPI:
elsewhere a stand-in does (tests/support/launch_stand_in).
"""

from __future__ import annotations

import importlib.util
import os
import signal
from pathlib import Path

import pytest

from tests.support.colcon_workspace import ROOT, Workspace
from tests.support.loop_harness import Processes, until
from tests.support.small import SMALL, parameters, train_here
from tests.support.small_loop import adapted, assert_same_training, in_process

LIMIT = 240.0
"""Seconds: a launch is seven processes that start at once, on a machine that has other things to do."""
LAUNCH = importlib.util.find_spec("launch_ros") is not None
STAND_IN = ROOT / "tests" / "support" / "launch_stand_in"
pytestmark = pytest.mark.topics

RUN = """
import sys
from launch import LaunchDescription, LaunchService
from launch.actions import IncludeLaunchDescription
from launch.launch_description_sources import AnyLaunchDescriptionSource

path, *words = sys.argv[1:]
service = LaunchService(argv=words, noninteractive=True)
source = AnyLaunchDescriptionSource(path)
arguments = [tuple(word.split(":=", 1)) for word in words]
include = IncludeLaunchDescription(source, launch_arguments=arguments)
service.include_launch_description(LaunchDescription([include]))
sys.exit(service.run())
"""
"""What `ros2 launch FILE ARGUMENTS...` does."""


@pytest.fixture
def installed(loop: Processes, workspace: Workspace) -> Processes:
    """Processes that run the installed code, not the sources."""
    path = workspace.environment["PYTHONPATH"]
    given = os.environ.get("PYTHONPATH", "") if LAUNCH else str(STAND_IN)  # where launch comes from
    loop.forks = False
    loop.environment |= workspace.environment | {"PYTHONPATH": f"{path}{os.pathsep}{given}"}
    return loop


def launch(installed: Processes, workspace: Workspace, file: str, **arguments: object):
    path = workspace.prefix / "share" / "pdeloop" / "launch" / file
    words = [f"{name}:={value}" for name, value in arguments.items()]
    return installed.start("-c", RUN, str(path), *words, name="launch")


def test_nodes_that_are_killed_in_a_launched_training_are_started_again(
    installed: Processes, workspace: Workspace, tmp_path: Path
) -> None:
    run = tmp_path / "run"
    options = {"problem": SMALL, "iterations": 12, "real_time_factor": 10.0, "namespace": "lab"}
    options |= {"pairs": 2, "record": "true", "out": run}
    started = launch(installed, workspace, "train.launch.py", **options)
    for name in ("pde_sim_node", "tuner_node"):  # one of a pair, and the one that ends the training
        rows = adapted(run)
        until(lambda rows=rows: adapted(run) > rows + 2, LIMIT, "progress")
        os.kill(pids(installed, name)[0], signal.SIGKILL)
    said = installed.wait(started, LIMIT)
    assert said.count("exit code -9") == 2
    assert_same_training(run, in_process(iterations=12))
    assert "lab.pair1.controller_node" in said
    assert "Traceback" not in said
    assert (run / "bag" / "metadata.yaml").is_file()


def test_a_launched_loop_serves_a_tuner_and_ends_by_an_interrupt(
    installed: Processes, workspace: Workspace, tmp_path: Path
) -> None:
    options = {"problem": SMALL, "namespace": "lab", "law": "feedforward"}
    started = launch(installed, workspace, "loop.launch.py", **options)
    tuner = installed.node(
        "tuner_node",
        "--params-file",
        str(SMALL),
        "-r",
        "__ns:=/lab",
        "-p",
        f"out:={tmp_path / 'run'}",
        "-p",
        "iterations:=6",
        "-p",
        "law:=feedforward",
    )
    installed.wait(tuner, LIMIT)
    expected = train_here(parameters(law="feedforward", iterations=6))
    assert_same_training(tmp_path / "run", expected)
    os.killpg(started.pid, signal.SIGINT)  # as Ctrl-C does: to launch and to the nodes
    said = installed.wait(started, LIMIT, code=0)
    assert "Traceback" not in said
    assert "escalating" not in said


def pids(processes: Processes, executable: str) -> list[int]:
    """Processes of this test that run the installed `executable`."""
    found = []
    for pid in processes.left_behind():
        command = Path(f"/proc/{pid}/cmdline").read_bytes().split(b"\0")
        if any(word.endswith(f"/lib/pdeloop/{executable}".encode()) for word in command):
            found.append(pid)
    assert found, executable
    return found
