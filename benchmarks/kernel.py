# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Time per sampling time of one environment: this plant against other implementations.

All of them integrate the same equation with the same ETDRK4 and the same dealiasing. NumPy stands
for what one writes first, vectorised over the environments with SciPy's FFT; JAX for the same,
jitted, in a Python environment of its own, named by the path of its interpreter. Beside controlgym,
the library that the paper used: benchmarks.environments.
"""

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pde_sim_node.equations import EQUATIONS, Equation
from pde_sim_node.supports import indicator_supports
from pdeloop.process.module_path import safe_environment
from pdeloop.solver.reference import ReferenceStep

BATCHES = (1, 2, 12, 64)
SECONDS = 0.25
"""Measuring time of each figure (s)."""
KEEP_MEMORY = {"MALLOC_MMAP_THRESHOLD_": str(2**24), "MALLOC_TRIM_THRESHOLD_": str(2**28)}
"""For the references: glibc may return their temporaries to the system at every step, and the page
faults then cost up to ten times the arithmetic."""


@dataclass(frozen=True)
class Grid:
    """The discretisation of one of the paper's problems."""

    n_z: int
    n_a: int
    width: float
    sample_time: float
    integration_time: float

    @property
    def steps(self) -> int:
        return round(self.sample_time / self.integration_time)


GRIDS = {
    "burgers": Grid(128, 6, 0.15, 0.05, 0.0025),
    "allen-cahn": Grid(256, 12, 0.05, 0.01, 0.01),
    "kdv": Grid(256, 10, 0.05, 0.01, 0.001),
}


def reference(equation: Equation, grid: Grid) -> ReferenceStep:
    """The step in plain NumPy."""
    supports = indicator_supports(grid.n_z, grid.n_a, grid.width)
    return ReferenceStep(
        equation, supports, integration_time=grid.integration_time, steps=grid.steps
    )


def least_microseconds(step: Callable[[], object], batch: int) -> float:
    """The fastest of many repeats: the others are slowed by other programs, not by the method."""
    step()
    times: list[float] = []
    end = time.perf_counter() + SECONDS
    while time.perf_counter() < end or len(times) < 5:
        began = time.perf_counter()
        step()
        times.append(time.perf_counter() - began)
    return min(times) / batch * 1e6


def start(problem: str, batch: int) -> tuple[Equation, NDArray[np.float64], NDArray[np.float64]]:
    """An equation, initial fields and actions."""
    equation, grid = EQUATIONS[problem](), GRIDS[problem]
    x = equation.length * np.arange(grid.n_z) / grid.n_z
    fields = [equation.initial_field(x, np.random.default_rng(seed)) for seed in range(batch)]
    actions = np.random.default_rng(0).normal(0, 0.3, (batch, grid.n_a))
    return equation, np.array(fields), actions


def time_pdeloop(problem: str, batch: int) -> float:
    from pde_sim_node.plants import SpectralPlant

    equation, _, actions = start(problem, batch)
    settings = {**asdict(GRIDS[problem]), "state_weight": 1.0, "action_weight": 1.0}
    plant = SpectralPlant(equation, **settings, horizon=10**9)
    plant.reset(np.arange(batch))

    def step() -> None:
        if plant.step_index >= 80:
            plant.reset(np.arange(batch))
        plant.step(actions)

    return least_microseconds(step, batch)


def time_numpy(problem: str, batch: int) -> float:
    equation, states, actions = start(problem, batch)
    step = reference(equation, GRIDS[problem])
    return least_microseconds(lambda: step(states, actions), batch)


def time_jax(problem: str, batch: int) -> float:
    import jax  # type: ignore[import-not-found, unused-ignore]

    jax.config.update("jax_enable_x64", True)
    from jax import numpy as jnp

    equation, states, actions = start(problem, batch)
    plant = reference(equation, GRIDS[problem])
    c, modes = plant.coefficients, plant.n_z // 2 + 1

    @jax.jit  # type: ignore[untyped-decorator, unused-ignore]
    def step(states: Any, actions: Any) -> Any:
        forcing = actions @ plant.supports

        def nonlinear(v: Any) -> Any:
            u = plant.fine / plant.n_z * jnp.fft.irfft(v, plant.fine)
            return plant.multiplier * jnp.fft.rfft(plant.nonlinearity(u))[:, :modes] + forcing

        def integrate(_: int, v: Any) -> Any:
            n_v, half = nonlinear(v), c.e2 * v
            a = half + c.q * n_v
            n_a = nonlinear(a)
            n_b = nonlinear(half + c.q * n_a)
            n_c = nonlinear(c.e2 * a + c.q * (2 * n_b - n_v))
            return c.e * v + c.f1 * n_v + 2 * c.f2 * (n_a + n_b) + c.f3 * n_c

        v = jnp.fft.rfft(states)
        v = integrate(0, v) if plant.steps == 1 else jax.lax.fori_loop(0, plant.steps, integrate, v)
        return jnp.fft.irfft(v, plant.n_z)

    z, a = jnp.asarray(states), jnp.asarray(actions)
    return least_microseconds(lambda: step(z, a).block_until_ready(), batch)


METHODS = {"pdeloop": time_pdeloop, "numpy": time_numpy, "jax": time_jax}


def measure(method: str, batches: Sequence[int]) -> list[dict[str, Any]]:
    """Least time that a sampling time of one environment took, for each problem and batch."""
    return [
        {
            **{"problem": problem, "batch": batch, "method": method},
            "microseconds": METHODS[method](problem, batch),
        }
        for problem in GRIDS
        for batch in batches
    ]


def measure_with(python: str, method: str, batches: Sequence[int]) -> list[dict[str, Any]]:
    """`measure` by another interpreter; CalledProcessError if it fails, its words on stderr."""
    from benchmarks.processes import program

    done = subprocess.run(
        [python, *program("benchmarks.kernel", method, *map(str, batches))[1:]],
        check=True,
        stdout=subprocess.PIPE,
        text=True,
        timeout=600,
        env={**safe_environment(os.environ), **KEEP_MEMORY},
    )
    rows: list[dict[str, Any]] = json.loads(done.stdout.splitlines()[-1])
    return rows


def run(*, batches: Sequence[int] = BATCHES, jax: str | None = None) -> list[dict[str, Any]]:
    """Measure the plant and its references, one after the other.

    Parameters
    ----------
    batches
        Batch sizes: numbers of environments.
    jax
        Python interpreter that can import JAX; if not given, JAX is left out.
    """
    rows = measure("pdeloop", batches) + measure_with(sys.executable, "numpy", batches)
    return rows + (measure_with(jax, "jax", batches) if jax else [])


def text(rows: Sequence[Mapping[str, Any]]) -> str:
    """Times, and in brackets how many times slower than the plant, as Markdown."""
    from benchmarks.processes import markdown  # what the other interpreters lack

    methods = list(dict.fromkeys(row["method"] for row in rows))
    times = {
        (row["problem"], row["batch"], row["method"]): float(row["microseconds"]) for row in rows
    }
    table = []
    for problem, batch in dict.fromkeys((row["problem"], row["batch"]) for row in rows):
        own = [times[problem, batch, method] for method in methods]
        table.append((problem, batch, *(f"{time:.1f} ({time / own[0]:.1f})" for time in own)))
    return markdown(("problem", "batch", *methods), table)


if __name__ == "__main__":
    print(json.dumps(measure(sys.argv[1], [int(batch) for batch in sys.argv[2:]])))
