"""From one exploratory trajectory to a reduced model with its LQ-tracking gains."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from controller_node import dmdc, lqt
from controller_node.policy import ProjectedLaw
from loop_interfaces.model_rows import ModelRows


@dataclass(frozen=True)
class DesignSettings:
    """Actuators, p and n_s of the DMDc, the weights of the stage cost, and where actions saturate.

    The gains are designed without the limit (action_limit, 0: none); only the actions keep it.
    """

    n_a: int
    dmdc_rank: int
    reduced_order: int
    state_weight: float
    action_weight: float
    action_limit: float = 0.0


def design(
    states: NDArray[np.float64],
    actions: NDArray[np.float64],
    target: NDArray[np.float64],
    settings: DesignSettings,
) -> ModelRows:
    """Reduce and design: DMDc on the trajectory, then the LQ-tracking gains.

    states (N+1, n_z), actions (N, n_a), target (n_z,). Raises ValueError with one sentence when the
    data allow no model of this order or the model no stabilising gains.
    """
    model = dmdc.identify(states, actions, p=settings.dmdc_rank, n_s=settings.reduced_order)
    gains = lqt.track(
        model, state_weight=settings.state_weight, action_weight=settings.action_weight
    )
    s_r = ProjectedLaw([model.U], target).reduced_targets[0]
    return ModelRows(A=model.A, B=model.B, U=model.U, K_a=gains.K_a, K_b=gains.K_b, s_r=s_r)
