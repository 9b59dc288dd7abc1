"""`python -m benchmarks environments`: environment-steps a second of the Gymnasium environments.

The batch of `VectorEnvironment` beside Gymnasium's own vector environments of as many single ones, in
one process (sync) and in a process each (async), with the same random actions.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from statistics import median
from typing import Any

import gymnasium

from benchmarks.processes import machine, markdown
from pdeloop.environments import environment_id

MODES = {"vector_entry_point": "batch", "sync": "sync", "async": "async"}
LIMIT = 1.0
"""Of the actions, so that no environment diverges."""


def run(
    problem: str = "burgers", num_envs: Sequence[int] = (1, 4, 16), turns: int = 3
) -> dict[str, Any]:
    """The rates for each number of environments; the modes take turns."""
    rows = []
    for count in num_envs:
        made = {
            mode: gymnasium.make_vec(
                environment_id(problem), count, vectorization_mode=mode, action_limit=LIMIT
            )
            for mode in MODES
        }
        rates: dict[str, list[float]] = {mode: [] for mode in MODES}
        try:
            for turn in range(-1, turns):  # the first one is to warm up
                for mode, envs in made.items():
                    rate = _rate(envs, 0.5)
                    if turn >= 0:
                        rates[mode].append(rate)
        finally:
            for envs in made.values():
                envs.close()
        found = {name: median(rates[mode]) for mode, name in MODES.items()}
        rows.append({"num_envs": count, **found})
    return {"problem": problem, "machine": machine(), "rows": rows}


def _rate(envs: Any, seconds: float) -> float:
    """Environment-steps a second."""
    envs.reset(seed=0)
    actions = envs.action_space.sample()
    steps, start = 0, time.perf_counter()
    while (passed := time.perf_counter() - start) < seconds:
        envs.step(actions)
        steps += 1
    return float(steps * envs.num_envs / passed)


def text(result: dict[str, Any]) -> str:
    """A table of the rates."""
    head = ("environments", *(f"{name}, steps/s" for name in MODES.values()))
    rows = [
        (str(row["num_envs"]), *(f"{row[name]:,.0f}" for name in MODES.values()))
        for row in result["rows"]
    ]
    return f"{result['problem']}\n{markdown(head, rows)}"
