# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Faults that take minutes or rights: each is done to one node of a training, which must not notice.

    python -m tests.trials stop [--node NODE] [--seconds S]    SIGSTOP, and SIGCONT after S seconds
    python -m tests.trials oom [--node NODE]                   the kernel's OOM killer (root, cgroup v1)

The small problem is trained with `pdeloop train` in real time, so that the node is in the middle of it.
At the end the policy must be that of an undisturbed training in this process, bit for bit.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path

from tests.support.interpreter import ROOT
from tests.support.loop_harness import until
from tests.support.small import paced
from tests.support.small_loop import adapted, assert_same_training, in_process

NODES = ("pde_sim_node", "controller_node", "tuner_node")
ITERATIONS = 20
LIMIT = 900.0
_GROUPS = Path("/sys/fs/cgroup/memory")
_ROOM = 30
"""MB that the training is allowed more than it has; those who ask for more are ended."""
_HOG = f"""
import time
kept = [b"x" * 2**20 for _ in range({_ROOM + 10})]
time.sleep(1.0)
"""


def node_of(supervisor: int, name: str) -> int:
    """The process of a node of a training."""
    for entry in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            parent = (entry / "stat").read_text().rsplit(")", 1)[1].split()[1]
            words = (entry / "cmdline").read_bytes().decode().split("\0")
            if int(parent) == supervisor and name in words:
                return int(entry.name)
    raise RuntimeError(f"the training has no {name}")


def stop(process: int, seconds: float) -> None:
    os.kill(process, signal.SIGSTOP)
    time.sleep(seconds)
    os.kill(process, signal.SIGCONT)


@contextlib.contextmanager
def memory_group() -> Iterator[Path]:
    """A control group for memory, removed when what was in it has ended."""
    group = _GROUPS / f"pdeloop-trial-{os.getpid()}"
    group.mkdir()
    try:
        yield group
    finally:
        time.sleep(1.0)
        group.rmdir()


def enter(group: Path) -> None:
    (group / "cgroup.procs").write_text(str(os.getpid()))


def run_out_of_memory(process: int, group: Path) -> None:
    """Let the OOM killer choose this process of the group."""
    Path(f"/proc/{process}/oom_score_adj").write_text("1000")
    limit, used = group / "memory.limit_in_bytes", group / "memory.usage_in_bytes"
    limit.write_text(str(int(used.read_text()) + _ROOM * 2**20))
    subprocess.run([sys.executable, "-c", _HOG], preexec_fn=partial(enter, group), check=True)
    limit.write_text("-1")
    if "oom_kill 0" in (group / "memory.oom_control").read_text():
        raise RuntimeError("the OOM killer did nothing")


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.trials", description=__doc__)
    parser.add_argument("fault", choices=("stop", "oom"))
    parser.add_argument("--node", choices=NODES, default="tuner_node")
    parser.add_argument("--seconds", type=float, default=180.0)
    given = parser.parse_args()
    expected = in_process(iterations=ITERATIONS)
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        group = stack.enter_context(memory_group()) if given.fault == "oom" else None
        out = folder / "run"
        words = (
            "train",
            str(paced(folder, 4.0)),
            "--iterations",
            str(ITERATIONS),
            "--out",
            str(out),
        )
        training = subprocess.Popen(
            [sys.executable, "-m", "pdeloop", *words],
            cwd=ROOT,
            start_new_session=True,
            preexec_fn=partial(enter, group) if group else None,
        )
        try:
            until(lambda: adapted(out) >= 1, LIMIT, "first iteration")
            process = node_of(training.pid, given.node)
            if group:
                run_out_of_memory(process, group)
            else:
                stop(process, given.seconds)
            code = training.wait(LIMIT)
        finally:
            training.kill()
            training.wait()
        assert code == 0, f"the training ended with exit code {code}"
        assert_same_training(out, expected)
    print(f"{given.fault} {given.node}: same policy")
    return 0


if __name__ == "__main__":
    sys.exit(main())
