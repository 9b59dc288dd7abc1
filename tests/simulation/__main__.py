# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Simulates seeds on all cores and prints what fails, with the smallest plan that does."""

from __future__ import annotations

import argparse
import sys
from collections import Counter

from pdeloop.study.executors import processes
from tests.simulation.audit import judge, judged_aimed


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.simulation", description=__doc__)
    parser.add_argument("--seeds", type=int, nargs=2, default=(0, 100), metavar=("FIRST", "END"))
    parser.add_argument("--aimed", action="store_true", help="at the checks of headers")
    options = parser.parse_args()
    ends: Counter[str] = Counter()
    with processes() as pool:
        for end, finding in pool.map(
            judged_aimed if options.aimed else judge, range(*options.seeds), chunksize=10
        ):
            ends[end] += 1
            if finding:
                print(finding, flush=True)
    print(", ".join(f"{count} {end}" for end, count in sorted(ends.items())))
    return bool(ends["wrong"] or not ends)


if __name__ == "__main__":
    sys.exit(main())
