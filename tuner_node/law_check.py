# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Whether the actions of a rollout are those of the law that the tuner publishes the gains of."""

from collections.abc import Sequence

import numpy as np

from loop_interfaces.model_rows import ModelRows
from loop_interfaces.topics import MAX_GAIN
from loop_method.adapt import Rollout, Trajectory

TOLERANCE = 1e-6
"""Relative difference of actions that rounding may explain."""


def check_law(
    asked: Sequence[Rollout],
    model: ModelRows,
    seen: Sequence[Trajectory | None],
    action_limit: float = 0.0,
) -> None:
    """See that a_k = K_a U^T z_k + K_b s_r all along in rollouts of one model; a ValueError if not.

    asked, seen: the policies, and what was measured under them; action_limit: 0: none.
    """
    for rollout, trajectory in zip(asked, seen, strict=True):
        assert trajectory is not None
        actions = trajectory.actions
        states = trajectory.states[: len(actions)]
        K_a, K_b = np.hsplit(np.clip(rollout.policy, -MAX_GAIN, MAX_GAIN), 2)
        with np.errstate(over="ignore", invalid="ignore"):
            law = states @ model.U @ K_a.T + K_b @ model.s_r
        if action_limit > 0.0:
            law = np.clip(law, -action_limit, action_limit)
        scale = max(1.0, float(np.abs(actions).max(initial=0.0)))
        if not np.allclose(actions, law, rtol=TOLERANCE, atol=TOLERANCE * scale):
            raise ValueError(
                "the actions are not those of the law a = K_a U^T z + K_b U^T z_r, which this "
                "optimizer needs; with a control law of your own use one that learns from costs alone"
            )
