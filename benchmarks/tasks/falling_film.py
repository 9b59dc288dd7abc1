# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""beacon's `shkadov-v0` with five jets: a falling film, of which each jet sees ten flow rates.

A training sees those, and ten behind the last jet, where nothing else would show what it does. Its cost
is the mean square of q - 1 at the fifty points behind jets; the return is the source's, of h - 1.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.tasks.common import Row, shown, trainings
from pde_sim_node.arguments import positive
from pde_sim_node.dynamics import Dynamics
from pde_sim_node.plants.falling_film import FallingFilm
from pdeloop.episode import Law
from pdeloop.messages.arrays import Array

STARTS = np.arange(2000, 2010)
"""Seeds of the ten initial films."""
TUNING = np.arange(100, 102)
"""Those on which laws are chosen."""
GAINS = (-1.0, -0.5, -0.25, 0.25, 0.5)
POINTS = 10
"""Flow rates before each jet, at distances of 1."""
PLACES = (1, 3, 5, 7)
"""Distances before a jet at which a proportional law takes the flow rate."""
ACTION_COST = 1.0
"""R of a training, over the number of points; chosen on films 100 to 103 from 0.1, 1 and 10."""


def rows(budgets: list[int], seeds: int) -> Iterator[Row]:
    """The table of the film: proportional laws, and trainings."""
    film = _film()
    starts, tuning = (
        np.stack([film.initial_state(np.random.default_rng(s)) for s in drawn])
        for drawn in (STARTS, TUNING)
    )

    def row(name: str, laws: list[Law], spent: Any) -> Row:
        found = np.array([returns(law, starts) for law in laws])
        return {
            "controller": name,
            "return": shown(found.mean(axis=1), np.min),
            "worst start": shown(found.min(axis=1), np.min),
            "episodes": spent,
            "by": "here",
        }

    yield row("none", [lambda _, q: np.zeros((len(q), film.n_a))], 0)
    laws = {(gain, place): proportional(gain, place) for gain in GAINS for place in PLACES}
    gain, place = max(laws, key=lambda pair: returns(laws[pair], tuning).mean())
    name = f"{gain:g} (q - 1) at {place} before the jet, the best of {len(laws)}"
    yield row(name, [laws[gain, place]], len(laws) * len(tuning))
    for name, found, spent in trainings(SensedFilm, budgets, seeds):
        yield row(name, found, spent)


class SensedFilm(Dynamics):
    """The film as a training sees it: z = q at ten points before each jet, and behind the last.

    Parameters
    ----------
    action_cost
        R, over the number of points.

    Raises
    ------
    ValueError
        It is not positive.
    """

    stateful = True
    action_low, action_high = FallingFilm.action_low, FallingFilm.action_high
    sample_time, target = FallingFilm.sample_time, 1.0

    def __init__(self, action_cost: float = ACTION_COST) -> None:
        film = _film()
        self.n_z, self.n_a, self.horizon = len(_places()), film.n_a, film.horizon
        behind = self.n_z - POINTS
        self.state_weight = np.r_[np.zeros(POINTS), np.full(behind, 1.0 / behind)]
        self.action_weight = positive("action_cost", action_cost) / behind

    def initial_state(self, rng: np.random.Generator) -> Array:
        """See `FallingFilm.initial_state`."""
        self.film = _film().initial_state(rng)[None]
        start: Array = seen(self.film)[0]
        return start

    def step(self, z: Array, a: Array) -> Array:
        """See `Dynamics.step`."""
        self.film = _film().step(self.film, a[None])
        new: Array = seen(self.film)[0]
        return new


@cache
def _film() -> FallingFilm:
    return FallingFilm()


@cache
def _places() -> NDArray[np.int64]:
    film = _film()
    apart = round(1.0 / film.dx)
    first = film.first[0] - POINTS * apart
    return film.points + first + apart * np.arange(POINTS * (film.n_a + 1))


def seen(z: Array) -> Array:
    """q at the points of a training, (M, n_z of `SensedFilm`)."""
    found: Array = z[:, _places()]
    return found


def proportional(gain: float, place: int) -> Law:
    """u_j = gain (q - 1), q at a distance before jet j."""
    return lambda _, q: gain * (q[:, POINTS - place : -POINTS : POINTS] - 1.0)


def returns(law: Law, starts: Array) -> Array:
    """The return from each start, with the actions bounded."""
    film, z, total = _film(), starts.copy(), np.zeros(len(starts))
    for k in range(film.horizon):
        a = np.clip(law(k, seen(z)), film.action_low, film.action_high)
        z = film.step(z, a)
        total -= film.state_weight * np.square(z @ film.output.T - 1.0).sum(axis=1)
    return total
