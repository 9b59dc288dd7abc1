"""Simulates seeds and prints what fails, with the smallest plan that does."""

from __future__ import annotations

import argparse
import sys
from collections import Counter

from tests.simulation.audit import audit, failure, shrunk
from tests.simulation.plan import draw


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.simulation", description=__doc__)
    parser.add_argument("--seeds", type=int, nargs=2, default=(0, 100), metavar=("FIRST", "END"))
    options = parser.parse_args()
    ends: Counter[str] = Counter()
    for seed in range(*options.seeds):
        if reason := failure(plan := draw(seed)):
            ends["wrong"] += 1
            print(f"seed {seed}: {reason}\n  {shrunk(plan)}", flush=True)
        else:
            ends[audit(plan).split(":")[0]] += 1
    print(", ".join(f"{count} {end}" for end, count in sorted(ends.items())))
    return bool(ends["wrong"])


if __name__ == "__main__":
    sys.exit(main())
