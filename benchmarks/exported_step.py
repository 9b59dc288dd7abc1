# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""`python -m benchmarks exported_step`: the time of a step of the law `neural`, in C and in Python.

Its numbers are random: the time depends on their count alone.
"""

from __future__ import annotations

import ctypes
import subprocess
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

import pdeloop
from benchmarks.processes import machine
from pdeloop.export import Parameters
from pdeloop.messages.action_set import ActionSet
from pdeloop.messages.model_rows import ModelRows
from pdeloop.method.laws.neural import Layers, Neural
from tuner_node.results import step_times

__all__ = ["run", "text"]

TURNS, STEPS = 5, 2000
TIMED = """
#include <time.h>
double timed(int steps, double *z, double *a) {
    clock_t began = clock();
    for (int k = 0; k < steps; ++k) { z[0] += 1e-6; pdeloop_law(z, a); }
    return (double)(clock() - began) / CLOCKS_PER_SEC / steps;
}
"""


def run(
    problems: Sequence[str] = ("kuramoto-sivashinsky-22", "allen-cahn", "ginzburg-landau-20"),
    *,
    neurons: int = 64,
) -> dict[str, Any]:
    """Time steps of the law, by the processor's clock.

    Parameters
    ----------
    problems
        Names of shipped problems, whose sizes it has.
    neurons
        Neurons of the hidden layer.
    """
    rows = [timed(name, neurons) for name in problems]
    return {"machine": machine(), "rows": rows}


def timed(problem: str, neurons: int) -> dict[str, Any]:
    """Sizes, and microseconds of a step, in the median of several turns."""
    values, rng = pdeloop.problem(problem).values, np.random.default_rng(0)
    plant = pdeloop.problem(problem).plant()
    n_z, n_a, n_s = plant.state_size, plant.n_a, int(values["reduced_order"])
    U = np.linalg.qr(rng.standard_normal((n_z, n_s)))[0]
    K, s_r = rng.standard_normal((2, n_a, n_s)), rng.standard_normal(n_s)
    rows = ModelRows(np.eye(n_s), np.ones((n_s, n_a)), U, K[0], K[1], s_r)
    law = Neural(rows, plant.horizon)
    shapes = (neurons, n_s), (neurons,), (n_a, neurons), (n_a,)
    theta = law.theta_of(np.hstack(list(K)), K[0], Layers(*map(rng.standard_normal, shapes)))
    allowed = ActionSet(n_a, -1.0, 1.0)
    source = Parameters("neural", theta, law.model, law, allowed, plant.sample_time, problem).c()
    z, a = rng.standard_normal(n_z), np.zeros(n_a)
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "law.c"
        file.write_bytes(source + TIMED.encode())
        library = file.with_suffix(".so")
        words = ["cc", "-std=c99", "-O2", "-shared", "-fPIC", "-o", str(library), str(file), "-lm"]
        subprocess.run(words, check=True)
        function = ctypes.CDLL(str(library)).timed
        function.restype, numbers = ctypes.c_double, ctypes.POINTER(ctypes.c_double)
        pointers = [array.ctypes.data_as(numbers) for array in (z, a)]
        in_c = median(function(STEPS, *pointers) for _ in range(TURNS))
    _, in_python = step_times(law, theta, z, STEPS)
    row = {"problem": problem, "n_z": n_z, "n_s": n_s, "n_a": n_a}
    return row | {"us in C": 1e6 * in_c, "us in Python": 1e6 * in_python}


def text(result: Mapping[str, Any]) -> str:
    """A Markdown table."""
    names = list(result["rows"][0])
    lines = [f"| {' | '.join(names)} |", "|---" * len(names) + "|"]
    for row in result["rows"]:
        shown = [f"{own:.2g}" if isinstance(own, float) else str(own) for own in row.values()]
        lines.append(f"| {' | '.join(shown)} |")
    return "\n".join(lines)
