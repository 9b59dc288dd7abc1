# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The order from held-out data: that of a planted system, and lower where noise hides it."""

from __future__ import annotations

import numpy as np
import pytest

from pdeloop.method.reduce.regression import study_orders
from tests.support.linear_system import linear_system, trajectory

Array = np.ndarray


def planted(noise: float = 0.0, steps: int = 400) -> tuple[Array, Array]:
    """A linear system of order 4 whose states are seen as 12 numbers, the later modes ever weaker."""
    states, actions = trajectory(*linear_system(4), steps=steps)
    rng = np.random.default_rng(7)
    onto = np.linalg.qr(rng.standard_normal((12, 4)))[0] * [1.0, 0.5, 0.25, 0.1]
    seen = states @ onto.T
    return seen + noise * rng.standard_normal(seen.shape), actions


def test_the_order_of_a_planted_system_is_found_and_its_errors_vanish() -> None:
    study = study_orders([planted()])
    assert study.orders.tolist() == [1, 2, 3, 4] and study.suggested == 4
    assert study.one_step[-1] < 1e-9 and study.rollout[-1] < 1e-9
    assert (study.one_step[:-1] > 1e-3).all() and (np.diff(study.one_step) < 0).all()
    assert (study.singular_values[4:] < 1e-9 * study.singular_values[0]).all()


def test_modes_below_the_noise_are_not_suggested() -> None:
    faint, loud = (study_orders([planted(noise)]) for noise in (1e-6, 0.5))
    assert faint.suggested == 4 > loud.suggested
    # What is left of the error of one step is the noise itself, before and after the step.
    clean, _ = planted()
    floor = np.sqrt(2) * 1e-6 * np.sqrt(clean[1:].size) / np.linalg.norm(np.diff(clean, axis=0))
    assert faint.one_step[3] == pytest.approx(floor, rel=0.3)


def test_many_short_trajectories_are_as_good_as_a_long_one() -> None:
    states, actions = planted()
    parts = [(states[k : k + 11], actions[k : k + 10]) for k in range(0, 400, 10)]
    assert study_orders(parts).suggested == 4


def test_orders_are_bounded_by_the_data_and_too_few_steps_are_refused() -> None:
    states, actions = planted(noise=0.1, steps=12)
    assert study_orders([(states, actions)]).orders[-1] <= 9 - 2  # 9 steps are left, for 2 inputs
    with pytest.raises(ValueError, match="3 steps with 2 inputs are too few"):
        study_orders([(states[:4], actions[:3])])
    with pytest.raises(ValueError, match="vary too little"):
        study_orders([(0 * states, actions)])
