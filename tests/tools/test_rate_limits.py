# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Actuators that change by so much in a step: every loop keeps to it, and laws are trained for it."""

from __future__ import annotations

import io
import re

import numpy as np
import pytest
from scipy.optimize import minimize

import pdeloop
from controller_node.law_batch import LawBatch, MemoryUnknownError
from controller_node.policy import excitation
from pdeloop.export import law_of
from pdeloop.messages.action_set import ActionSet
from pdeloop.method.laws import Affine
from pdeloop.problem_check import check
from pdeloop.report.places import share_text
from tests.support.small import FEW_FITS
from tests.tools.test_exported_bounds import N_A, N_Z, model

RATE = 0.15
A, B = np.array([[1.0, 0.3], [-0.1, 0.9]]), np.array([[0.0], [0.4]])


class Valve(pdeloop.Dynamics):
    """An oscillator with a valve that takes 13 steps from one end to the other."""

    n_z, n_a, horizon, sample_time = 2, 1, 40, 0.1
    target = (1.0, 0.0)
    action_weight = 0.02
    action_low, action_high, action_rate = 0.0, 2.0, RATE

    def initial_state(self, rng: np.random.Generator) -> np.ndarray:
        return rng.normal((1.0, 0.0), (1.5, 0.5))

    def step(self, z: np.ndarray, a: np.ndarray) -> np.ndarray:
        return A @ z + B @ a


def least_cost(fields: np.ndarray) -> float:
    """That of a law K z + b, by a plain search on the plant, written out again."""

    def cost(theta: np.ndarray) -> float:
        z, a, total = fields, np.ones((len(fields), 1)), 0.0
        for _ in range(Valve.horizon):
            asked = z @ theta[:2, None] + theta[2]
            a = np.clip(np.clip(asked, a - RATE, a + RATE), 0.0, 2.0)
            total += float(np.sum((z - Valve.target) ** 2) + 0.02 * np.sum(a**2))
            z = z @ A.T + a @ B.T
        return total / (Valve.horizon * len(fields))

    starts = ([-0.5, -1.0, 1.0], [-1.0, -3.0, 1.0], [0.0, -1.0, 0.5])
    how = {"method": "Nelder-Mead", "options": {"xatol": 1e-3, "fatol": 1e-4}}
    return min(minimize(cost, x, **how).fun for x in starts)


@pytest.fixture(scope="module")
def run() -> pdeloop.FinishedRun:
    few = {"rollouts": 16, "evaluation_fields": 10, "optimizer_settings.mixtures": 2, **FEW_FITS}
    return pdeloop.train(plant=Valve(), reduced_order=2, **few)


def test_a_training_comes_near_the_best_law_within_the_limits(run: pdeloop.FinishedRun) -> None:
    plant = pdeloop.problem(plant=Valve()).plant()
    fields = plant.reset(run.evaluation[0]).copy()
    least = least_cost(fields)
    adapted = float(np.mean(run.costs["adapted"]))
    assert adapted < 1.05 * least < np.mean(run.costs["lqt"])
    # The costs are those of a plant whose valve is as slow, whatever is asked of it.
    episode = pdeloop.rollout(plant, run.law(), fields)
    np.testing.assert_array_equal(episode.costs.mean, run.costs["adapted"][0])
    np.testing.assert_array_equal(episode.applied, episode.actions)
    same = pdeloop.rollout(
        plant, pdeloop.projected_law(plant, run.models[0].U, run.theta()), fields
    )
    np.testing.assert_array_equal(same.actions, episode.actions)
    for trajectory in run.trajectories():
        moves = np.diff(
            np.concatenate([np.ones_like(trajectory.applied[:1]), trajectory.applied]), axis=0
        )
        assert np.abs(moves).max() <= RATE * (1.0 + 1e-12)


def test_the_plant_holds_what_a_stranger_asks_of_it() -> None:
    plant = pdeloop.problem(plant=Valve()).plant()
    episode = pdeloop.rollout(plant, lambda k, z: np.full((len(z), 1), 9.0 * (k < 20)), [0, 1])
    expected = np.clip(1.0 + RATE * np.r_[np.arange(1, 21)], 0.0, 2.0)
    np.testing.assert_allclose(episode.applied[:20, 0, 0], expected)
    np.testing.assert_allclose(
        episode.applied[20:, 1, 0], np.maximum(2.0 - RATE * np.arange(1, 21), 0)
    )
    plant.reset([0, 1])
    plant.step(np.full((2, 1), 9.0))
    plant.restart(np.array([1]), [3])
    plant.step(np.full((2, 1), 9.0))
    np.testing.assert_allclose(plant.actions[:, 0], [1.0 + 2.0 * RATE, 1.0 + RATE])
    told = next(
        f.text for f in check(pdeloop.problem(plant=Valve()).values) if f.name == "saturation"
    )
    assert re.match(r"\d+ % of the actions of the first law are at a bound or the rate limit", told)
    assert "rate limit" in share_text(episode.applied[:, 0], plant.action_set)
    same = pdeloop.problem("burgers", action_bounds=[*[-1.0] * 6, *[1.0] * 6, 0.0, *[0.25] * 6])
    other = pdeloop.rollout(same.plant(), lambda k, z: np.ones((1, 6)), [0])
    np.testing.assert_allclose(other.applied[:5, 0, 0], [0.25, 0.5, 0.75, 1.0, 1.0])


def test_an_exploration_keeps_to_them_whichever_step_is_asked_first() -> None:
    allowed = ActionSet(3, 0.0, 2.0, rate=[0.1, 0.5, np.inf])
    drawn = np.stack([excitation(7, k, 3, 0.25, allowed) for k in reversed(range(30))])[::-1]
    np.testing.assert_array_equal(allowed.applied(drawn), drawn)
    free = np.stack([excitation(7, k, 3, 0.25, ActionSet(3, 0.0, 2.0)) for k in range(30)])
    np.testing.assert_array_equal(drawn[:, 2], free[:, 2])
    assert 0.2 < drawn[:, 0].max() - drawn[:, 0].min() < 2.9


def test_a_law_knows_its_last_action_or_asks_for_the_episode_again() -> None:
    law, allowed = Affine(model(), 12), ActionSet(N_A, rate=0.1)
    batch = LawBatch([law], np.zeros(N_Z), allowed)
    batch.set(law.theta_start.reshape(1, *law.shape))
    z = np.ones((1, N_Z))
    first = batch.actions(0, z)
    np.testing.assert_array_equal(batch.actions(0, z), first)
    assert np.abs(batch.actions(1, z) - first).max() == pytest.approx(0.1)
    other = LawBatch([law], np.zeros(N_Z), allowed)
    other.set(law.theta_start.reshape(1, *law.shape))
    with pytest.raises(MemoryUnknownError, match="before step 1"):
        other.actions(1, z)


def test_an_archive_has_them_and_what_contradicts_them_is_refused(run: pdeloop.FinishedRun) -> None:
    with np.load(io.BytesIO(law_of(run).npz())) as kept:
        assert kept["action_rate"] == RATE and kept["action_start"] == 1.0
    with pytest.raises(ValueError, match="goes with bounds, not with action_limit"):
        pdeloop.train(plant=Valve(), action_limit=1.0, rollouts=24)
    with pytest.raises(ValueError, match="action_rate must be positive"):
        ActionSet(1, rate=0.0)
