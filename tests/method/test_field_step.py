# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Steps of Gauss-Newton on a model of the whole field: whole rollouts, or pieces of chaotic ones."""

from __future__ import annotations

import numpy as np
import pytest

from loop_method.adapt import Rollout, field_step
from loop_method.adapt.belief import Belief
from loop_method.adapt.trajectories import Records
from loop_method.models.linear import LinearModel
from tests.support.lifted_plant import N_Z, Plant


def model(plant: Plant) -> LinearModel:
    """The plant itself."""
    U = plant.U
    return LinearModel("linear", U @ plant.A @ U.T, U @ plant.B, np.zeros(N_Z))


def records(plant: Plant, policy: np.ndarray) -> Records:
    found = Records(40, 1e9)
    for seed in range(4):
        found.add(Rollout(policy, seed), plant.run(policy, seed))
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
    found, as_a_whole, noise = field_step.field_model(plant.context(), [], "")
    assert noise == 0.0
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


@pytest.mark.parametrize(("gains", "counts"), [([True], [32]), ([False, True], [32, 96])])
def test_a_step_of_a_chaotic_plant_takes_more_states_before_the_search_ends(
    gains: list[bool], counts: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    """What is better from the states that made it need not be from others."""
    plant = Plant()
    first = 0.6 * plant.best
    data = [record for seed in range(8) for record in records(plant, first * (1 + seed)).all()]
    assert sum(len(record.states) for record in data) > 3 * 96
    seen: list[int] = []

    def step(_: object, theta: np.ndarray, fields: np.ndarray, *__: object) -> object:
        seen.append(len(fields))
        return (theta / 0.6 if gains[len(seen) - 1] else 0.5 * theta), 1.0

    monkeypatch.setattr(field_step, "improved", step)
    belief = Belief(model(plant), 0.0, 1, whole=False)
    proposal = field_step.propose(plant.context(), belief, False, data, first, 1.0)
    assert seen == counts
    assert proposal is not None and proposal.fall > 0.0
    theta = belief.loop(plant.context()).theta
    np.testing.assert_allclose(theta(proposal.policy), theta(plant.best), atol=1e-12)
