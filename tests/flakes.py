# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""How often a test fails that should not: the tests over topics again and again, on a busy machine.

    python -m tests.flakes --runs 10 --load 4 [-n WORKERS] [-k EXPRESSION]

Runs them `runs` times beside `load` processes that do nothing but compute, and prints each failure with
what its processes printed, the machine's load average over the last minute of each run, and how many
failures there were.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import re
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent


@contextlib.contextmanager
def busy(load: int) -> Iterator[None]:
    """Processes that compute, until the end of the block."""
    command = [sys.executable, "-c", "while True: pass"]
    processes = [subprocess.Popen(command) for _ in range(load)]
    try:
        yield
    finally:
        for process in processes:
            process.kill()
            process.wait()


def run(expression: str, workers: int) -> tuple[int, list[str], str]:
    """How many tests ran once each, the names of those that failed, and what pytest says of these."""
    command = [sys.executable, "-m", "pytest", "-q", "-rfE", "-m", "topics", "-k", expression]
    command += ["-n", str(workers), "--dist", "worksteal"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    lines = done.stdout.splitlines()
    ends = [line for line in lines if re.match(r"=* ?\d+ (passed|failed).* in ", line)]
    if done.returncode not in (0, 1) or not ends:
        raise SystemExit(done.stdout[-2000:] + done.stderr[-2000:])
    counts = {kind: int(number) for number, kind in re.findall(r"(\d+) (passed|failed)", ends[-1])}
    failed = [line.split()[1] for line in lines if line.startswith(("FAILED ", "ERROR "))]
    sections = re.search(r"^=+ (ERRORS|FAILURES) =+$.*(?=^=+ short test)", done.stdout, re.M | re.S)
    return sum(counts.values()), failed, sections[0] if sections else ""


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.flakes", description=__doc__)
    parser.add_argument("--runs", type=int, default=10, metavar="N", help="[10]")
    parser.add_argument("--load", type=int, default=4, metavar="N", help="processes beside it [4]")
    parser.add_argument("-n", type=int, default=0, metavar="N", help="workers; 0: none [0]")
    parser.add_argument("-k", default="", metavar="EXPRESSION", help="only these tests")
    options = parser.parse_args()
    ran, failed = 0, Counter[str]()
    with busy(options.load):
        for number in range(1, options.runs + 1):
            tests, names, sections = run(options.k, options.n)
            ran += tests
            failed.update(names)
            load = f"load average {os.getloadavg()[0]:.0f}"
            print(
                f"run {number}: {len(names)} of {tests} failed, {load} {' '.join(names)}",
                flush=True,
            )
            if sections:
                print(sections, flush=True)
    print(f"{failed.total()} failures in {ran} tests of {options.runs} runs")
    for name, count in failed.most_common():
        print(f"{count:4} {name}")
    return bool(failed)


if __name__ == "__main__":
    sys.exit(main())
