"""Whether the actions of a rollout are those of the law that the tuner publishes the gains of."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from loop_interfaces.model_rows import ModelRows
from loop_interfaces.topics import MAX_GAIN
from tuner_node.optimizers import Rollout, Trajectory

TOLERANCE = 1e-6
"""Relative difference of actions that rounding may explain."""


def follows(
    policy: NDArray[np.float64], model: ModelRows, trajectory: Trajectory, action_limit: float = 0.0
) -> bool:
    """Whether a_k = K_a U^T z_k + K_b s_r all along, saturated at +- action_limit if that is not 0.

    Parameters
    ----------
    policy : (n_a, 2 n_s) array
        [K_a K_b].
    model : ModelRows
        Its U and s_r.
    trajectory : Trajectory
        A rollout under `policy`.
    action_limit : float
        Magnitude at which an action saturates.
    """
    actions = trajectory.actions
    states = trajectory.states[: len(actions)]
    K_a, K_b = np.hsplit(np.clip(policy, -MAX_GAIN, MAX_GAIN), 2)
    with np.errstate(over="ignore", invalid="ignore"):
        law = states @ model.U @ K_a.T + K_b @ model.s_r
    if action_limit > 0.0:
        law = np.clip(law, -action_limit, action_limit)
    scale = max(1.0, float(np.abs(actions).max(initial=0.0)))
    return bool(np.allclose(actions, law, rtol=TOLERANCE, atol=TOLERANCE * scale))


def check_law(
    asked: Sequence[Rollout],
    model: ModelRows,
    seen: Sequence[Trajectory],
    action_limit: float = 0.0,
) -> None:
    """See that rollouts of one model have the actions of the law.

    Raises
    ------
    ValueError
        They have not; the text says what to do.
    """
    for rollout, trajectory in zip(asked, seen, strict=True):
        if not follows(rollout.policy, model, trajectory, action_limit):
            raise ValueError(
                "the actions are not those of the law a = K_a U^T z + K_b U^T z_r, which this "
                "optimizer needs; with a control law of your own use the optimizer 'two_point' "
                "or 'directions'"
            )
