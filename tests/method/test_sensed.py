# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A differential equation, its actuators and the fields are found from a few point sensors."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from threadpoolctl import threadpool_limits

import pdeloop
from pdeloop.episode import rollout
from pdeloop.messages.grid import Grid
from pdeloop.method.models.base import DEFAULTS
from pdeloop.method.models.sensed import (
    COEFFICIENTS,
    SHARED,
    TERMS,
    Actuators,
    SensedEquation,
    grid_points,
    interpolated,
    sensed_model,
    unknowns,
)
from pdeloop.method.models.sensed_fit import SENSED_REPRODUCED, fit_sensed
from pdeloop.method.models.spectral import SpectralModel
from tests.support.sensed import DECLARED, PLACES, SENSORS, equally_spaced, places_of, readings_of

Array = np.ndarray
FIELD = 11


def _rollouts(problem: pdeloop.Problem, seed: int) -> tuple[Array, Array, Array, Actuators]:
    """Readings and actions of an exploration and a rollout without control, d, and the actuators."""
    plant = problem.plant()
    explored, actions = problem.explore(seed)
    uncontrolled = rollout(plant, lambda k, y: np.zeros((1, plant.n_a)), [FIELD])
    readings = np.stack([explored[:-1], uncontrolled.states[:-1, 0]])
    positions = problem.values["actuator_positions"]
    actuators = (
        Actuators(np.array(positions), np.zeros(plant.n_a))
        if positions
        else equally_spaced(plant.n_a)
    )
    distance = float(uncontrolled.costs.mean[0]) / (plant.state_weight * readings.shape[2])
    distances = np.array([np.nan, distance])
    return readings, np.stack([actions, uncontrolled.actions[:, 0]]), distances, actuators


def _fitted(problem: pdeloop.Problem, seed: int) -> tuple[SpectralModel, Array, float]:
    """From these two rollouts."""
    readings, actions, _, actuators = _rollouts(problem, seed)
    with threadpool_limits(1):
        noise = problem.values["measurement_noise"] * _scale(problem)
        places = places_of(readings.shape[2])
        found = fit_sensed(list(readings), list(actions), places, actuators, noise)
    model = sensed_model(found.shared, places, actuators, _largest(found.fields))
    return model, found.fields, found.error


def _largest(fields: Array) -> float:
    return float(np.abs(fields).max())


def _step(model: SpectralModel, z: Array, a: Array) -> Array:
    """One state a sampling time later."""
    return model.step(z[None], a[None])[0]


def test_the_cost_of_a_rollout_tells_of_the_field_between_the_sensors() -> None:
    problem = pdeloop.problem("allen-cahn", sensors=SENSORS, horizon=18)
    readings, actions, distances, actuators = _rollouts(problem, 1000)
    target = interpolated(problem.plant().target, PLACES)

    def off(*known: Array) -> float:
        """The relative error of the simulated distance from the target."""
        with threadpool_limits(1):
            found = fit_sensed(list(readings), list(actions), PLACES, actuators, 0.0, None, *known)
        model = sensed_model(found.shared, PLACES, actuators, _largest(found.fields))
        z, squares = found.fields[1], []
        for action in actions[1]:
            squares.append(np.mean((z - target) ** 2))
            z = _step(model, z, action)
        return abs(float(np.mean(squares)) / distances[1] - 1.0)

    told, untold = off(problem.plant().target, distances), off()
    assert told < 0.005 and untold > 3.0 * told


def _scale(problem: pdeloop.Problem) -> float:
    """What the published readings are multiplied by."""
    return float(np.sqrt(problem.values["n_z"] / SENSORS))


