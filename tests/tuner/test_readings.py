# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Readings that contradict the declared noise, on whatever plant and with whatever optimiser."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from pdeloop.method.adapt import Trajectory
from tests.support.small import parameters
from tuner_node.build import build_training
from tuner_node.results import seeming_noise
from tuner_node.training import Training

L, N = 120, 64


def field(seed: int, rows: int = 1) -> np.ndarray:
    """Long waves that move along rows of N points, of no noise, as states (L, rows N)."""
    rng = np.random.default_rng(seed)
    x, t = np.arange(N) / N, np.arange(L)[:, None] / 20.0
    phases = rng.uniform(0.0, 6.0, (rows, 3))
    waves = [
        sum(np.cos(2 * np.pi * (k + 1) * (x - 0.1 * t) + own[k]) for k in range(3))
        for own in phases
    ]
    return np.hstack(waves)


def training_of(states: np.ndarray, declared: float = 0.0, **settings: Any) -> Training:
    """A training that has measured these states."""
    known = {"n_z": states.shape[1], "measurement_noise": declared, "rollouts": 12}
    training = build_training(parameters(optimizer="model_based", **{**known, **settings}))
    training.explorations = [Trajectory(states, np.zeros((L - 1, 2)))]
    training.target = np.zeros(states.shape[1])
    return training


def noise(states: np.ndarray, sigma: float) -> np.ndarray:
    return states + sigma * np.random.default_rng(9).standard_normal(states.shape)


@pytest.mark.parametrize(
    ("sigma", "declared", "seeming"),
    [
        (0.05, 0.0, 0.05),
        (0.05, 0.015, 0.05),
        (0.05, 0.15, 0.05),
        (0.05, 0.04, 0.0),
        (0.0, 0.0, 0.0),
    ],
)
def test_seem_to_have_the_noise_that_contradicts_the_declared_one(
    sigma: float, declared: float, seeming: float
) -> None:
    training = training_of(noise(field(1), sigma), declared)
    assert seeming_noise(training, 0) == pytest.approx(seeming, rel=0.1)


def test_have_less_noise_than_is_declared_where_there_is_none() -> None:
    assert 0.0 < seeming_noise(training_of(field(1), 0.05), 0) < 0.025


def test_on_several_axes_are_looked_at_along_the_last_one() -> None:
    from dataclasses import replace

    for sigma in (0.0, 0.05):
        training = training_of(noise(field(2, rows=4), sigma))
        training.settings = replace(training.settings, shape=(4, N), line=False)
        assert seeming_noise(training, 0) == pytest.approx(sigma, rel=0.1)


def test_have_no_noise_where_a_model_predicts_them_better_than_that() -> None:
    training = training_of(noise(field(1), 0.05))
    share = 0.05**2 / np.mean(training.explorations[0].states ** 2)
    row = {"event": "adapted", "seed": 0, "rollouts": 9, "model": "poly3"}
    for error, seeming in ((2.0 * share, 0.05), (0.1 * share, 0.0)):
        training.history = [{**row, "mismatch": error}]
        assert seeming_noise(training, 0) == pytest.approx(seeming, rel=0.1)
    training.history = [{**row, "model": "sensed", "mismatch": 0.1 * share}]
    assert seeming_noise(training, 0) == pytest.approx(0.05, rel=0.1)  # of another quantity
    training.history = [{**row, "mismatch": 0.1, "noise": 0.05}]
    assert seeming_noise(training, 0) == 0.0  # it was found, and is told as such


def test_of_sensors_are_the_newest_ones() -> None:
    """Earlier readings of the same sensors follow in a state, and are no other ones."""
    newest = noise(field(3), 0.05)
    older = np.vstack([newest[:1], newest[:-1]])
    sensors = {"n_z": 256, "grid": "", "sensors": N, "sensor_delays": 2}
    training = training_of(np.hstack([newest, older]), **sensors)
    assert seeming_noise(training, 0) == pytest.approx(0.05, rel=0.1)


def test_of_optimisers_that_see_costs_alone_are_not_known() -> None:
    training = build_training(parameters(optimizer="two_point", iterations=1))
    assert seeming_noise(training, 0) == 0.0
