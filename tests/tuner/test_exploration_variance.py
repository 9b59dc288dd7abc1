# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""How large explorations are: with noise, so large that the inputs have the error that it promises."""

from __future__ import annotations

import numpy as np
import pytest

from pdeloop.method.reduce.regression import exact_regression
from tests.support.small import parameters
from tuner_node.build import build_training, least_variance


def test_the_variance_for_noise_gives_the_error_of_the_inputs_that_it_promises() -> None:
    """Of every entry of B, relative to its column: sqrt(2 / c), against many noisy experiments."""
    noise, steps, sample_time, width, n_z = 0.05, 200, 0.01, 0.125, 32
    accuracy = 0.05
    variance = least_variance(
        noise=noise,
        steps=steps,
        sample_time=sample_time,
        width=width,
        n_z=n_z,
        accuracy=accuracy,
    )
    # An actuator of that width acts for one step on its share of the grid; the field keeps nearly all.
    support = np.zeros((n_z, 1))
    support[: int(width * n_z)] = 1.0
    A, B = 0.995 * np.eye(n_z), sample_time * support
    rng = np.random.default_rng(7)
    errors = []
    for _ in range(200):
        actions = np.sqrt(variance) * rng.standard_normal((steps, 1))
        states = [np.sin(2.0 * np.pi * np.arange(n_z) / n_z)]
        for a in actions:
            states.append(A @ states[-1] + B @ a)
        measured = np.array(states) + noise * rng.standard_normal((steps + 1, n_z))
        model = exact_regression([(measured, actions)], n_s=2)
        errors.append(model.B[:, 0] - model.U.T @ B[:, 0])
    found = np.sqrt(np.mean(np.square(errors))) / np.linalg.norm(B)
    assert found == pytest.approx(accuracy, rel=0.15)


def test_noise_asks_for_no_exploration_that_bounds_would_clip() -> None:
    """In short steps it asked for so much that every action was at a bound."""
    short, bounds = (
        {"sample_time": 0.005, "exploration_variance": 0.0},
        {"action_bounds": [-1.0] * 4 + [1.0] * 4 + [0.0]},
    )

    def variance(**own: float | list[float]) -> float:
        return build_training(parameters(**short, **own)).settings.exploration_variance

    quiet = variance(**bounds)
    assert variance(**bounds, measurement_noise=0.3) == 4.0 * quiet
    assert variance(measurement_noise=0.3) > 100.0 * quiet
