# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A suspended process notices; a busy or starved one is not taken for it."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PROGRAM = """
import sys, time
from pdeloop.ros.suspend_watchdog import SuspendWatchdog
with SuspendWatchdog() as watchdog:
    print("ready", flush=True)
    end = time.monotonic() + float(sys.argv[1])
    while time.monotonic() < end:
        {work}
    print(watchdog.longest())
"""
WORK = {"idle": "time.sleep(0.01)", "busy": "sum(range(10_000))"}


def longest(work: str, seconds: float, stop: float = 0.0, share: str = "") -> tuple[float, float]:
    """The longest suspension that was measured, and how long the process was stopped, in s."""
    stopped = 0.0
    command = [sys.executable, "-c", PROGRAM.format(work=WORK[work]), str(seconds)]
    process = subprocess.Popen(
        [*share.split(), *command], cwd=ROOT, stdout=subprocess.PIPE, text=True
    )
    assert process.stdout is not None
    try:
        assert process.stdout.readline() == "ready\n"
        if stop:
            time.sleep(0.3)
            os.kill(process.pid, signal.SIGSTOP)
            began = time.monotonic()
            time.sleep(stop)
            stopped = time.monotonic() - began
            os.kill(process.pid, signal.SIGCONT)
        said, _ = process.communicate(timeout=600)
    finally:
        process.kill()
    return float(said), stopped


@pytest.mark.parametrize("work", WORK)
def test_a_suspension_is_measured(work):
    measured, stopped = longest(work, 3.5, stop=2.5)
    assert stopped - 0.1 < measured < stopped + 1.0


def test_an_idle_process_is_not_taken_for_a_suspended_one():
    assert longest("idle", 1.0)[0] < 1.0


def test_a_process_that_gets_little_of_a_core_is_not_taken_for_a_suspended_one():
    core = str(min(os.sched_getaffinity(0)))
    rivals = [
        subprocess.Popen(["taskset", "-c", core, sys.executable, "-c", "while True: pass"])
        for _ in range(4)
    ]
    try:
        assert longest("busy", 4.0, share=f"taskset -c {core}")[0] < 2.0
    finally:
        for rival in rivals:
            rival.kill()
            rival.wait()
