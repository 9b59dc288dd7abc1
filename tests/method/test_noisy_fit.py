# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""An equation from rollouts with measurement noise, against the one that made them."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache

import numpy as np
import pytest

from pdeloop.messages.arrays import Array
from pdeloop.method.models.base import FieldModelSettings, Measured, errors, samples_of
from pdeloop.method.models.noise import denoised, fit_noisy
from pdeloop.method.models.selection import FORMS, with_clean
from pdeloop.method.models.spectral import SpectralModel, fit_spectral
from tests.support.fitted import fit_field_model

POINTS, ACTUATORS, STEPS, NOISE = 64, 4, 60, 0.2
SETTINGS = FieldModelSettings()
CUBIC = next(form for form in FORMS if form.name == "poly3")
TARGET = np.zeros(POINTS)


def reaction_diffusion() -> SpectralModel:
    """u_t = 0.05 u - 0.05 u^3 + nu u_xx + B a, per sampling time, with box actuators."""
    k = np.arange(POINTS // 2 + 1)
    powers = np.zeros((2, len(k)), complex)
    powers[1] = -0.05
    B = np.zeros((POINTS, ACTUATORS))
    for j in range(ACTUATORS):
        B[16 * j + 4 : 16 * j + 12, j] = 0.05
    linear = (0.05 - 4e-4 * k**2).astype(complex)
    return SpectralModel("true", linear, powers, np.eye(2), B, np.zeros(POINTS), 4)


def rollouts_of(
    model: SpectralModel, count: int, noise: float = NOISE
) -> tuple[list[Array], list[Measured]]:
    """States without noise, and rollouts with it, from fields of four random modes."""
    rng, x = np.random.default_rng(0), 2 * np.pi * np.arange(POINTS) / POINTS
    true, measured = [], []
    for _ in range(count):
        z = np.zeros(POINTS)
        for j in range(1, 5):
            z += rng.standard_normal() * np.cos(j * x) + rng.standard_normal() * np.sin(j * x)
        states, actions = [0.5 * z], 2.0 * rng.standard_normal((STEPS, ACTUATORS))
        for a in actions:
            states.append(model.step(states[-1][None], a[None])[0])
        true.append(np.array(states))
        noisy = true[-1] + noise * rng.standard_normal(true[-1].shape)
        measured.append(Measured(noisy, actions))
    return true, measured


@cache
def noisy() -> tuple[list[Array], list[Measured]]:
    """Five of them, made when a test needs them, and not in each worker that collects the tests."""
    return rollouts_of(reaction_diffusion(), 5)


def error_in(model: SpectralModel, states: Sequence[Array]) -> float:
    _, rollouts = noisy()
    exact = [Measured(z, r.actions) for z, r in zip(states, rollouts, strict=True)]
    return float(errors(model, exact, TARGET, 2.0).mean())


def test_noise_leaves_the_equation_right() -> None:
    true, rollouts = noisy()
    known = with_clean(rollouts, NOISE)
    model = fit_noisy(known, CUBIC, SETTINGS, NOISE)
    assert model is not None
    assert error_in(model, true) < 0.02
    # What is fitted as if it were exact is far off: noise is taken for decay.
    naive = fit_spectral(samples_of(rollouts), CUBIC, SETTINGS)
    assert naive is None or error_in(naive, true) > 100 * error_in(model, true)
    low = slice(1, 6)
    assert model.symbols[0, low].real == pytest.approx(
        reaction_diffusion().linear[low].real, abs=8e-3
    )


def test_the_choice_believes_it_and_says_what_noise_does_not_explain() -> None:
    _, rollouts = rollouts_of(reaction_diffusion(), 5, 0.05)
    few = FieldModelSettings(folds=2, largest_degree=3)
    found = fit_field_model(rollouts, TARGET, noise=0.05, settings=few)
    assert found is not None and found.model.kind.startswith("poly")
    assert found.error < 0.01


def test_the_error_of_the_true_model_is_nothing_but_noise() -> None:
    true, rollouts = noisy()
    exact = [Measured(r.states, r.actions, clean=z) for r, z in zip(rollouts, true, strict=True)]
    share = NOISE**2 * sum(r.states.size for r in rollouts)
    share /= sum(float(np.sum(r.states**2)) for r in rollouts)
    assert errors(reaction_diffusion(), exact, TARGET, 2.0).mean() > 0.5 * share
    assert errors(reaction_diffusion(), exact, TARGET, 2.0, NOISE).mean() < 0.05 * share


def test_a_rollout_that_diverged_at_once_stays_empty() -> None:
    assert denoised(np.empty((0, 8)), NOISE).shape == (0, 8)
