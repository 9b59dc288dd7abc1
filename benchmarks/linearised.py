# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""`python -m benchmarks linearised`: LQR of the exact linearisation at the target, with the full state.

For the linear problems it is the optimum over an infinite horizon; for the others it is what a perfect
model of small fields gives. Costs are those of `pdeloop train`'s closing evaluation.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pde_sim_node.build import build_plant
from pdeloop.episode import Law, rollout
from pdeloop.messages.problem import load_parameters
from pdeloop.method.seeds import Purpose, derive
from pdeloop.unstable_modes import linearisation

FIELDS = 10


def linear(K: NDArray[np.float64], target: NDArray[np.float64]) -> Law:
    """a = K (z - z_r)."""
    return lambda k, z: (z - target) @ K.T


def costs(problem: str) -> dict[str, Any]:
    """Mean stage costs without control and with that law; None where no law stabilises A."""
    from scipy.linalg import solve_discrete_are

    plant = build_plant(load_parameters(problem, {}))
    A, B = linearisation(plant)
    R = plant.action_weight * np.eye(plant.n_a)
    laws: dict[str, NDArray[np.float64]] = {"none": np.zeros((plant.n_a, plant.n_z))}
    closed = np.inf
    try:
        P = solve_discrete_are(A, B, plant.state_weight * np.eye(plant.n_z), R)
        laws["lqr"] = -np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A)
        closed = np.abs(np.linalg.eigvals(A + B @ laws["lqr"])).max()
    except np.linalg.LinAlgError:
        pass
    if closed > 1 + 1e-9:  # nothing that it says about an unstable loop means anything
        laws.pop("lqr", None)
    seeds = [derive(0, Purpose.EVALUATION_FIELD, i) for i in range(FIELDS)]
    found: dict[str, Any] = {"radius": float(np.abs(np.linalg.eigvals(A)).max()), "lqr": None}
    for name, gain in laws.items():
        episode = rollout(plant, linear(gain, plant.target), seeds, keep=False)
        found[name] = float(episode.costs.mean.mean())
    return found


def run(problems: Sequence[str]) -> list[dict[str, Any]]:
    """Measure the cost of each problem with the LQR law of its exact linearisation.

    Parameters
    ----------
    problems
        Names of problems, or YAML files.
    """
    return [{"problem": problem, **costs(problem)} for problem in problems]


def text(rows: Sequence[Mapping[str, Any]]) -> str:
    """A line for each problem."""
    lines = []
    for row in rows:
        law = "no stabilising law" if row["lqr"] is None else f"{row['lqr']:.4g}"
        lines.append(
            f"{row['problem']}: {row['none']:.4g} without control, {law} with the LQR of the exact "
            f"linearisation (spectral radius {row['radius']:.4f})"
        )
    return "\n".join(lines)
