# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""From which fields a law is improved: a chaotic plant is told from others."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest

from pdeloop.messages.cost import Cost
from pdeloop.method.adapt.closed_loop import ClosedLoop
from pdeloop.method.adapt.improve import any_state_serves, initial_fields, is_chaotic
from pdeloop.method.adapt.trajectories import Record

N_Z = 12
Map = Callable[[np.ndarray], np.ndarray]
FIELDS = np.random.default_rng(0).uniform(0.2, 0.8, (4, N_Z))


@dataclass
class Plant:
    """z' = f(z) at every point."""

    f: Map
    n_z, n_a = N_Z, 1

    def step(self, states: np.ndarray, actions: np.ndarray) -> np.ndarray:
        return self.f(states)


def logistic(r: float) -> Map:
    """Chaotic at r = 3.9, and at rest in 1 - 1/r at r = 2.5."""
    return lambda z: r * z * (1.0 - z)


def falling(z: np.ndarray) -> np.ndarray:
    """Small changes grow, as of a chaotic plant, and from far it falls for good."""
    return 1.1 * z + z**3


def loop_of(f: Map, target: float = 0.6) -> ClosedLoop:
    return ClosedLoop(np.eye(N_Z, 3), Cost(N_Z, 1, 40, target=target), model=Plant(f))  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("f", "target", "fields", "chaotic"),
    [
        (logistic(3.9), 0.6, FIELDS, True),
        (logistic(2.5), 0.6, FIELDS, False),
        (logistic(3.9), 0.6, FIELDS[:1], False),  # one field tells nothing
        (logistic(3.9), 0.6, np.full((2, N_Z), 3.0), False),  # from there it diverges
        (lambda z: z / 1.1, 0.0, np.array([FIELDS[0], -FIELDS[0]]), False),  # linear
    ],
)
def test_small_changes_grow_in_a_chaotic_plant_alone(
    f: Map, target: float, fields: np.ndarray, chaotic: bool
) -> None:
    assert is_chaotic(loop_of(f, target), fields) == chaotic


def test_states_of_a_plant_that_runs_away_do_not_serve_as_initial_fields() -> None:
    signs = np.array([[1], [-1], [1], [-1]])
    near = np.random.default_rng(0).uniform(0.010, 0.011, (4, N_Z)) * signs
    falls, stays = loop_of(falling, 0.0), loop_of(logistic(3.9))
    assert is_chaotic(falls, near)
    assert not any_state_serves(falls, falls.no_control, near, np.concatenate([near, 30.0 * near]))
    assert any_state_serves(stays, stays.no_control, FIELDS, logistic(3.9)(FIELDS))


def test_a_stable_plant_is_not_chaotic_where_its_model_runs_away_from_some_fields() -> None:
    """As that of a heat exchanger without flow; close to where it does, small changes matter."""
    loop = loop_of(lambda z: 0.8 * z + 0.2 * z**3, 0.0)
    fields = np.array([0.3, 0.4, 0.5, 0.6, 0.998, 1.2])[:, None] * np.ones(N_Z)
    costs = loop.costs(loop.no_control, fields)
    assert np.isinf(costs[-1]) and costs[-2] > 2.0 * costs[:-2].sum()
    assert not is_chaotic(loop, fields)


def test_a_field_that_noise_measures_anew_is_the_same_one() -> None:
    """Rollouts of several laws from the field of one seed; -1 is no seed."""
    seeds = 7, 8, 7, 7, -1, -1
    records = [
        Record(np.zeros((1, 2)), 1.0, FIELDS[:2] + 0.01 * i, np.zeros((1, 1)), i, seed)
        for i, seed in enumerate(seeds)
    ]
    found = initial_fields(records)
    np.testing.assert_array_equal(found, [FIELDS[0] + 0.01 * i for i in (0, 1, 4, 5)])
