# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Rollouts of ordinary differential equations."""

from __future__ import annotations

import numpy as np

from pdeloop.method.models import Measured


def rolled_out(rate, start, force, actions, step, internal):
    """Rollouts of dz/dt = rate(z) + force by the classical Runge-Kutta method.

    start (count, n_z); force (count, steps, n_z), held over each sampling time; actions: what is kept
    with each rollout; internal: its steps of size `step` in a sampling time.
    """
    states, h = [start], step
    for k in range(force.shape[1]):
        z, f = states[-1], force[:, k]
        for _ in range(internal):
            k1 = rate(z) + f
            k2 = rate(z + h / 2 * k1) + f
            k3 = rate(z + h / 2 * k2) + f
            k4 = rate(z + h * k3) + f
            z = z + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        states.append(z)
    return [Measured(z, a) for z, a in zip(np.stack(states, axis=1), actions, strict=True)]
