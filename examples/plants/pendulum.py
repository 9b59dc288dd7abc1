# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Gymnasium's pendulum as a plant: its observation is (cos, sin, speed), one torque acts on it."""

import pdeloop


def upright(horizon: int = 60):
    """To be held upright: the cost is quadratic about the observation (1, 0, 0)."""
    return pdeloop.from_gymnasium(
        "Pendulum-v1", target=[1.0, 0.0, 0.0], action_weight=0.01, horizon=horizon, sample_time=0.05
    )


def rewarded(horizon: int = 60):
    """The cost is minus the environment's own reward."""
    return pdeloop.from_gymnasium("Pendulum-v1", horizon=horizon, sample_time=0.05)
