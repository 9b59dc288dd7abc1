# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""`python -m benchmarks realtime`: jitter and missed deadlines at P1's 20 Hz and at 1 kHz.

A plant with `real_time_factor` and a controller run one episode at each rate; the plant itself says
how late its states were.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

from benchmarks.processes import BenchError, bench, machine, table
from pdeloop.messages.problem import load_parameters
from pdeloop.process.affinity import least_busy_cores

PROBLEM = "burgers"
RATES = (20.0, 1000.0)
"""States a second: P1 in real time, and a fast plant."""
_SUMMARY = re.compile(
    r"real time: (\d+) states .* (\d+) missed deadlines, "
    r"jitter p50 (\d+) us, p99 (\d+) us, max (\d+) us"
)


COLUMNS = {
    "rate": "Hz",
    "real_time_factor": "real_time_factor",
    "states": "states",
    "missed": "missed",
    "p50_us": "p50 µs",
    "p99_us": "p99 µs",
    "max_us": "max µs",
}
"""Entries of a row, and what stands above them."""


def run(*, seconds: float = 10.0, pin: bool = False, rates: Sequence[float] = RATES) -> Any:
    """Measure how well the loop keeps each rate.

    Parameters
    ----------
    seconds
        Duration at each rate.
    pin
        Keep both nodes on one core.
    rates
        Rates, in states per second.
    """
    sample_time = load_parameters(PROBLEM, {})["sample_time"]
    rows = []
    for rate in rates:
        factor = rate * sample_time
        horizon = f"horizon:={max(1, round(seconds * rate))}"
        core = least_busy_cores(1)[0] if pin else -1
        with bench() as running:
            plant = running.start(
                "pde_sim_node",
                horizon,
                f"real_time_factor:={factor}",
                f"pin:={core}",
                problem=PROBLEM,
            )
            running.start("controller_node", f"pin:={core}", problem=PROBLEM)
            limit = f"give_up:={seconds + 60}"
            driver = running.start("benchmarks.driver", horizon, limit, problem=PROBLEM)
            driver.ask(do="begin", batch=1, seconds=3.0)  # until all have found each other
            driver.ask(do="episodes", batch=1, seconds=0.0)
            plant.end()
            said = plant.log()
        found = [match.groups() for match in _SUMMARY.finditer(said)]
        if len(found) < 2:
            last = said.strip().splitlines()[-1:]
            raise BenchError(f"the plant did not say how well it kept the wall clock: {last}")
        rows.append(dict(zip(COLUMNS, (rate, factor, *map(int, found[-1])), strict=True)))
    return {"problem": PROBLEM, "pin": pin, "machine": machine(), "rows": rows}


def text(result: dict[str, Any]) -> str:
    """A table of `result`."""
    return table(result["rows"], COLUMNS)
