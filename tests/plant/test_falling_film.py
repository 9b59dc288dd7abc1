# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The falling film: its flat solution, conservation of volume, growth of small waves, inputs."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from benchmarks.tasks.falling_film import proportional, seen
from pde_sim_node.plants.falling_film import FallingFilm, fall


def _none(plant: FallingFilm) -> Any:
    return np.zeros((1, plant.n_a))


def test_the_flat_film_stays_flat_without_noise() -> None:
    plant = FallingFilm(noise=0.0, developed=1.0)
    z = plant.mean_state()
    assert np.array_equal(z[:-5], np.ones(2 * plant.points)) and not z[-5:].any()


def test_volume_is_what_flows_in_and_out() -> None:
    """d/dt sum of h = (q_in - q_out) / dx, exactly for the fluxes of the scheme."""
    plant = FallingFilm(jets=1, noise=0.0)
    n = plant.points
    fields = np.ones((2, n))
    x = plant.dx * np.arange(n)
    fields[0] += 0.1 * np.exp(-(((x - 80.0) / 4.0) ** 2))
    before = fields[0].sum()
    fall(fields, plant.shapes, np.zeros(1), np.zeros(1), np.ones(200), plant.dx, 1e-3, plant.delta)
    assert fields[0].sum() == pytest.approx(before, abs=1e-10)
    assert abs(fields[0] - 1.0)[: round(60 / plant.dx)].max() < 1e-6  # nothing has moved upwards
    assert np.abs(fields[1] - 1.0).max() > 0.02


def test_small_waves_grow_and_travel_as_the_linearised_equations_say() -> None:
    """H' = -ik Q and Q' = -6/5 ik (2Q - H) + 2 ((ik)^3 H + 3H - Q) for h, q = 1 + (H, Q) exp(ikx)."""
    errors = []
    for spacing in (0.8, 0.4, 0.2):
        plant = FallingFilm(jets=1, noise=0.0, spacing=spacing)
        n, k = plant.points, 2 * math.pi / 20.0
        ik, pull = 1j * k, 1.0 / (5.0 * plant.delta)
        rates = np.array([[0, -ik], [1.2 * ik + pull * (ik**3 + 3), -2.4 * ik - pull]])
        values, vectors = np.linalg.eig(rates)
        fastest = int(np.argmax(values.real))
        wave = vectors[:, fastest] / vectors[0, fastest]
        x = plant.dx * np.arange(n)
        fields = 1.0 + 1e-4 * np.real(wave[:, None] * np.exp(ik * x))
        grown = values[fastest]
        steps, dt = 100, 1e-3
        fall(fields, plant.shapes, np.zeros(1), np.zeros(1), np.ones(steps), plant.dx, dt, 0.1)
        exact = 1.0 + 1e-4 * np.real(wave[:, None] * np.exp(ik * x + grown * dt * steps))
        error = (fields - exact)[:, n // 3 : n // 2] / 1e-4
        errors.append(float(np.sqrt(np.mean(error**2))))
    assert values[fastest].real > 0 and errors[-1] < 2e-3 and errors[0] / errors[-1] > 3.5, errors


def test_a_positive_action_takes_flow_away_and_acts_at_its_jet_alone() -> None:
    plant = FallingFilm(noise=0.0, developed=0.0)
    z, a = plant.mean_state()[None], np.array([[0.0, 0.5, 0.0, 0.0, 0.0]])
    change = plant.step(z, a)[0, plant.points : 2 * plant.points] - 1.0
    x = plant.dx * np.arange(plant.points)
    assert change.min() < -0.05 and abs(x[np.argmin(change)] - 160.0) < 0.5
    assert np.abs(change[np.abs(x - 160.0) > 4.0]).max() < 1e-4


def test_noise_is_that_of_the_state_and_an_episode_of_its_seed() -> None:
    plant = FallingFilm(developed=0.05)
    first, again, other = (plant.initial_state(np.random.default_rng(s)) for s in (1, 1, 2))
    assert np.array_equal(first, again) and not np.array_equal(first, other)
    pair = np.stack([first, other])
    stepped = plant.step(pair, np.zeros((2, 5)))
    assert np.array_equal(stepped[:1], plant.step(pair[:1], _none(plant)))


def test_a_training_sees_the_flow_rates_before_each_jet_and_behind_the_last() -> None:
    film = FallingFilm()
    z = np.zeros((1, film.n_z))
    z[0, film.points : 2 * film.points] = film.dx * np.arange(film.points)
    q = seen(z)
    assert np.allclose(q[0], np.arange(140, 200))
    assert np.allclose(proportional(2.0, 3)(0, q), 2.0 * (np.arange(147, 197, 10) - 1.0))


def test_unusable_arguments_are_named() -> None:
    with pytest.raises(ValueError, match="jets must be at least 1, got 0"):
        FallingFilm(jets=0)
    with pytest.raises(ValueError, match="spacing must be positive and finite"):
        FallingFilm(spacing=math.nan)
