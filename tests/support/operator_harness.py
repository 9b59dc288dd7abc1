# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Drives tests.support.operator_program from a test, with a limit on every wait."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Any

from tests.support import operator_program
from tests.support.loop_harness import FORKING, Processes, forked, until

LIMIT = 180.0
SERVICES = [
    *(f"/pde_sim_node/{name}" for name in ("pause", "resume", "step")),
    *(f"/tuner_node/{name}" for name in ("pause", "resume", "stop")),
]


class Operator:
    """Calls services and reads /diagnostics in the ROS domain of a test's processes."""

    def __init__(self, loop: Processes) -> None:
        self._pipe, other = FORKING.Pipe()
        log = loop.folder / "operator.log"
        self._process = forked(operator_program.serve, other, log, loop.environment)
        other.close()
        self.ask(know=SERVICES)

    def ask(self, **command: Any) -> Any:
        self._pipe.send(command)
        assert self._pipe.poll(LIMIT), f"the operator said nothing for {LIMIT} s"
        return self._pipe.recv()  # EOFError: it has ended; see operator.log

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
        self._pipe.close()
        self._process.join(10.0)
        self._process.kill()
        self._process.join()


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
