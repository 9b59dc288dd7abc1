"""Drives tests.operator_program from a test, with a limit on every wait."""

from __future__ import annotations

import contextlib
import json
import select
import subprocess
import sys
from collections.abc import Iterator
from typing import Any

from tests.loop_harness import Processes, until

LIMIT = 180.0
SERVICES = [
    *(f"/pde_sim_node/{name}" for name in ("pause", "resume", "step")),
    *(f"/tuner_node/{name}" for name in ("pause", "resume", "stop")),
]


class Operator:
    """Calls services and reads /diagnostics in the ROS domain of a test's processes."""

    def __init__(self, loop: Processes) -> None:
        self._log = (loop.folder / "operator.log").open("wb")
        self._process = subprocess.Popen(
            [sys.executable, "-m", "tests.operator_program"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=self._log,
            env=loop.environment,
            cwd=loop.folder,
            text=True,
        )
        assert self._read() == "ready"
        self.ask(know=SERVICES)

    def _read(self) -> Any:
        assert self._process.stdout is not None
        ready, _, _ = select.select([self._process.stdout], [], [], LIMIT)
        assert ready, f"the operator said nothing for {LIMIT} s"
        line = self._process.stdout.readline()
        assert line, "the operator has ended; see operator.log"
        return json.loads(line)

    def ask(self, **command: Any) -> Any:
        assert self._process.stdin is not None
        print(json.dumps(command), file=self._process.stdin, flush=True)
        return self._read()

    def call(self, service: str) -> str:
        """The message of a Trigger that must succeed."""
        success, message = self.ask(call=service)
        assert success, message
        return str(message)

    def status(self, node: str) -> tuple[int, int, str, dict[str, str]]:
        """Reports so far, level, message and values of a node; zeros if it has not reported."""
        for name, (count, level, message, values) in self.ask(diagnostics=None).items():
            if name.split(":")[0] == node:
                return count, level, message, values
        return 0, 0, "", {}

    def values(self, node: str) -> dict[str, str]:
        return self.status(node)[3]

    def wait_for_reports(self, node: str, count: int) -> None:
        """Wait until `node` has reported `count` more times, which is as many seconds."""
        before = self.status(node)[0]
        until(lambda: self.status(node)[0] >= before + count, LIMIT, f"{count} reports of {node}")

    def close(self) -> None:
        assert self._process.stdin is not None and self._process.stdout is not None
        self._process.stdin.close()
        try:
            self._process.wait(10.0)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._process.stdout.close()
        self._log.close()


SLOW = 2.0
"""Simulated seconds per second at which an episode of the small problem lasts 0.75 s: so much time
has who comes between two of them, whatever the machine does, and nearly all of it is spent waiting."""


def full_speed(desk: Operator) -> None:
    """Let a plant that was started at `SLOW` go on as fast as it can."""
    assert desk.ask(set=["/pde_sim_node", "real_time_factor", 0.0])[0]


@contextlib.contextmanager
def held_training(desk: Operator, newcomer: str) -> Iterator[None]:
    """The training is paused until what the block starts, a node `newcomer`, is on the network.

    So what it does to the training does not depend on which of the two is faster. Its plant was
    started at `SLOW`, and goes on as fast as it can.
    """
    there = desk.ask(nodes=None).count(newcomer)
    desk.call("/tuner_node/pause")
    full_speed(desk)
    yield
    until(lambda: desk.ask(nodes=None).count(newcomer) > there, LIMIT, newcomer)
    desk.call("/tuner_node/resume")


@contextlib.contextmanager
def operator(loop: Processes) -> Iterator[Operator]:
    """An operator until the end of the block."""
    made = Operator(loop)
    try:
        yield made
    finally:
        made.close()
