# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The family `process`: what its plants are, and references that know what they should."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import linalg

from benchmarks import general
from benchmarks.families.cases import CASES, PROCESS_CASES
from benchmarks.families.process import PLANTS, Process
from benchmarks.families.references import clipped_law, linearisation, predictive_law
from pdeloop import problem
from pdeloop.episode import rollout
from pdeloop.messages.action_set import ActionSet
from pdeloop.messages.cost import Cost


def test_there_are_at_least_twenty_with_names_of_their_own() -> None:
    assert len(PLANTS) >= 20
    assert not set(PROCESS_CASES) & set(CASES)


@pytest.mark.parametrize("name", PLANTS)
def test_a_step_is_converged_and_keeps_to_its_sizes(name: str) -> None:
    """Half the internal step changes an episode from a random state by less than a hundredth."""
    plant, rng = PLANTS[name](), np.random.default_rng(4)
    low, high = (np.broadcast_to(b, plant.n_a) for b in (plant.action_low, plant.action_high))
    z = first = np.ravel(plant.initial_state(rng))
    assert z.shape == (plant.n_z,)
    actions = [rng.uniform(low, high) for _ in range(5)]
    ends = []
    for substeps in (plant.substeps, 2 * plant.substeps):
        plant.substeps, z = substeps, first
        for a in actions:
            z = plant.step(z, a)
        ends.append(z)
    assert np.isfinite(ends).all()
    assert np.abs(ends[0] - ends[1]).max() < 1e-2 * max(np.abs(ends[1] - first).max(), 0.1)


class Linear(Process):
    """z_{k+1} = z_k + 0.2 (-0.1 z + a + 0.3), exactly up to the order of the step."""

    n_z, n_a, sample_time, action_low, action_high = 1, 1, 0.2, -0.5, 0.5

    def initial_state(self, rng: np.random.Generator) -> np.ndarray:
        return rng.standard_normal(1)

    def rate(self, z: np.ndarray, a: np.ndarray) -> np.ndarray:
        rate: np.ndarray = -0.1 * z + a + 0.3
        return rate


def test_the_references_of_a_linear_plant() -> None:
    """A and B are those of the matrix exponential; without bounds both laws are the same."""
    plant = Linear()
    model = linearisation(plant)
    whole = linalg.expm(0.2 * np.array([[-0.1, 1.0], [0.0, 0.0]]))
    np.testing.assert_allclose([model.A[0, 0], model.B[0, 0]], whole[0], rtol=1e-6)
    np.testing.assert_allclose(model.d[0], 0.3 * model.B[0, 0], rtol=1e-6)
    cost = Cost(1, 1, plant.horizon, state_weight=1.0, action_weight=0.5, target=np.zeros(1))
    states = np.array([[-0.4], [0.0], [0.9], [5.0]])
    free, bound = ActionSet(1), ActionSet(1, -0.5, 0.5)
    affine, planned = clipped_law(model, cost, free), predictive_law(model, cost, free)
    np.testing.assert_allclose(planned(0, states), affine(0, states), rtol=1e-3, atol=1e-4)
    assert predictive_law(model, cost, bound)(0, states)[3, 0] == pytest.approx(-0.5, abs=1e-4)


@pytest.mark.parametrize("name", ["DeadZone", "Building"])
def test_a_plant_is_linearised_where_its_actions_act(name: str) -> None:
    """Else the clipped law costs as much as no control, and says nothing of a training."""
    plant = PLANTS[name]()
    built = problem(plant=plant).plant()
    law = clipped_law(linearisation(plant), built.cost, built.action_set)
    none = np.zeros((2, plant.n_a))
    costs = [
        rollout(built, each, [1, 2], keep=False).costs.mean.mean()
        for each in (law, lambda k, z: none)
    ]
    assert costs[0] < 0.2 * costs[1]


def test_the_family_has_columns_of_its_own() -> None:
    row = {"case": "Furnace", "budget": 20, "seed": 200, "none": 4.0, "lqt": 2.0, "adapted": 1.0}
    head = general.text({"rows": [row | {"lqr": 1.5, "mpc": 1.25}], "bounds": {}}).splitlines()
    assert "LQR of the linearisation | its linear MPC" in head[0] and "limit" not in head[0]
    assert "| 1.5 | 1.25 |" in head[2]
    with pytest.raises(ValueError, match="exact gradients"):
        general.run(family="process", bounds=True)
