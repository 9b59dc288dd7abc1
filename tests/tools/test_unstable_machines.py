# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A machine that runs against its stops within ten samples, whatever the exploration."""

from __future__ import annotations

import numpy as np
import pytest

import pdeloop
from pdeloop.messages.action_set import ActionSet
from pdeloop.messages.arrays import Array
from tests.support.small import FEW_STEPS

GRAVITY, MASS, RESISTANCE, INDUCTANCE, FORCE = 9.81, 0.05, 3.0, 0.03, 1.2e-4
CURRENT = float(np.sqrt(MASS * GRAVITY / FORCE)) * 0.01
"""That holds the ball 10 mm below the coil."""


class Levitation(pdeloop.Dynamics):
    """A ball below a coil: gap (mm), speed (m/s), current (A), under 0 to 12 V.

    A deviation grows by 1.25 a sample. The ball rests on a stop at 2 mm or at 20 mm.
    """

    n_z, n_a, horizon, sample_time = 3, 1, 100, 0.005
    action_low, action_high = 0.0, 12.0
    action_target, action_weight = np.array([RESISTANCE * CURRENT]), 0.01
    target, state_weight = np.array([10.0, 0.0, CURRENT]), np.array([1.0, 0.0, 0.0])

    def initial_state(self, rng: np.random.Generator) -> Array:
        return self.target + np.array([0.5, 0.01, 0.02]) * rng.normal(size=3)

    def step(self, z: Array, a: Array) -> Array:
        x, v, i = z
        for _ in range(10):
            pull = FORCE / MASS * (i / (1e-3 * x)) ** 2
            v += 5e-4 * (GRAVITY - pull)
            x += 0.5 * v
            i += 5e-4 * (a[0] - RESISTANCE * i) / INDUCTANCE
            if not 2.0 < x < 20.0:
                x, v = min(max(x, 2.0), 20.0), 0.0
        return np.array([x, v, i])


def test_a_law_keeps_it_at_its_target() -> None:
    """Explorations and first laws tell of the target in their first steps alone."""
    run = pdeloop.train(plant=Levitation(), rollouts=12, evaluation_fields=4, **FEW_STEPS)
    none, first, adapted = (run.costs[name].mean() for name in ("none", "lqt", "adapted"))
    assert none > 50.0 and first > 0.5 * none
    assert adapted < 0.01 * none


def test_explorations_are_around_the_action_of_the_target_as_far_as_bounds_allow() -> None:
    """Voltages of the size of a quarter of half the range would be clipped at 0."""
    law = ActionSet(1, 0.0, 12.0)
    np.testing.assert_array_equal(law.inside(np.array([2.0])), [2.0])
    np.testing.assert_array_equal(law.inside(np.array([0.5])), [3.0])
    around = ActionSet(1, 0.0, 12.0, exploration_mean=[2.0])
    assert np.sqrt(around.exploration_variance) == pytest.approx(1.0)
    middle = ActionSet(1, 0.0, 12.0, exploration_mean=[6.0])
    assert np.sqrt(middle.exploration_variance) == pytest.approx(1.5)
