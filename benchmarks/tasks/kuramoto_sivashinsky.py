# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""DA-RL's Kuramoto-Sivashinsky equation with eight actuators, the whole field measured.

The return of an episode of 1,000 actions is the sum of -|u|_2 / sqrt(64) - 0.2 |a|_2 over new
states, not squared. Laws are designed for the plant's quadratic cost, and measured by the return.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from benchmarks.tasks.common import Row, shown, trainings
from pde_sim_node.plants.kuramoto_sivashinsky_eight import KuramotoSivashinskyEight
from pde_sim_node.plants.kuramoto_sivashinsky_four import KuramotoSivashinskyFour
from pdeloop.episode import Law
from pdeloop.messages.arrays import Array

STARTS = np.arange(2000, 2020)
"""Seeds of the twenty initial states."""
OTHERS = np.arange(4000, 4400)
"""Of further ones, from which LQR tells what the choice of twenty is worth."""
EFFORT = 0.2
"""Factor of |a| in the return."""
ORDER = 16
ACTION_COST = 0.01
"""R, chosen with LQR of the equation told on other starts, among 0.003, 0.01, 0.03 and 0.1."""
PLAN = 40
"""Steps of a plan, chosen on other starts."""


def rows(budgets: list[int], seeds: int) -> Iterator[Row]:
    """The table of the whole field."""
    known, starts = _plant(), _drawn(STARTS)

    def row(name: str, laws: list[Law], spent: Any, starts: Array = starts) -> Row:
        found = np.array([returns(known, law, starts) for law in laws])
        kinds = found.mean(axis=1), np.median(found, axis=1), found.min(axis=1)
        return _row(name, [shown(kind, np.min) for kind in kinds], spent, "here")

    yield _row("DDPG", ["-145.5", "", ""], 200, "DA-RL, printed")
    yield row("none", [lambda k, z: np.zeros((len(z), known.n_a))], 0)
    K = told(known)
    yield row("LQR of the equation told", [lambda k, z: z @ K.T], "")
    others = f"the same from {len(OTHERS)} other starts"
    yield row(others, [lambda k, z: z @ K.T], "", _drawn(OTHERS))
    how = {"law": "predictive", "law_settings": {"steps": PLAN}, "reduced_order": ORDER}
    for made in trainings(_plant, budgets, seeds, **how):
        yield row(*made)


def _plant() -> KuramotoSivashinskyEight:
    return KuramotoSivashinskyEight(action_cost=ACTION_COST)


def _drawn(seeds: NDArray[np.int64]) -> Array:
    """The initial states of some seeds, side by side."""
    known, small = _plant(), KuramotoSivashinskyEight(burn_in=0)
    z = np.stack([small.initial_state(np.random.default_rng(seed)) for seed in seeds])
    for _ in range(known.burn_in):
        z = known.step(z, np.zeros((len(z), known.n_a)))
    return z


def returns(known: KuramotoSivashinskyEight, law: Law, starts: Array) -> Array:
    """The return from each start."""
    z, total = starts.copy(), np.zeros(len(starts))
    for k in range(known.horizon):
        a = np.clip(law(k, z), known.action_low, known.action_high)
        z = known.step(z, a)
        total -= np.sqrt(np.mean(z**2, axis=1)) + EFFORT * np.linalg.norm(a, axis=1)
    return total


def told(known: KuramotoSivashinskyEight | KuramotoSivashinskyFour) -> Array:
    """The gains of LQR on the plant's linearisation at rest."""
    small, n = 1e-7, known.grid.size
    A = known.step(small * np.eye(n), np.zeros((n, known.n_a))).T / small
    B = known.step(np.zeros((known.n_a, n)), small * np.eye(known.n_a)).T / small
    R = known.action_weight * np.eye(known.n_a)
    P = scipy.linalg.solve_discrete_are(A, B, known.state_weight * np.eye(n), R)
    gains: Array = -np.linalg.solve(R + B.T @ P @ B, B.T @ P @ A)
    return gains


def _row(name: str, figures: Sequence[str], spent: Any, by: str) -> Row:
    heads = ("mean return", "median", "worst start")
    return {
        "controller": name,
        **dict(zip(heads, figures, strict=True)),
        "episodes": spent,
        "by": by,
    }
