"""How much a recorder slows the loop: one training, a recorder beside it now and then.

    python -m benchmarks.recording burgers --windows 8

Prints the medians of the time of an iteration with and without it, and their ratio; and the same of
the processor time of plant and controller, which is what remains comparable on a machine that is
busy with other things (benchmarks.overhead).
"""

from __future__ import annotations

import argparse
import contextlib
import signal
import time
from collections.abc import Iterator, Sequence

from benchmarks.overhead import Setting, measure, text
from pdeloop.supervisor import node_command


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line."""
    parser = argparse.ArgumentParser(description="How much a recorder slows the loop.")
    parser.add_argument("problem", nargs="?", default="burgers", help="name or file [burgers]")
    parser.add_argument("--windows", type=int, default=6, help="windows with and without [6]")
    parser.add_argument("--seconds", type=float, default=3.0, help="length of a window [3]")
    parser.add_argument("--set", action="append", default=[], help="the recorder's name:=value")
    options = parser.parse_args(arguments)

    @contextlib.contextmanager
    def recorder(setting: Setting, window: int) -> Iterator[None]:
        bag = setting.folder / f"bag{window}"
        given = [word for p in (f"bag:={bag}", *options.set) for word in ("-p", p)]
        process = setting.start_child(node_command("recorder_node", *given), "recorder_node")
        while not (bag / "parameters.json").exists():  # matched, and start-up is over
            time.sleep(0.05)
        yield
        process.send_signal(signal.SIGINT)
        process.wait()

    result = measure(options.problem, options.windows, options.seconds, recorder)
    print(text(result, "a recorder"))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
