"""`python -m benchmarks rtt`: the loop's rounds a second beside a bare ping-pong, in one run.

Both run all the time, in processes of their own, and take turns of a fraction of a second, so that
what else the machine does weighs on both alike; the figures are medians over the turns. A round of
the loop is: state, action, one step of the plant. Its overhead is the round without the solver,
which is measured in turns as well. The last columns are processor time a round, in µs: of the plant's
and the controller's own threads, and of the middleware's threads in both.
"""

from __future__ import annotations

from collections.abc import Sequence
from statistics import median
from typing import Any

from benchmarks.processes import Bench, BenchProcess, bench, machine, markdown
from loop_interfaces.affinity import least_busy_cores
from loop_interfaces.problem import load_parameters
from pdeloop.pairs import pair_cores, pair_nodes

PROBLEM = "allen-cahn"
"""P2: of the paper's problems the one whose step is shortest."""
BATCHES = (2, 64)
CORES = ("any", "shared", "pinned")
"""Where plant and controller are: wherever the scheduler puts them (nodes started by hand), on one
core for both (as `pdeloop train` does it), the same on a core that no other pair has (`--pin`). The
ping-pong is on any two, and with `pinned` on one each, polling."""
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
    pinned = cores == "pinned"
    chosen = [None] if cores == "any" else pair_cores(1, pinned)
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
        us = {what: 1e6 * median(samples[what, batch]) for what, own in samples if own == batch}
        overheads = [
            1e6 * (r - s)
            for r, s in zip(samples["round", batch], samples["solver", batch], strict=True)
        ]
        ratios = {
            name: median(
                o / (1e6 * p) for o, p in zip(overheads, samples[name, batch], strict=True)
            )
            for name in ("ping", "ping_same")
        }
        rows.append(
            {
                "cores": cores,
                "batch": batch,
                "ping_us": us["ping"],
                "ping_same_payload_us": us["ping_same"],
                "rounds_per_second": 1e6 / us["round"],
                "round_us": us["round"],
                "solver_us": us["solver"],
                "overhead_us": median(overheads),
                "ratio": ratios["ping"],
                "ratio_same_payload": ratios["ping_same"],
                "plant_us": us["plant"],
                "controller_us": us["controller"],
                "middleware_us": us["middleware"],
            }
        )
    return rows


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


def text(result: dict[str, Any]) -> str:
    """A table of `result`."""
    head = (
        "cores", "batch", "rounds/s", "round µs", "solver µs", "overhead µs",
        "ping-pong µs", "ratio", "same payload µs", "ratio",
        "plant", "controller", "middleware",
    )  # fmt: skip
    rows = [
        (
            row["cores"],
            row["batch"],
            f"{row['rounds_per_second']:.0f}",
            f"{row['round_us']:.0f}",
            f"{row['solver_us']:.0f}",
            f"{row['overhead_us']:.0f}",
            f"{row['ping_us']:.0f}",
            f"{row['ratio']:.2f}",
            f"{row['ping_same_payload_us']:.0f}",
            f"{row['ratio_same_payload']:.2f}",
            f"{row['plant_us']:.0f}",
            f"{row['controller_us']:.0f}",
            f"{row['middleware_us']:.0f}",
        )
        for row in result["rows"]
    ]
    return markdown(head, rows)
