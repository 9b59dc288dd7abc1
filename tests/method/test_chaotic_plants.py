# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Chaotic plants: a model is believed on pieces of rollouts, and laws are made from measured states."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from pdeloop.method.adapt import Context, Trajectory, model_based
from pdeloop.method.adapt.base import Record
from pdeloop.method.adapt.belief import Belief, believe
from pdeloop.method.adapt.improve import ModelBasedSettings
from pdeloop.method.models import FieldModel, FittedModel, Measured
from pdeloop.method.models.base import errors
from pdeloop.method.models.finite_difference import Feature, FiniteDifferenceModel, of_features
from pdeloop.method.models.linear import LinearModel
from pdeloop.method.models.selection import Accuracy, Selection
from tests.method.test_model_based import N_Z, Plant, finished, make, measured
from tests.support.small import same_bits

SETTINGS = ModelBasedSettings()


def lorenz(forcing: float, n_z: int = 12) -> FiniteDifferenceModel:
    """Lorenz-96, chaotic at a forcing of 8, sampled every 0.1."""
    terms = {
        Feature((0, 0), 0, (-1, 1)): 1.0,
        Feature((0, 0), 0, (-2, -1)): -1.0,
        Feature((0,), 0, (0,)): -1.0,
    }
    C = np.tile(0.1 * np.array(list(terms.values()))[:, None, None], (1, 1, n_z))
    B, c = np.eye(n_z)[:, :1], np.full(n_z, 0.1 * forcing)
    return of_features("near-shared", tuple(terms), C, B, c, 8)


def drifting(rate: float, n_z: int = 12) -> LinearModel:
    """Every coordinate grows by a constant: the error of a wrong constant adds up, no faster."""
    return LinearModel("linear", np.eye(n_z), np.eye(n_z)[:, :1], np.full(n_z, rate))


def explored(plant: FieldModel, steps: int = 80) -> list[Record]:
    found = []
    for seed in range(3):
        rng = np.random.default_rng(seed)
        states, actions = [3.0 + rng.normal(size=plant.n_z)], rng.normal(size=(steps, 1))
        for a in actions:
            states.append(plant.step(states[-1][None], a[None])[0])
        found.append(Record(np.zeros((1, 2)), np.inf, np.array(states), actions))
    return found


@pytest.mark.parametrize(
    ("plant", "model", "by_accident", "whole"),
    [
        (lorenz(8.0), lorenz(8.001), lorenz(8.001), False),
        (lorenz(8.0), lorenz(8.001), lorenz(4.0), False),
        (drifting(0.1), drifting(0.5), drifting(0.5), True),
    ],
)
def test_a_model_of_pieces_is_believed_where_small_errors_grow_and_not_where_they_add_up(
    plant: FieldModel,
    model: FieldModel,
    by_accident: FieldModel,
    whole: bool,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Also where another one is the best of whole rollouts, which none predicts."""
    records = explored(plant)
    trajectory = Trajectory(records[0].states, records[0].actions)
    context = Context(np.eye(12)[:, :1], np.zeros(12), 1.0, 1.0, 80, trajectory)

    def judged(self: Selection, rollouts: list[Measured], *_: Any, **__: Any) -> FittedModel | None:
        if not rollouts or len(rollouts[0].actions) not in (
            80,
            10,
        ):  # beginnings near to the target
            return None
        error = float(errors(model, rollouts, self.target, 2.0).mean())
        whole_ones = len(rollouts[0].actions) == 80
        best = by_accident if whole_ones else model
        own = Accuracy(error, error)
        return FittedModel(best, error, [], own, rollouts, self.most)

    monkeypatch.setattr(Selection, "fit", judged)
    found = believe(context, records, SETTINGS.believed)
    assert found is not None and (found.whole, found.accepted) == (whole, not whole)
    assert (found.error <= SETTINGS.believed) == (not whole)
    again = Belief.of(found.state())
    assert again is not None and (again.whole, again.error) == (found.whole, found.error)


def in_pieces(plant: Plant, monkeypatch: pytest.MonkeyPatch) -> None:
    """The plant itself is believed, on pieces alone."""
    model = LinearModel("k", plant.U @ plant.A @ plant.U.T, plant.U @ plant.B, np.zeros(N_Z))
    monkeypatch.setattr(model_based, "believe", lambda *_: Belief(model, 0.01, whole=False))


def test_a_law_is_improved_on_a_model_of_pieces_from_measured_states(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    plant = Plant()
    in_pieces(plant, monkeypatch)
    optimizer, again = make(plant), make(plant)
    rows = [optimizer.tell(measured(plant, optimizer))]
    again.restore(optimizer.state())
    rows += finished(plant, optimizer)
    assert finished(plant, again) == rows[1:] and same_bits(optimizer.policy, again.policy)
    # Of a linear-quadratic problem the law is best from every state.
    assert plant.cost(optimizer.policy) <= 1.01 * plant.cost(plant.best)
    improved = [row for row in rows if "model" in row]
    # A linear plant is not chaotic.
    assert len(improved) == 2 and all(row["pieces"] for row in improved)
    assert not any("chaotic" in row for row in rows)
    assert rows[-1]["chosen"] == "adapted"
