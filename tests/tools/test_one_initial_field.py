# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Where every episode begins alike and nothing is noisy, a second rollout of a law tells nothing."""

from __future__ import annotations

import numpy as np
import pytest

import pdeloop
from pdeloop.messages.arrays import Array
from tests.support.small import FEW_STEPS

FEW = {"evaluation_fields": 2, "identification": "regression", **FEW_STEPS}


class Pendulums(pdeloop.Dynamics):
    """Five coupled pendulums, three of them driven, which are always let go at the same angles."""

    n_z, n_a, horizon, sample_time, action_weight = 10, 3, 80, 0.1, 0.05

    def __init__(self, spread: float = 0.0) -> None:
        self._spread = spread

    def initial_state(self, rng: np.random.Generator) -> Array:
        angles = np.array([2.0, -1.5, 1.0, 0.5, -2.0])
        return np.concatenate([angles + self._spread * rng.standard_normal(5), np.zeros(5)])

    def step(self, z: Array, a: Array) -> Array:
        torque = np.array([a[0], 0.0, a[1], 0.0, a[2]])
        for _ in range(4):
            q, w = z[:5], z[5:]
            pull = np.append(np.diff(q), 0.0) - np.append(0.0, np.diff(q))
            w = w + 0.025 * (2.0 * pull - np.sin(q) - 0.1 * w + torque)
            z = np.concatenate([q + 0.025 * w, w])
        return z


def roles(run: pdeloop.FinishedRun) -> list[int]:
    """Rollouts of the laws, at the end of each update."""
    return [int(row["rollouts"]) for row in run.result["history"] if "role" in row]


def test_each_law_is_rolled_out_once_and_it_ends_where_laws_about_the_target_gain_nothing() -> None:
    """They follow laws of models that gain nothing more; what is left then is told."""
    run = pdeloop.train(plant=Pendulums(), seed=0, rollouts=20, evaluation_fields=2)
    known = roles(run)
    assert known[0] == 4  # two explorations, and two of the first law, which are the same
    assert set(np.diff(known[:-1])) == {1}
    assert run.rollouts[0]["total"] == known[-1] <= 20
    assert known[-1] == 20 or "laws gained nothing" in run.result["history"][-1]["early"]
    reasons = [str(row.get("reason", "")) for row in run.result["history"]]
    assert any("a law about the target follows" in reason for reason in reasons)
    first, adapted = (float(run.costs[name].mean()) for name in ("lqt", "adapted"))
    assert adapted <= first and adapted < 7.66


class Weighted(Pendulums):
    """With other weights of angles and velocities."""

    state_weight = np.repeat([1.0, 0.5], 5)


class Short(Pendulums):
    """For half a swing."""

    horizon = 25


class Moving(Pendulums):
    """To other angles half-way through, for which there is no law about the target."""

    target = np.outer(np.arange(80) >= 40, np.repeat([0.2, 0.0], 5))


def test_other_weights_leave_no_rollout_either() -> None:
    run = pdeloop.train(plant=Weighted(), seed=0, rollouts=14, **FEW)
    assert run.rollouts[0]["total"] == 14
    reasons = [str(row.get("reason", "")) for row in run.result["history"]]
    assert any("a law about the target follows" in reason for reason in reasons)


def test_it_ends_where_no_other_law_is_to_be_tried() -> None:
    with pytest.warns(pdeloop.TrainingWarning, match="every episode begins alike"):
        run = pdeloop.train(plant=Moving(), seed=0, rollouts=20, **FEW)
    assert run.rollouts[0]["total"] == roles(run)[-1] < 20


def test_fields_that_differ_or_noise_are_rolled_out_as_ever() -> None:
    for plant, settings, first in (
        (Short(0.1), {}, 5),
        (Short(), {"process_noise": 1e-3}, 4),  # two of the first law, which differ
    ):
        run = pdeloop.train(plant=plant, seed=0, rollouts=8, **FEW, **settings)
        assert roles(run)[0] == first
        assert run.rollouts[0]["total"] == 8
