# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Werner and Peitz's Kuramoto-Sivashinsky equation with four jets, the whole field measured.

The return of an episode of 400 actions is minus the sum of the mean squares of the field over the time
steps of each action. The plant is built with the distances of the released code, which does not wrap
them: the first jet is half of one.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from benchmarks.tasks.common import Row, shown, trainings
from benchmarks.tasks.kuramoto_sivashinsky import told
from pde_sim_node.plants.kuramoto_sivashinsky_four import KuramotoSivashinskyFour
from pdeloop.episode import Law
from pdeloop.messages.arrays import Array

STARTS = np.arange(2000, 2050)
"""Seeds of the fifty initial states: a return varies by a third of itself from start to start."""
ORDER = 16
SOURCE = (
    ("model-based", "-220 ± 10", 125),
    ("SAC", "-375 ± 10", 125),
    ("SAC", "-180 ± 10", 2500),
    ("PPO", "-390 ± 10", 2500),
)
"""Read off the plot of the source, whose evaluation has ten starts."""


def rows(budgets: list[int], seeds: int) -> Iterator[Row]:
    """The table; a training makes a law that plans."""
    known = KuramotoSivashinskyFour()
    starts = np.stack([known.initial_state(np.random.default_rng(s)) for s in STARTS])

    def row(name: str, laws: list[Law], spent: Any) -> Row:
        found = np.array([returns(known, law, starts) for law in laws])
        kinds = found.mean(axis=1), np.median(found, axis=1), found.min(axis=1)
        return _row(name, [shown(kind, np.min, 4) for kind in kinds], spent, "here")

    for name, figure, episodes in SOURCE:
        yield _row(name, [figure, "", ""], episodes, "Werner and Peitz, plot")
    yield row("none", [lambda k, z: np.zeros((len(z), known.n_a))], 0)
    K = told(known)
    yield row("LQR of the equation told, about rest", [lambda k, z: z @ K.T], "")
    few = {"iterations": 5}  # an affine law has little to gain, and is only where plans begin
    how = {"law": "predictive", "optimizer_settings": few, "reduced_order": ORDER}
    for made in trainings(KuramotoSivashinskyFour, budgets, seeds, **how):
        yield row(*made)


def returns(known: KuramotoSivashinskyFour, law: Law, starts: Array) -> Array:
    """The return from each start."""
    z, total = starts.copy(), np.zeros(len(starts))
    for k in range(known.horizon):
        a = np.clip(law(k, z), known.action_low, known.action_high)
        z, squares = known.integrated(z, a)
        total -= squares
    return total


def _row(name: str, figures: Sequence[str], spent: Any, by: str) -> Row:
    heads = ("mean return", "median", "worst start")
    return {
        "controller": name,
        **dict(zip(heads, figures, strict=True)),
        "episodes": spent,
        "by": by,
    }
