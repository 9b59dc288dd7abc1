"""How much a viewer slows the loop: one training, a viewer and who looks at it beside it now and then.

    python -m benchmarks.views allen-cahn --windows 8

Prints the medians of the time of an iteration with and without them, and their ratio; and the same of
the processor time of plant and controller (benchmarks.overhead).
"""

from __future__ import annotations

import argparse
import contextlib
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence

from benchmarks.overhead import Setting, measure, text
from loop_interfaces.problem import find_problem
from pdeloop.supervisor import node_command

PATIENCE = 60.0
"""Seconds in which the first view must have come."""


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line."""
    parser = argparse.ArgumentParser(description="How much a viewer slows the loop.")
    parser.add_argument("problem", nargs="?", default="burgers", help="name or file [burgers]")
    parser.add_argument("--windows", type=int, default=6, help="windows with and without [6]")
    parser.add_argument("--seconds", type=float, default=3.0, help="length of a window [3]")
    parser.add_argument("--rate", type=float, default=10.0, help="views a second [10]")
    options = parser.parse_args(arguments)
    given = (
        "--params-file",
        str(find_problem(options.problem)),
        "-p",
        f"view_rate:={options.rate}",
    )

    @contextlib.contextmanager
    def viewer(setting: Setting, window: int) -> Iterator[None]:
        name = f"looker{window}"
        command = [sys.executable, "-m", "benchmarks.subscriber_load.node"]
        children = [
            setting.start_child(node_command("viewer_node", *given), "viewer_node"),
            setting.start(command, name),
        ]
        deadline = time.monotonic() + PATIENCE
        while "looking" not in setting.log(name):
            if time.monotonic() > deadline:
                raise RuntimeError(f"no view within {PATIENCE:g} s: {setting.log('viewer_node')}")
            time.sleep(0.05)
        yield
        for child in children:
            child.send_signal(signal.SIGINT)
            try:
                child.wait(5.0)
            except subprocess.TimeoutExpired:  # rclpy.spin now and then sleeps through a signal
                child.kill()
                child.wait()

    tuner = ("optimizer:=two_point",)  # whose own share of the processor is small
    print(
        text(measure(options.problem, options.windows, options.seconds, viewer, tuner), "a viewer")
    )
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
