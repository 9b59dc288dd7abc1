# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A row of the history describes the law that follows, and none that was dropped."""

from __future__ import annotations

from dataclasses import replace

import pytest

from pdeloop.method.adapt import RolloutResult, Trajectory, model_based_sensed
from tests.support.sensed_optimiser import measured, optimiser, told


def _scaled(result: RolloutResult, factor: float) -> RolloutResult:
    """The same rollout, with readings and actions so many times as large."""
    known = result.trajectory
    assert known is not None
    return replace(result, trajectory=Trajectory(factor * known.states, factor * known.actions))


@pytest.mark.parametrize("far", [1.0, 100.0])
def test_where_no_control_follows_the_row_has_no_steps_of_the_law_that_runs_away(
    far: float,
) -> None:
    before, *_ = told()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(model_based_sensed, "sensed_from", lambda *_: None)
        own = optimiser(rollouts=20, judging=3, first=before.policy)
        row = own.tell([_scaled(measured(asked), far) for asked in own.ask()])
    of_the_law = {"fraction", "steps", "predicted_change", "deviation"} & {*row}
    assert of_the_law == ({"steps"} if own.policy.any() else set())
    assert own.policy.any() == (far == 1.0)
    assert {"role", "cost", "model"} <= {*row}  # of the rollouts, and of what reproduces them