def test_the_kdv_equation_is_found_from_eight_sensors() -> None:
    """u_t = -u_xxx + 3 (u^2)_x on a domain of length 20; the soliton is not seen in the beginning."""
    problem = pdeloop.problem("kdv", sensors=SENSORS, horizon=120)
    plant = problem.plant()
    model, fields, error = _fitted(problem, 1000)
    assert error < DEFAULTS.sensed_unresolved**2
    transport, diffusion, dispersion, quadratic = _coefficients(model)
    assert dispersion == pytest.approx(-1 / 20**3, rel=0.03)
    assert quadratic * _scale(problem) == pytest.approx(3 / 20, rel=0.02)
    assert abs(transport) < 2e-3 and abs(diffusion) < 1e-4
    plant.reset([FIELD])
    true = _scale(problem) * plant.states[0, :: plant.n_z // fields.shape[1]]
    assert np.linalg.norm(fields[1] - true) < 0.005 * np.linalg.norm(true)


def test_noise_does_not_hide_the_allen_cahn_equation() -> None:
    """u_t = 0.0025 u_xx + 5 u - 5 u^3 on a domain of length 2."""
    problem = pdeloop.problem("allen-cahn", sensors=SENSORS, horizon=40, measurement_noise=0.03)
    model, _, error = _fitted(problem, 1000)
    assert error < 4e-4  # four standard deviations of the noise in it
    small, none = 1e-3, np.zeros(model.B.shape[1])
    still = _step(model, np.zeros(len(model.B)), none)
    growth = (_step(model, np.full(len(model.B), small), none) - still) / small
    assert np.mean(growth) == pytest.approx(np.exp(0.05), rel=0.015)


def test_actuators_need_not_be_equally_spaced() -> None:
    positions = [0.1, 0.22, 0.55]
    strong = {"actuator_positions": positions, "n_a": 3, "exploration_variance": 4.0}
    problem = pdeloop.problem("allen-cahn", sensors=SENSORS, horizon=12, **strong)
    model, _, error = _fitted(problem, 1000)
    assert error < 1e-4
    x = np.arange(len(model.B)) / len(model.B)
    effect = np.abs(model.B)
    np.testing.assert_allclose(x @ effect / effect.sum(axis=0), positions, atol=0.02)


def _coefficients(model: SpectralModel) -> Array:
    """c_11, c_12, c_13, c_21 per second, of a sampling time of 0.01 s."""
    small, n = 1e-4, len(model.B)
    x = np.arange(n) / n
    none = np.zeros(model.B.shape[1])
    still = _step(model, np.zeros(n), none)

    def effect(z: Array) -> Array:
        """dz/dt in Fourier space."""
        return np.fft.rfft(_step(model, z, none) - still - z) / (0.01 * n / 2)

    one, two = (effect(small * np.cos(2 * np.pi * k * x))[k] / small for k in (1, 2))
    k = 2 * np.pi
    # i k c_1 - k^2 c_2 - i k^3 c_3 at the first two wavenumbers.
    transport, dispersion = np.linalg.solve(
        [[k, -(k**3)], [2 * k, -8 * k**3]], [one.imag, two.imag]
    )
    (diffusion,) = np.linalg.lstsq(np.array([[3 * k**2]]), np.array([one.real - two.real]))[0]
    bent = effect(0.01 * np.cos(k * x))
    quadratic = bent[2].imag / (2 * k * 0.5 * 0.01**2)
    return np.array([transport, diffusion, dispersion, quadratic])


def test_the_burgers_equation_is_found_from_fronts() -> None:
    """u_t = -u u_x + nu u_xx; nu is that of a coarse grid, whose error counts as noise."""
    problem = pdeloop.problem("burgers", sensors=16, horizon=8)
    readings, actions, _, actuators = _rollouts(problem, 1000)
    scale = np.sqrt(problem.plant().n_z / 16)
    with threadpool_limits(1):
        found = fit_sensed(list(readings), list(actions), places_of(16), actuators, 0.03 * scale)
    assert found.error < SENSED_REPRODUCED
    square = SensedEquation(found.shared, grid_points(16), actuators).symbols[1]
    # -1/2 (u^2)_x of readings that are scaled, in a sampling time of 0.05.
    assert square[1].imag == pytest.approx(-0.05 * np.pi / scale, rel=0.15)


def test_noise_does_not_make_short_waves_grow() -> None:
    """The readings are noise: a fit may only take it for fields of a well-posed equation."""
    rng = np.random.default_rng(1)
    readings, actions = rng.standard_normal((1, 8, 4)), rng.standard_normal((1, 8, 2))
    with threadpool_limits(1):
        found = fit_sensed(list(readings), list(actions), places_of(4), equally_spaced(2), 0.5)
    assert found.error > SENSED_REPRODUCED and np.isfinite(found.fields).all()
    shared = found.shared
    assert shared[TERMS.index((1, 4))] <= 0.0
    assert shared[TERMS.index((1, 4))] < 0.0 or shared[TERMS.index((1, 2))] >= 0.0
    growth = SensedEquation(shared, grid_points(4), equally_spaced(2)).symbols[0].real
    assert growth[-2] <= growth[0]


def test_sensors_are_where_they_are_on_the_grid() -> None:
    """Six of 64 points are 10 or 11 spacings apart: a model reads fields there."""
    places = Grid.interval(1.0, 64).equally_spaced(6) / 64
    model = sensed_model(np.zeros(unknowns(3)), places, DECLARED, 4.0)
    waves, x = np.arange(1, 6)[:, None], np.arange(model.n_z) / model.n_z
    weights = np.random.default_rng(0).standard_normal(5)
    field, readings = (weights @ np.cos(2.0 * np.pi * waves * (at - 0.1)) for at in (x, places))
    np.testing.assert_allclose(model.observation @ field, readings, atol=1e-10)
    again = interpolated(readings, places)
    np.testing.assert_allclose(model.observation @ again, readings, atol=1e-10)
    power = np.abs(np.fft.rfft(again)) / model.n_z
    assert power[4:].max() < 1e-12 < power[3]
    equal = sensed_model(np.zeros(unknowns(3)), PLACES, DECLARED, 4.0)
    assert np.array_equal(equal.observation, np.eye(64)[4::8])


def _drawn(
    terms: dict[tuple[int, int], float],
    count: int,
    sigma: float,
    strengths: Sequence[float],
    steps: int = 30,
) -> tuple[list[Array], list[Array], Array]:
    """Readings and actions of rollouts of an equation, and their initial fields."""
    rng, shared = np.random.default_rng(3), np.zeros(unknowns(3))
    for term, value in terms.items():
        shared[TERMS.index(term)] = value
    shared[COEFFICIENTS] = np.mean(strengths)
    shared[SHARED:] = np.array(strengths) - np.mean(strengths)
    model = sensed_model(shared, PLACES, DECLARED, 4.0)
    x, drawn = np.arange(model.n_z) / model.n_z, rng.uniform(-1, 1, (count, 5))
    fields = np.stack(
        [
            2.0 * a * np.cos(2 * np.pi * (x - p)) + c * np.cos(4 * np.pi * (x - d)) + e
            for a, p, c, d, e in drawn
        ]
    )
    actions = list(2.0 * rng.standard_normal((count, steps, 3)))
    seen = [readings_of(model, *pair) for pair in zip(actions, fields, strict=True)]
    return [y + sigma * rng.standard_normal(y.shape) for y in seen], actions, fields


REACTION = {(1, 0): 1.0, (1, 2): 12.0, (2, 1): -2.0, (3, 0): -1.0}


def test_an_equation_is_found_with_its_terms_and_no_other() -> None:
    readings, actions, fields = _drawn(REACTION, 4, 0.0, [10.0] * 3)
    with threadpool_limits(1):
        found = fit_sensed(readings, actions, PLACES, DECLARED)
    used = {TERMS[i]: found.shared[i] for i in np.flatnonzero(found.shared[: len(TERMS)])}
    assert used == pytest.approx(REACTION, rel=0.02)
    np.testing.assert_allclose(found.shared[COEFFICIENTS], 10.0, rtol=0.02)
    assert found.error < 1e-6
    assert np.linalg.norm(found.fields - fields) < 0.01 * np.linalg.norm(fields)


def test_what_readings_do_not_tell_is_as_large_as_in_other_rollouts() -> None:
    """With noise, whose short waves would otherwise be those of the fields."""
    readings, actions, fields = _drawn(REACTION, 4, 0.1, [10.0] * 3)
    with threadpool_limits(1):
        found = fit_sensed(readings, actions, PLACES, DECLARED, 0.1)
    assert found.error < 1e-3
    # Amplitudes of up to 1 and 0.5 at the first two wavenumbers, and nothing beyond them.
    assert found.spread[1] > 0.25 and found.spread[8] < 0.1 * found.spread[1]
    assert np.linalg.norm(found.fields - fields) < 0.15 * np.linalg.norm(fields)
    assert found.noise == pytest.approx(0.1, rel=0.1)
    assert np.std(found.shared[SHARED:]) < 0.1  # of actuators that are equally strong


def test_a_fit_goes_on_from_an_earlier_equation() -> None:
    readings, actions, fields = _drawn(REACTION, 6, 0.1, [10.0] * 3)
    with threadpool_limits(1):
        first = fit_sensed(readings[:4], actions[:4], PLACES, DECLARED, 0.1)
        start = first.shared, first.spread
        found = fit_sensed(readings[2:], actions[2:], PLACES, DECLARED, 0.1, start)
    used = np.flatnonzero(first.shared[: len(TERMS)])
    assert set(np.flatnonzero(found.shared[: len(TERMS)])) <= set(used)
    assert np.linalg.norm(found.fields - fields[2:]) < 0.15 * np.linalg.norm(fields[2:])
    wrong = np.zeros(unknowns(3))
    wrong[[TERMS.index((1, 1)), COEFFICIENTS]] = 25.0, -10.0
    with threadpool_limits(1):
        again = fit_sensed(readings[:4], actions[:4], PLACES, DECLARED, 0.1, (wrong, first.spread))
    # One that cannot be mended is left.
    assert again.error == pytest.approx(first.error, abs=1e-3)


def test_terms_beyond_the_first_ones_are_found_where_these_do_not_suffice() -> None:
    """Kuramoto and Sivashinsky's: long waves grow, short ones are damped by the fourth derivative."""
    equation = {(1, 2): -100.0, (1, 4): -3.0, (2, 1): -10.0}
    readings, actions, _ = _drawn(equation, 3, 0.0, [10.0] * 3, steps=10)
    with threadpool_limits(1):
        found = fit_sensed(readings, actions, PLACES, DECLARED)
    assert found.error < 1e-5
    for term, value in equation.items():
        assert found.shared[TERMS.index(term)] == pytest.approx(value, rel=0.1)
