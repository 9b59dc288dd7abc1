"""`python -m benchmarks rtt`: the loop's rounds a second beside a bare ping-pong, in one run.

Both run all the time, in processes of their own, and take turns of a fraction of a second, so that
what else the machine does weighs on both alike; the figures are medians over the turns. A round of
the loop is: state, action, one step of the plant. Its overhead is the round without the solver,
which is measured in turns as well. The last columns are processor time a round, in µs: of the plant's
and the controller's own threads, and of the middleware's threads in both.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.processes import Bench, BenchProcess, bench, machine, markdown
from loop_interfaces.affinity import least_busy_cores
from loop_interfaces.problem import load_parameters
from pdeloop.pairs import pair_cores, pair_nodes

PROBLEM = "allen-cahn"
"""P2: of the paper's problems the one whose step is shortest."""
BATCHES = (2, 64)
CORES = ("any", "shared", "pinned")
"""Where plant and controller are: wherever the scheduler puts them (nodes started by hand), on one
core for both (as `pdeloop train` does it). The ping-pong is on any two, and with `pinned`, which is
`shared` for the pair, on one each, polling."""
PAYLOAD = 256
"""Numbers in a request of the bare ping-pong."""


def measure(
    batches: tuple[int, ...], turns: int, seconds: float, cores: str
) -> list[dict[str, Any]]:
    """One row for each batch. cores: one of CORES."""
    with bench() as running:
        return _measure(running, batches, turns, seconds, cores)


def _measure(
    running: Bench, batches: tuple[int, ...], turns: int, seconds: float, cores: str
) -> list[dict[str, Any]]:
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
    for batch in batches:  # compile, find each other, warm up
        driver.ask(do="episodes", batch=batch, seconds=0.1)
        driver.ask(do="solver", batch=batch, seconds=0.1)
    ping.ask(seconds=0.1, numbers=PAYLOAD)
    samples: dict[tuple[str, int], list[float]] = {}

    def note(what: str, batch: int, value: float) -> None:
        samples.setdefault((what, batch), []).append(value)

    for _ in range(turns):
        for batch in batches:
            for what, numbers in (("ping", PAYLOAD), ("ping_same", batch * n_z)):
                got = ping.ask(seconds=seconds, numbers=numbers)
                note(what, batch, got["seconds"] / got["rounds"])
            before = _processor_times(pair)
            got = driver.ask(do="episodes", batch=batch, seconds=seconds)
            note("round", batch, got["seconds"] / got["rounds"])
            for what, used in _processor_times(pair).items():
                note(what, batch, (used - before[what]) / got["rounds"])
            note(
                "solver", batch, driver.ask(do="solver", batch=batch, seconds=seconds / 4)["median"]
            )
    rows = []
    for batch in batches:
        own = {what: np.array(found) for (what, size), found in samples.items() if size == batch}
        overhead = own["round"] - own["solver"]
        rows.append(
            {
                "cores": cores,
                "batch": batch,
                "rounds_per_second": 1 / median(own["round"]),
                "overhead_us": 1e6 * median(overhead),
                "ratio": median(overhead / own["ping"]),
                "ratio_same": median(overhead / own["ping_same"]),
                **{f"{what}_us": 1e6 * median(times) for what, times in own.items()},
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


def run(turns: int = 7, seconds: float = 0.4, cores: Sequence[str] = CORES) -> dict[str, Any]:
    """Everything, as JSON-able data."""
    rows = [row for where in cores for row in measure(BATCHES, turns, seconds, where)]
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

    def shown(name: str, value: Any) -> str:
        if isinstance(value, float):
            return f"{value:.2f}" if name.startswith("ratio") else f"{value:.0f}"
        return str(value)

    rows = [[shown(name, row[name]) for name in COLUMNS] for row in result["rows"]]
    return markdown(tuple(COLUMNS.values()), rows)
