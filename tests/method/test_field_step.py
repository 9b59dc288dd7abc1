# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Steps of Gauss-Newton on a model of the whole field: whole rollouts, or pieces of chaotic ones."""

from __future__ import annotations

import numpy as np
import pytest

from loop_method.adapt import field_step
from loop_method.adapt.belief import Belief
from loop_method.adapt.trajectories import Records
from loop_method.models.linear import LinearModel
from tests.method.test_gauss_newton import N_Z, Plant


def model(plant: Plant) -> LinearModel:
    """The plant itself."""
    U = plant.U
    return LinearModel("linear", U @ plant.A @ U.T, U @ plant.B, np.zeros(N_Z))


def records(plant: Plant, policy: np.ndarray) -> Records:
    found = Records(40, 1e9)
    for seed in range(4):
        found.add(policy, plant.run(policy, seed), set())
    return found


@pytest.mark.parametrize(
    ("whole", "parts", "believed"),
    [(0.01, 0.0, "whole"), (0.5, 1e-3, "parts"), (0.5, 0.04, None), (0.5, 0.2, None)],
)
def test_a_plant_that_forgets_is_told_from_one_that_is_disturbed(
    whole: float, parts: float, believed: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The error of chaos grows from piece to piece, while that of disturbances adds up."""
    plant = Plant()
    errors = {1: whole, 8: parts}
    monkeypatch.setattr(
        field_step, "believe", lambda _, __, ___, pieces=1: Belief(model(plant), errors[pieces], 1)
    )
    found, as_a_whole = field_step.field_model(plant.context(), [], "")
    assert as_a_whole == (believed == "whole")
    assert (found and found.error) == (None if believed is None else errors[8 - 7 * as_a_whole])


@pytest.mark.parametrize("whole", [True, False])
def test_a_law_is_improved_on_the_model_until_that_gains_nothing(whole: bool) -> None:
    plant = Plant()
    policy = first = 0.6 * plant.best
    data = records(plant, policy).all()
    belief = Belief(model(plant), 0.0, 1)
    falls = []
    for _ in range(20):
        proposal = field_step.propose(plant.context(), belief, whole, data, policy, 1e-3)
        if proposal is None or proposal.fall < 1e-3:
            break
        assert proposal.kind == proposal.believed == "linear"
        falls.append(proposal.fall)
        policy = proposal.policy
    else:
        pytest.fail("it never ends")
    assert falls
    # Of a linear-quadratic problem the law is best from every field.
    cost, best = (plant.run(law, 99).cost for law in (policy, plant.best))
    assert cost < 1.05 * best < plant.run(first, 99).cost
