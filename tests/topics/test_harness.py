# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A test run that is killed leaves no process behind; what it forks imports nothing."""

from __future__ import annotations

import os
import re
import signal
import sys
from pathlib import Path

import pytest

from tests.support.forked_nodes import began
from tests.support.loop_harness import Processes, forked, run_main, until
from tests.support.small_loop import LIMIT

pytestmark = pytest.mark.topics

TESTS = """
import os, sys, time
from pathlib import Path
del os.environ["ROS_DOMAIN_ID"]  # it takes one of its own
del os.environ["PYTHONPATH"]  # pytest finds the tests without it
from tests.support.loop_harness import processes, until
from tests.support.operator_harness import operator
from tests.support.small import SMALL
folder = Path(sys.argv[1])
with processes(folder) as loop, operator(loop) as desk:
    loop.start("-m", "tests.support.relay.node", "--ros-args", name="relay")
    words = "train", str(SMALL), "--iterations", "100000", "--out", str(folder / "run")
    loop.pdeloop(*words)
    until((folder / "run" / "progress.jsonl").exists, 240, "training")
    print("started", *loop.left_behind(), desk._process.pid, flush=True)
    time.sleep(600)
"""
"""What a worker of pytest does: a program, a command and its nodes, an operator."""


def test_all_that_the_tests_started_dies_with_the_process_that_runs_them(
    loop: Processes, tmp_path: Path
) -> None:
    (tmp_path / "inner").mkdir()
    loop.environment["PYTHONSAFEPATH"] = "1"  # as for `make test`
    worker = loop.program(sys.executable, "-c", TESTS, str(tmp_path / "inner"))
    line = re.compile(r"^started (.*)\n", re.MULTILINE)  # behind what is said of compiling
    until(lambda: line.search(loop.output(worker)), LIMIT, "processes")
    started = [int(word) for word in line.findall(loop.output(worker))[0].split()]
    assert len(started) >= 6 and all(map(began, started))
    os.kill(worker.pid, signal.SIGKILL)
    worker.wait()
    until(lambda: not any(map(began, started)), LIMIT, "end of all processes")


def imported_by_a_command(log: Path, environment: dict[str, str], found: Path) -> None:
    """In a forked process: note what it imports until the command begins."""
    from tests.support import preloaded

    before = set(sys.modules)

    def note() -> int:
        found.write_text(" ".join(sorted(set(sys.modules) - before)))
        return 0

    vars(preloaded)["MAINS"] = {"pdeloop": note}
    run_main("pdeloop", [], log, environment)


def test_what_is_forked_has_everything_loaded(loop: Processes, tmp_path: Path) -> None:
    """Imports of its own would cost each of hundreds of processes a tenth of a second."""
    found = tmp_path / "imported"
    forked(imported_by_a_command, tmp_path / "log", loop.environment, found).join()
    assert found.read_text() == ""
