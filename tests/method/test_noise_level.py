# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Noise that nobody declared is found in states, and a plant's own motion is not taken for it."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import pdeloop
from loop_method.models.noise_level import noise_level
from pdeloop.in_process import LocalPair, train
from tuner_node.build import build_training
from tuner_node.narration import warnings
from tuner_node.optimizer_context import undeclared_noise
from tuner_node.results import summarise

N, L = 64, 120


def smooth(seed: int) -> np.ndarray:
    """Waves of few periods that turn: a field without noise."""
    rng = np.random.default_rng(seed)
    x, t = np.arange(N) / N, np.arange(L)[:, None] / 20.0
    waves = (
        rng.standard_normal() * np.cos(2 * np.pi * (k * x - 0.1 * k * t) + rng.uniform(0.0, 6.0))
        for k in range(1, 6)
    )
    return np.asarray(sum(waves))


@pytest.mark.parametrize("sigma", [0.01, 0.1, 1.0])
def test_the_level_of_white_noise_is_found(sigma: float) -> None:
    rng = np.random.default_rng(1)
    noisy = [smooth(i) + sigma * rng.standard_normal((L, N)) for i in range(2)]
    assert noise_level(noisy) == pytest.approx(sigma, rel=0.05)


def test_what_is_not_white_is_no_noise() -> None:
    rng = np.random.default_rng(2)
    white = rng.standard_normal((L, N))
    slow = np.cumsum(white, axis=0)  # a random walk: the field itself changes at random
    k = np.arange(N // 2 + 1)
    rough = np.fft.irfft(np.fft.rfft(white, axis=1) / (1.0 + k), n=N, axis=1)  # as after a jump
    for states in (smooth(1), slow, rough, smooth(1) + 1e-6 * white, np.zeros((L, N))):
        assert noise_level([states, states[::-1]]) == 0.0


def test_too_few_numbers_and_states_that_diverged_say_nothing() -> None:
    white = np.random.default_rng(3).standard_normal((L, N))
    assert noise_level([]) == noise_level([white[:20]]) == noise_level([white[:, :8]]) == 0.0
    assert noise_level([white, np.full((9, N), np.inf)]) == pytest.approx(1.0, rel=0.05)


@pytest.mark.parametrize("name", ["allen-cahn-modes", "burgers", "kdv", "kuramoto-sivashinsky-22"])
def test_explorations_of_plants_without_noise_show_none(name: str) -> None:
    """Their short waves are forced at random, and one of them is chaotic."""
    problem = pdeloop.problem(name)
    assert noise_level([problem.explore(seed)[0] for seed in range(2)]) == 0.0


def test_a_training_with_noise_that_was_not_declared_accounts_for_it_and_says_so() -> None:
    sigma, size = 0.05, {"n_z": 64, "horizon": 40, "evaluation_fields": 1, "rollouts": 6}
    given: dict[str, Any] = {"measurement_noise": sigma, **size}
    problem = pdeloop.problem("allen-cahn-modes", **given)
    training = build_training({**problem.values, "measurement_noise": 0.0})
    train(training, LocalPair(problem.values), lambda row: None)
    (optimizer,), summary = training.optimizers, summarise(training)
    noise = optimizer._context.noise
    assert noise == pytest.approx(sigma, rel=0.05) and summary["undeclared_noise"] == [noise]
    (said,) = (text for text in warnings(summary) if "measurement_noise is 0" in text)
    assert "deviation 0.05" in said
    known = training.explorations[0], *training.further[0]
    assert undeclared_noise(replace(training.settings, noise=True), known) == 0.0
