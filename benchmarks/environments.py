# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""`python -m benchmarks environments`: environment steps per second of the Gymnasium environments.

The batch of `VectorEnvironment` against Gymnasium's own vector environments of as many single ones, in
one process (sync) and in a process each (async), and against those of controlgym's environment of the
same equation, grid, actuators and steps, under constant actions.
"""

from __future__ import annotations

import json
import os
import subprocess
import time
from collections.abc import Sequence
from pathlib import Path
from statistics import median
from typing import Any

import gymnasium

import pdeloop
from benchmarks.kernel import KEEP_MEMORY
from benchmarks.processes import machine, table
from pdeloop.environments import environment_id

MODES = {"vector_entry_point": "batch", "sync": "sync", "async": "async"}
SECONDS = 0.5
"""Duration of a measurement (s)."""
LIMIT = 1.0
"""Bound of the actions, so that no environment diverges."""


def run(
    *,
    problem: str = "burgers",
    num_envs: Sequence[int] = (1, 4, 16),
    turns: int = 3,
    controlgym: str | None = None,
) -> dict[str, Any]:
    """Measure steps per second for each number of environments; the modes take turns.

    Parameters
    ----------
    problem
        The problem whose environments are measured.
    num_envs
        Numbers of environments in a batch.
    turns
        Number of measurements of each.
    controlgym
        Python interpreter that can import controlgym 1.0.0; if not given, it is left out.
    """
    rows = []
    for count in num_envs:
        made = {
            mode: gymnasium.make_vec(
                environment_id(problem), count, vectorization_mode=mode, action_limit=LIMIT
            )
            for mode in MODES
        }
        rates: dict[str, list[float]] = {name: [] for name in MODES.values()}
        try:
            for turn in range(-1, turns):  # the first one is to warm up
                for mode, envs in made.items():
                    rate = _rate(envs, SECONDS)
                    if turn >= 0:
                        rates[MODES[mode]].append(rate)
                if controlgym is not None and turn >= 0:
                    for mode, rate in _rates_of_controlgym(controlgym, problem, count).items():
                        rates.setdefault(f"controlgym {mode}", []).append(rate)
        finally:
            for envs in made.values():
                envs.close()
        rows.append({"num_envs": count, **{name: median(own) for name, own in rates.items()}})
    return {"problem": problem, "machine": machine(), "rows": rows}


def _rate(envs: Any, seconds: float) -> float:
    """Environment steps per second."""
    envs.reset(seed=0)
    actions = envs.action_space.sample()
    steps, start = 0, time.perf_counter()
    while (passed := time.perf_counter() - start) < seconds:
        envs.step(actions)
        steps += 1
    return float(steps * envs.num_envs / passed)


def _rates_of_controlgym(python: str, problem: str, count: int) -> dict[str, float]:
    """By mode; CalledProcessError if the interpreter fails, its words on stderr."""
    chosen = pdeloop.problem(problem)
    values = chosen.values
    parameters = {
        "n_steps": 10**9,
        "domain_length": values["length"],
        "integration_time": values["integration_time"],
        # It counts steps by a floor division, which must not come out one short.
        "sample_time": values["sample_time"] * (1 + 1e-12),
        "n_state": values["n_z"],
        "n_action": values["n_a"],
        "control_sup_width": values["actuator_width"],
        "sensor_noise_cov": 0.0,
    }
    program = Path(__file__).with_name("controlgym_rates.py")
    name = {"kdv": "korteweg_de_vries"}.get(problem, problem.replace("-", "_"))
    words = [python, str(program), name, json.dumps(parameters), str(count), str(SECONDS)]
    done = subprocess.run(
        words,
        check=True,
        stdout=subprocess.PIPE,
        text=True,
        timeout=600,
        # It decomposes the noise's covariance each step; threads of several processes would collide.
        env={**os.environ, **KEEP_MEMORY, "OPENBLAS_NUM_THREADS": "1"},
    )
    found: dict[str, float] = json.loads(done.stdout.splitlines()[-1])
    return found


def text(result: dict[str, Any]) -> str:
    """A table of the rates."""
    names = [name for name in result["rows"][0] if name != "num_envs"]
    columns = {"num_envs": "environments", **{name: f"{name}, steps/s" for name in names}}
    return f"{result['problem']}\n{table(result['rows'], columns)}"
