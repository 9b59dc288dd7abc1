# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Laws about a target that no rollout comes near to: exact for a quadratic plant, none without data."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.tasks.common import training
from benchmarks.tasks.convection import Admissible
from pde_sim_node.plants import DynamicsPlant
from pdeloop import rollout
from pdeloop.messages.action_set import ANY_ACTION, ActionSet
from pdeloop.messages.cost import Cost
from pdeloop.method.adapt.base import Context, Record, Trajectory
from pdeloop.method.adapt.replay import designed_again, law_about_target
from pdeloop.method.design.lqt import track
from pdeloop.method.reduce.reduced_model import ReducedModel
from tests.support.small import FEW_FITS

A = np.array([[1.1, 0.1], [0.0, 0.8]])
B = np.array([[0.0], [1.0]])
TARGET = np.array([0.3, -0.2])


def _record(
    seed: int, steps: int = 40, size: float = 0.3, limits: ActionSet = ANY_ACTION
) -> Record:
    """x' = A x + B a - 0.1 (x_1^2, 0) about the target, far from it at all times."""
    rng = np.random.default_rng(seed)
    actions = size * rng.standard_normal((steps, 1))
    x = [np.array([2.0, 0.5])]
    for a in limits.applied(actions):
        x.append(A @ x[-1] + B @ a - 0.1 * np.array([x[-1][0] ** 2, 0.0]))
    assert min(np.linalg.norm(own) for own in x) > 0.5
    return Record(np.zeros((1, 4)), np.inf, np.array(x) + TARGET, actions)


def _context(record: Record, **given: object) -> Context:
    explored = Trajectory(record.states, record.actions)
    known = {"U": np.eye(2), "target": TARGET, "state_weight": 1.0, "action_weight": 0.1}
    return Context(**known, horizon=40, exploration=explored, **given)  # type: ignore[arg-type]


def test_the_law_is_that_of_the_plant_linearised_at_the_target() -> None:
    records = [_record(seed) for seed in range(4)]
    found = law_about_target(_context(records[0]), records)
    assert found is not None
    K = track(ReducedModel(A, B, np.eye(2)), state_weight=1.0, action_weight=0.1).K_a
    np.testing.assert_allclose(found[:, :2], K, rtol=0.02)
    assert np.array_equal(found[:, 2:], -found[:, :2])  # none at the target


def test_there_is_no_law_of_few_samples_or_of_another_cost() -> None:
    short = _record(0, steps=5)  # six unknowns
    assert law_about_target(_context(short), [short]) is None
    record = _record(0)
    other = Cost(2, 1, 40, output=np.eye(2)[:1], target=np.zeros(1))
    assert law_about_target(_context(record, cost=other), [record]) is None


def test_a_first_law_that_diverges_is_designed_again_from_what_it_did() -> None:
    """A valve with a dead zone: an exploration within it leaves B unknown, large actions do not."""
    offset = np.array([0.02, 0.01])

    def rolled(size: float) -> Record:
        actions = size * np.random.default_rng(3).standard_normal((60, 1))
        x = [np.array([0.5, 0.2])]
        for a in actions:
            x.append(A @ x[-1] + B @ (np.sign(a) * np.maximum(np.abs(a) - 0.5, 0.0)) + offset)
        return Record(np.zeros((1, 4)), np.inf, np.array(x), actions)

    explored, diverged = rolled(0.3), rolled(50.0)
    known = _context(explored)
    found = designed_again(known, [explored, diverged])
    expected = track(ReducedModel(A, B, np.eye(2), d=offset), state_weight=1.0, action_weight=0.1)
    assert found is not None
    np.testing.assert_allclose(found[:, :2], expected.K_a, rtol=0.02)
    np.testing.assert_allclose(found, expected.policy_for(TARGET), atol=0.1)
    resting = designed_again(replace(known, target=np.zeros(2)), [explored, diverged])
    assert resting is not None and np.array_equal(resting[:, :2], found[:, :2])


@pytest.mark.filterwarnings("ignore::pdeloop.IdentifiabilityWarning")
@pytest.mark.filterwarnings("ignore::pdeloop.TrainingWarning")
def test_a_training_brings_convection_to_rest_from_rollouts_that_begin_with_it() -> None:
    how = {"reduced_order": 20, "exploration_variance": 0.3, "law": "affine", **FEW_FITS}
    how["optimizer_settings"] = {"iterations": 5, "mixtures": 2}
    plant = Admissible(10, steps=60)
    run, spent = training(lambda: plant, 103, 14, **how)
    episode = rollout(DynamicsPlant(plant), run.law(), [0])
    heat = plant.nusselt(episode.states[1:, 0])
    assert spent <= 14 and heat[-10:].mean() < 1.01 and heat.mean() < 1.2, heat
