# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""`python -m benchmarks rtt`: the loop's rounds per second against a bare ping-pong, in one run.

Both run all the time, in processes of their own, and take turns of a fraction of a second, so that
what else the machine does weighs on both alike; the figures are medians over the turns. A round of
the loop is: state, action, one step of the plant. Its overhead is the round without the solver,
which is measured in turns as well. The last columns are processor time a round, in µs: of the plant's
and the controller's own threads, and of the middleware's threads in both.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from benchmarks.processes import Bench, BenchProcess, bench, machine, table
from pdeloop.messages.problem import load_parameters
from pdeloop.pairs import pair_cores, pair_nodes
from pdeloop.process.affinity import least_busy_cores

PROBLEM = "allen-cahn"
"""P2: of the paper's problems the one whose step is shortest."""
BATCHES = (2, 64)
PAYLOAD = 256
"""Numbers in a request of the bare ping-pong."""


def measure(running: Bench, turns: int, seconds: float, cores: str) -> list[dict[str, Any]]:
    """One row for each batch, with plant and controller on these cores."""
    one, two = least_busy_cores(2) if cores == "pinned" else (-1, -1)
    ping = running.start("benchmarks.ping", f"pin:={one}")
    running.start("benchmarks.ping", "end:=pong", f"pin:={two}")
    horizon = "horizon:=1000"
    chosen = [None] if cores == "any" else pair_cores(1)
    plant, controller = pair_nodes(chosen)
    pair = (
        running.start(plant.package, horizon, *plant.assignments, problem=PROBLEM),
        running.start(controller.package, *controller.assignments, problem=PROBLEM),
    )
    driver = running.start("benchmarks.driver", horizon, f"solver_pin:={one}", problem=PROBLEM)
    n_z = load_parameters(PROBLEM, {})["n_z"]
    for batch in BATCHES:  # compile, find each other, warm up
        driver.ask(do="episodes", batch=batch, seconds=0.1)
        driver.ask(do="solver", batch=batch, seconds=0.1)
    ping.ask(seconds=0.1, numbers=PAYLOAD)
    samples: dict[int, dict[str, list[float]]] = {m: defaultdict(list) for m in BATCHES}
    for _ in range(turns):
        for batch, own in samples.items():
            for what, numbers in (("ping", PAYLOAD), ("ping_same", batch * n_z)):
                got = ping.ask(seconds=seconds, numbers=numbers)
                own[what].append(got["seconds"] / got["rounds"])
            before = _processor_times(pair)
            got = driver.ask(do="episodes", batch=batch, seconds=seconds)
            own["round"].append(got["seconds"] / got["rounds"])
            for what, used in _processor_times(pair).items():
                own[what].append((used - before[what]) / got["rounds"])
            solver = driver.ask(do="solver", batch=batch, seconds=seconds / 4)
            own["solver"].append(solver["median"])
    rows = []
    for batch, found in samples.items():
        times = {what: np.array(values) for what, values in found.items()}
        overhead = times["round"] - times["solver"]
        rows.append(
            {
                "cores": cores,
                "batch": batch,
                "rounds_per_second": 1 / median(times["round"]),
                "overhead_us": 1e6 * median(overhead),
                "ratio": median(overhead / times["ping"]),
                "ratio_same": median(overhead / times["ping_same"]),
                **{f"{what}_us": 1e6 * median(values) for what, values in times.items()},
            }
        )
    return rows


def median(values: NDArray[np.float64]) -> float:
    """The median as a number of Python."""
    return float(np.median(values))


def _processor_times(pair: tuple[BenchProcess, BenchProcess]) -> dict[str, float]:
    """Seconds that the two nodes' own threads have used, and those of the middleware in both."""
    plant, controller = (node.processor_times() for node in pair)
    return {
        "plant": plant["own"],
        "controller": controller["own"],
        "middleware": plant["middleware"] + controller["middleware"],
    }


def run(
    *,
    turns: int = 7,
    seconds: float = 0.4,
    cores: Sequence[Literal["any", "shared", "pinned"]] = ("any", "shared", "pinned"),
) -> dict[str, Any]:
    """Measure the loop for each batch size and placement of the nodes on the cores.

    Parameters
    ----------
    turns
        Number of measurements of each row.
    seconds
        Duration of one measurement.
    cores
        Where plant and controller run. `any`: wherever the scheduler puts them, as nodes started by
        hand. `shared`: both on one core, as with `pdeloop train`. `pinned`: the same for the two
        nodes, but the ping-pong polls on two cores of its own, where it otherwise takes any two.
    """
    rows = []
    for where in cores:
        with bench() as running:
            rows += measure(running, turns, seconds, where)
    return {"problem": PROBLEM, "machine": machine(), "rows": rows}


COLUMNS = {
    "cores": "cores",
    "batch": "batch",
    "rounds_per_second": "rounds/s",
    "round_us": "round µs",
    "solver_us": "solver µs",
    "overhead_us": "overhead µs",
    "ping_us": "ping-pong µs",
    "ratio": "ratio",
    "ping_same_us": "same payload µs",
    "ratio_same": "ratio",
    "plant_us": "plant",
    "controller_us": "controller",
    "middleware_us": "middleware",
}
"""Entries of a row, and what stands above them."""


def text(result: dict[str, Any]) -> str:
    """A table of `result`."""
    return table(result["rows"], COLUMNS)
