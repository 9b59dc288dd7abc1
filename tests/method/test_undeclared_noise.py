# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Measurement noise that nobody declared is found where a model says so, and nowhere else."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import pdeloop
from controller_node.identification import Designed, DesignSettings, designed
from pdeloop.field_report import summary, text
from pdeloop.messages.model_rows import pack
from pdeloop.method.models import Measured
from pdeloop.method.models import selection as of_models
from pdeloop.method.models.noise import noise_level
from pdeloop.method.models.selection import Selection
from tests.support.small import same_bits

N, L = 64, 120
Rollouts = list[tuple[np.ndarray, np.ndarray]]


def waves(seed: int) -> np.ndarray:
    """Waves of few periods that move: a field without noise."""
    rng = np.random.default_rng(seed)
    x, t = np.arange(N) / N, np.arange(L)[:, None] / 20.0
    return sum(
        rng.standard_normal() * np.cos(2 * np.pi * (k * x - 0.1 * k * t) + rng.uniform(0.0, 6.0))
        for k in range(1, 6)
    )


def explored(name: str, **parameters: Any) -> tuple[Rollouts, np.ndarray]:
    """The first two explorations of a problem, and its target."""
    problem = pdeloop.problem(name, **parameters)
    return [problem.explore(seed) for seed in range(2)], problem.plant().target


def found_in(rollouts: Rollouts, target: np.ndarray, declared: float = 0.0) -> float:
    """The noise that is found in rollouts; 0: none."""
    known = [Measured(states, actions) for states, actions in rollouts]
    found = Selection(target=target, noise=declared).undeclared_noise(known)
    return 0.0 if found is None else found.noise


def test_what_is_smooth_or_walks_or_gathers_around_a_front_has_no_level() -> None:
    white = np.random.default_rng(5).standard_normal((L, N))
    rough = np.cumsum(white, axis=0)
    distance = (np.arange(N) - 5 * np.arange(L)[:, None]) % N - N / 2
    near_a_front = white / np.cosh(distance / 4.0)  # which moves by five points a step
    for states in (rough, waves(1), waves(1) + 1e-6 * white, near_a_front, np.zeros((L, N))):
        assert noise_level([states]) == 0.0
    assert noise_level([]) == noise_level([white[:8]]) == noise_level([white[:, :6]]) == 0.0
    assert noise_level([white, np.full((9, N), np.inf)]) == pytest.approx(1.0, rel=0.1)


def test_noise_is_found_within_a_tenth_on_a_known_plant() -> None:
    sigma = 0.05
    plant = {"n_z": 96, "n_a": 6, "horizon": 40}
    rollouts, target = explored("allen-cahn-modes", **plant, measurement_noise=sigma)
    assert found_in(rollouts, target) == pytest.approx(sigma, rel=0.1)
    # Declared nearly right, it is left as it was declared.
    assert found_in(rollouts, target, declared=1.5 * sigma) == 0.0
    assert found_in(rollouts, target, declared=3.0 * sigma) == pytest.approx(sigma, rel=0.1)


def test_a_model_that_predicts_what_noise_would_not_allow_ends_the_search(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Whatever the data look like: with noise that was not declared, nothing is even fitted."""
    white = np.random.default_rng(7).standard_normal((L, N))
    rollout, fits = Measured(white, np.zeros((L - 1, 1))), []
    monkeypatch.setattr(Selection, "fit", lambda own, *_, **__: fits.append(own.noise))
    # All of these states is noise, of which a share of 1 cannot be predicted.
    for error, tried in ((0.45, 0), (0.55, 1)):
        Selection(target=np.zeros(N)).undeclared_noise([rollout], error)
        assert len(fits) == tried
    assert fits[0] == pytest.approx(1.0, rel=0.05)


def test_a_front_that_looks_like_noise_in_its_short_waves_is_none(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """It is narrower than the grid, and moves over several points between two states."""
    rollouts, target = explored("burgers", horizon=40)
    assert noise_level([states for states, _ in rollouts]) == 0.0
    # Nor would an equation for noise of the power of these waves predict better than one without.
    monkeypatch.setattr(of_models, "noise_level", lambda _: 0.025)
    found = Selection(target=target).select([Measured(*rollout) for rollout in rollouts])
    assert found is not None and found.noise == 0.0


def test_noise_that_is_found_is_told_and_makes_no_first_law() -> None:
    """A model of short pieces takes it for the field, and one for noise has the wrong actuators."""
    sigma, plant = 0.05, {"n_z": 96, "n_a": 6, "horizon": 40}
    rollouts, target = explored("allen-cahn-modes", measurement_noise=sigma, **plant)
    few = {"field_model_settings.folds": 2, "field_model_settings.largest_degree": 3}
    values = pdeloop.problem("allen-cahn-modes", **plant, **few).values

    def law(**given: Any) -> Designed:
        settings = DesignSettings.of({**values, "measurement_noise": 0.0, **given})
        return designed(rollouts[:1], target, settings, further=rollouts[1:])

    found = law(identification="field")
    assert found.field is not None and not found.field.better
    assert found.field.noise == summary(found.field)["noise"] == pytest.approx(sigma, rel=0.1)
    told = "\n".join(text(found.field))
    assert f"noise of about {found.field.noise:.2g} was found" in told and "declare it" in told
    assert same_bits(pack(found.rows), pack(law(identification="regression").rows))
    right = law(identification="field", measurement_noise=found.field.noise)
    assert right.field is not None and right.field.noise == 0.0 and right.field.rows is not None
