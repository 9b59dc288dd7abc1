# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""beacon's `shkadov-v0` with five jets: a falling film, of which each jet sees ten flow rates."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, TypeAlias

import numpy as np

from benchmarks.tasks.common import Row, shown
from pde_sim_node.plants.falling_film import FallingFilm
from pdeloop.messages.arrays import Array

STARTS = np.arange(2000, 2010)
"""Seeds of the ten initial films."""
TUNING = np.arange(100, 102)
"""Those on which laws are chosen."""
GAINS = (-1.0, -0.5, -0.25, 0.25, 0.5)
PLACES = (1, 3, 5, 7)
"""Distances before a jet at which a proportional law takes the flow rate."""
Sensed: TypeAlias = Callable[[Array], Array]
"""Flow rates (M, n, 10) before n jets -> actions (M, n)."""


def rows(budgets: list[int], seeds: int) -> Iterator[Row]:
    """The table of the film; with proportional laws alone."""
    known = FallingFilm()
    starts, tuning = (
        np.stack([known.initial_state(np.random.default_rng(s)) for s in drawn])
        for drawn in (STARTS, TUNING)
    )

    def row(name: str, law: Sensed, spent: Any) -> Row:
        found = returns(known, law, starts)
        return {
            "controller": name,
            "return": shown(found.mean()),
            "worst start": shown(found.min()),
            "episodes": spent,
            "by": "here",
        }

    yield row("none", lambda q: np.zeros(q.shape[:2]), 0)
    laws = {(gain, place): proportional(gain, place) for gain in GAINS for place in PLACES}
    gain, place = max(laws, key=lambda pair: returns(known, laws[pair], tuning).mean())
    name = f"{gain:g} (q - 1) at {place} before the jet, the best of {len(laws)}"
    yield row(name, laws[gain, place], len(laws) * len(tuning))


def proportional(gain: float, place: int) -> Sensed:
    """u_j = gain (q - 1), q at a distance before jet j."""
    return lambda q: gain * (q[:, :, 10 - place] - 1.0)


def returns(known: FallingFilm, law: Sensed, starts: Array) -> Array:
    """The return from each start, with the actions bounded."""
    z, total = starts.copy(), np.zeros(len(starts))
    for _ in range(known.horizon):
        a = np.clip(law(known.readings(z)), known.action_low, known.action_high)
        z = known.step(z, a)
        total -= known.state_weight * np.square(z @ known.output.T - 1.0).sum(axis=1)
    return total
