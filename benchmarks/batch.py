# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""`python -m benchmarks batch`: environment steps per second against the batch size, with its knee.

A round of M environments takes t(M) = c + w M + s(M): what a message costs whatever is in it, what
it costs for each environment (copies, the control law), and the solver. The batch pays as long as c
is the larger part; the knee is where it is half: M = c / (w + s). Beyond it the rate is that of
solver and copies, 1 / (w + s) environment steps per second, however large the batch.

The processor time of a round, in the threads of the plant and of the controller, hardly depends on
what else the machine does.
"""

from __future__ import annotations

from statistics import median
from typing import Any

import numpy as np

from benchmarks.processes import BenchProcess, bench, machine, markdown

BATCHES = (1, 2, 4, 8, 16, 32, 64, 128, 256, 512, 1024)
LONG, SHORT = 1000, 100
"""Steps of an episode below and from this batch on, so that starting one costs nothing."""
SHORT_FROM = 64


def run(*, problem: str = "allen-cahn", turns: int = 3, batches: tuple[int, ...] = BATCHES) -> Any:
    """Measure each batch size, and fit a model of the time of a round.

    Parameters
    ----------
    problem
        The problem whose loop is measured.
    turns
        Number of measurements of each batch size.
    batches
        Batch sizes: numbers of environments.
    """
    samples: dict[tuple[int, str], list[float]] = {}
    for horizon in (LONG, SHORT):
        own = [m for m in batches if (m < SHORT_FROM) == (horizon == LONG)]
        if not own:
            continue
        with bench() as running:
            length = f"horizon:={horizon}"
            nodes = {
                "plant": running.start("pde_sim_node", length, problem=problem),
                "controller": running.start("controller_node", problem=problem),
            }
            driver = running.start("benchmarks.driver", length, problem=problem)
            for turn in range(-1, turns):  # the first one is to warm up
                for batch in own:
                    before = _processor_times(nodes)
                    got = driver.ask(do="episodes", batch=batch, seconds=0.3 if turn >= 0 else 0.0)
                    after = _processor_times(nodes)
                    solver = driver.ask(do="solver", batch=batch, seconds=0.1)["median"]
                    if turn >= 0:
                        spent = {name: after[name] - before[name] for name in nodes}
                        spent["round"] = got["seconds"]
                        found = {what: value / got["rounds"] for what, value in spent.items()}
                        for what, value in {**found, "solver": solver}.items():
                            samples.setdefault((batch, what), []).append(value)
    rows = []
    for batch in batches:
        round_time, solver, plant, controller = (
            median(samples[batch, what]) for what in ("round", "solver", "plant", "controller")
        )
        rows.append(
            {
                "batch": batch,
                "rounds_per_second": 1 / round_time,
                "environment_steps_per_second": batch / round_time,
                "round_us": 1e6 * round_time,
                "solver_us": 1e6 * solver,
                "overhead_us": 1e6 * (round_time - solver),
                "plant_processor_us": 1e6 * plant,
                "controller_processor_us": 1e6 * controller,
            }
        )
    return {"problem": problem, "machine": machine(), "rows": rows, "model": fit(rows)}


def _processor_times(nodes: dict[str, BenchProcess]) -> dict[str, float]:
    return {name: sum(node.processor_times().values()) for name, node in nodes.items()}


def fit(rows: list[dict[str, Any]]) -> dict[str, float]:
    """c, w and s of the model in µs, and the knee, weighted so that every batch counts alike."""
    batch = np.array([row["batch"] for row in rows], dtype=np.float64)
    overhead = np.array([row["overhead_us"] for row in rows])
    solver = np.array([row["solver_us"] for row in rows])
    weight = 1 / np.array([row["round_us"] for row in rows])
    columns = np.column_stack([np.ones_like(batch), batch])
    (c, w), *_ = np.linalg.lstsq(columns * weight[:, None], overhead * weight, rcond=None)
    s = float(np.sum(solver * batch * weight**2) / np.sum(batch**2 * weight**2))
    per_environment = max(float(w), 0.0) + s
    return {
        "message_us": float(c),
        "environment_us": float(w),
        "solver_us": s,
        "knee": float(c) / per_environment,
        "limit_environment_steps_per_second": 1e6 / per_environment,
    }


def text(result: dict[str, Any]) -> str:
    """A table of `result`, with the knee in words."""
    columns = {
        "batch": "batch",
        "rounds_per_second": "rounds/s",
        "environment_steps_per_second": "environment-steps/s",
        "round_us": "round µs",
        "solver_us": "solver µs",
        "overhead_us": "overhead µs",
        "plant_processor_us": "plant, processor µs",
        "controller_processor_us": "controller, processor µs",
    }
    rows = [[f"{row[name]:.0f}" for name in columns] for row in result["rows"]]
    model = result["model"]
    return (
        f"{result['problem']}\n{markdown(tuple(columns.values()), rows)}\n"
        f"round = {model['message_us']:.0f} µs + M * ({model['environment_us']:.2f} µs for copies "
        f"and control law + {model['solver_us']:.2f} µs for the solver).\nThe knee is at M = "
        f"{model['knee']:.0f}: there half of a round is the message itself; far beyond it the rate "
        f"tends to {model['limit_environment_steps_per_second']:.0f} environment-steps/s."
    )
