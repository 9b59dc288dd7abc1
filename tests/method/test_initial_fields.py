# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""From which fields a law is improved: a chaotic plant is told from others."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest

from pdeloop.messages.cost import Cost
from pdeloop.method.adapt.base import Record
from pdeloop.method.adapt.closed_loop import ClosedLoop
from pdeloop.method.adapt.renewal import (
    any_state_serves,
    initial_fields,
    is_chaotic,
    measured_states,
)

N_Z = 12


@dataclass
class Logistic:
    """z' = r z (1 - z) at every point, chaotic at r = 3.9 and at rest in 1 - 1/r at r = 2.5."""

    r: float
    n_z, n_a = N_Z, 1

    def step(self, states: np.ndarray, actions: np.ndarray) -> np.ndarray:
        return self.r * states * (1.0 - states)


@pytest.mark.parametrize(("r", "chaotic"), [(3.9, True), (2.5, False)])
def test_small_changes_grow_in_a_chaotic_plant_alone(r: float, chaotic: bool) -> None:
    loop = ClosedLoop(np.eye(N_Z, 3), Cost(N_Z, 1, 40, target=0.6), model=Logistic(r))  # type: ignore[arg-type]
    fields = np.random.default_rng(0).uniform(0.2, 0.8, (4, N_Z))
    assert is_chaotic(loop, fields) == chaotic
    assert not is_chaotic(loop, fields[:1])  # one field tells nothing


class Decaying(Logistic):
    """z' = z / r at every point."""

    def step(self, states: np.ndarray, actions: np.ndarray) -> np.ndarray:
        return states / self.r


def test_a_linear_plant_is_never_chaotic_however_far_its_fields_are_from_each_other() -> None:
    loop = ClosedLoop(np.eye(N_Z, 3), Cost(N_Z, 1, 40), model=Decaying(1.1))  # type: ignore[arg-type]
    field = np.random.default_rng(0).normal(size=N_Z)
    assert not is_chaotic(loop, np.array([field, -field]))


def test_fields_from_which_the_plant_diverges_say_nothing() -> None:
    """z' = 3.9 z (1 - z) tends to minus infinity from outside of 0 .. 1."""
    loop = ClosedLoop(np.eye(N_Z, 3), Cost(N_Z, 1, 40, target=0.6), model=Logistic(3.9))  # type: ignore[arg-type]
    assert not is_chaotic(loop, np.full((2, N_Z), 3.0))


@dataclass
class Falling:
    """z' = 1.1 z + z^3: small changes grow, as of a chaotic plant, and from far it falls for good."""

    n_z, n_a = N_Z, 1

    def step(self, states: np.ndarray, actions: np.ndarray) -> np.ndarray:
        return 1.1 * states + states**3


def test_states_of_a_plant_that_runs_away_do_not_serve_as_initial_fields() -> None:
    near = np.random.default_rng(0).uniform(0.010, 0.011, (4, N_Z)) * np.array(
        [[1], [-1], [1], [-1]]
    )
    falls = ClosedLoop(np.eye(N_Z, 3), Cost(N_Z, 1, 40), model=Falling())  # type: ignore[arg-type]
    none = falls.no_control
    assert is_chaotic(falls, near)
    assert not any_state_serves(falls, none, near, np.concatenate([near, 30.0 * near]))
    stays = ClosedLoop(np.eye(N_Z, 3), Cost(N_Z, 1, 40, target=0.6), model=Logistic(3.9))  # type: ignore[arg-type]
    fields = np.random.default_rng(0).uniform(0.2, 0.8, (4, N_Z))
    states = 3.9 * fields * (1.0 - fields)
    assert any_state_serves(stays, stays.no_control, fields, states)


class Escaping(Logistic):
    """z' = r z + (1 - r) z^3, which comes to rest from |z| < 1 and runs away from beyond."""

    def step(self, states: np.ndarray, actions: np.ndarray) -> np.ndarray:
        return self.r * states + (1.0 - self.r) * states**3


def test_a_stable_plant_is_not_chaotic_where_its_model_runs_away_from_some_fields() -> None:
    """As that of a heat exchanger without flow; close to where it does, small changes matter."""
    loop = ClosedLoop(np.eye(N_Z, 3), Cost(N_Z, 1, 40), model=Escaping(0.8))  # type: ignore[arg-type]
    fields = np.array([0.3, 0.4, 0.5, 0.6, 0.998, 1.2])[:, None] * np.ones(N_Z)
    costs = loop.costs(loop.no_control, fields)
    assert np.isinf(costs[-1]) and costs[-2] > 2.0 * costs[:-2].sum()
    assert not is_chaotic(loop, fields)


def test_states_are_taken_from_all_rollouts_and_initial_fields_once_each() -> None:
    rng = np.random.default_rng(1)
    one, two = (rng.normal(size=(21, N_Z)) for _ in range(2))
    records = [Record(np.zeros((1, 6)), 1.0, z, np.zeros((20, 1))) for z in (one, two, one)]
    np.testing.assert_array_equal(initial_fields(records), [one[0], two[0]])
    states = measured_states(records, 5)
    np.testing.assert_array_equal(states[[0, -1]], [one[0], one[-1]])
    assert len(states) == 5 and len(measured_states(records, 1000)) == 63
