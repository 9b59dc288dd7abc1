# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""What measurement noise leaves of a trajectory of few modes."""

from __future__ import annotations

import numpy as np
import pytest

from pdeloop.method.models.noise import denoised

SIGMA = 0.1


@pytest.mark.parametrize("steps", [60, 300])
def test_noise_falls_to_that_of_the_modes(steps: int) -> None:
    rng = np.random.default_rng(0)
    n_z, modes = 100, 3
    field = rng.standard_normal((steps, modes)) @ rng.standard_normal((modes, n_z))
    error = denoised(field + SIGMA * rng.standard_normal(field.shape), SIGMA) - field
    # Of steps n_z entries the modes take modes (steps + n_z) degrees of freedom.
    expected = SIGMA * np.sqrt(modes * (steps + n_z) / (steps * n_z))
    assert np.sqrt(np.mean(error**2)) == pytest.approx(expected, rel=0.1)


def test_noise_alone_vanishes() -> None:
    noise = SIGMA * np.random.default_rng(1).standard_normal((80, 256))
    assert np.linalg.norm(denoised(noise, SIGMA)) < 0.1 * np.linalg.norm(noise)


def test_a_rollout_that_diverged_at_once_stays_empty() -> None:
    assert denoised(np.empty((0, 8)), SIGMA).shape == (0, 8)
