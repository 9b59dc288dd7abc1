# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Chaotic plants: a model is believed on pieces of rollouts, and laws are made from measured states."""

from __future__ import annotations

import numpy as np
import pytest

from pdeloop.method.adapt import model_based
from pdeloop.method.adapt.belief import Belief
from pdeloop.method.models.linear import LinearModel
from tests.method.test_model_based import N_Z, Plant, finished, make, measured
from tests.support.small import same_bits


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
