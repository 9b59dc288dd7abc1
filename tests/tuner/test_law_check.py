# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Whether actions are those of a law is told apart from what its memory makes of rounding."""

from __future__ import annotations

import numpy as np
import pytest

from pdeloop.messages.model_rows import ModelRows
from pdeloop.method.adapt import Rollout, Trajectory
from pdeloop.method.laws.linear import Observer
from pdeloop.method.laws.registry import along
from tuner_node.result_checks import check_law

STEPS, N_S = 60, 3


def observer() -> Observer:
    """Its memory p+ = 2.34 p + 0.26 s + a grows by itself, and not with its actions."""
    eye = np.eye(N_S)
    own = {"A": 2.6 * eye, "B": eye, "K_a": -2.4 * eye, "K_b": 0.0 * eye, "L": 0.1 * eye}
    return Observer(ModelRows(U=eye, s_r=np.zeros(N_S), **own), STEPS)


@pytest.fixture(scope="module")
def rolled_out() -> tuple[Observer, Rollout, Trajectory]:
    """As another order of the sums would round it."""
    law, rng = observer(), np.random.default_rng(1)
    states, actions = rng.standard_normal((STEPS, N_S)), np.zeros((STEPS, N_S))
    theta = law.theta_start
    for k in range(STEPS):  # the last of the actions so far depends on those before
        actions[: k + 1] = along(law, (1.0 + 1e-15) * theta, states[: k + 1], actions[: k + 1])
    return law, Rollout(theta, 0), Trajectory(states, actions)


def test_rounding_that_an_unstable_memory_amplifies_is_accepted(
    rolled_out: tuple[Observer, Rollout, Trajectory],
) -> None:
    law, asked, seen = rolled_out
    again = along(law, asked.policy, seen.states, seen.actions)
    assert np.abs(seen.actions).max() < 20.0
    assert np.abs(again - seen.actions).max() > 1e3  # far more than any tolerance
    check_law([asked], law, [seen])


@pytest.mark.parametrize("step", [0, 5])
def test_other_actions_are_not(rolled_out: tuple[Observer, Rollout, Trajectory], step: int) -> None:
    law, asked, seen = rolled_out
    other = seen.actions.copy()
    other[step] *= 1.001
    with pytest.raises(ValueError, match="not those of the law 'observer'"):
        check_law([asked], law, [Trajectory(seen.states, other)])
