# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The equation of a field between a few point sensors, its actuators, and simulations of it."""

from __future__ import annotations

import numpy as np
from threadpoolctl import threadpool_limits

from pdeloop.method.models.base import DEFAULTS
from pdeloop.method.models.sensed import (
    COEFFICIENTS,
    EQUATION,
    FIRST,
    SHARED,
    TERMS,
    SensedEquation,
    grid_points,
    interpolated,
    sensed_model,
    unknowns,
    well_posed,
)
from pdeloop.method.models.sensed_fit import SensedFlow, fit_sensed
from pdeloop.method.models.spectral import SpectralModel
from tests.support.sensed import DECLARED, SENSORS, equally_spaced, readings_of
from tests.support.small import same_bits

Array = np.ndarray


def _step(model: SpectralModel, z: Array, a: Array) -> Array:
    """One state a sampling time later."""
    return model.step(z[None], a[None])[0]


def test_an_action_moves_the_field_as_the_input_matrix_says() -> None:
    shared = np.zeros(unknowns(5))
    shared[: len(FIRST)] = [2.0, 1.0, 1.5, -3.0, 0.2, 0.5, -0.1]
    shared[EQUATION:] = [0.1, 5.0, -1.0, 0.5, 2.0, 1.0, -2.0, 0.0, 0.5, 3.0]
    model = sensed_model(shared, SENSORS, equally_spaced(5), 1.0)
    z, action = np.zeros(len(model.B)), np.array([0.0, 1.0, 0.0, 0.0, -0.5])
    moved = _step(model, z, action) - _step(model, z, 0.0 * action)
    effect = model.B @ action
    assert np.linalg.norm(moved - effect) < 0.05 * np.linalg.norm(effect)


def test_each_actuator_may_be_as_strong_as_it_is() -> None:
    """The second of three is reversed and the third does nothing."""
    actuators, rng = equally_spaced(3), np.random.default_rng(2)
    shared = np.zeros(unknowns(3))
    shared[[TERMS.index((1, 0)), TERMS.index((1, 2)), COEFFICIENTS]] = 1.0, 0.5, 5.0
    shared[SHARED:] = 0.0, -10.0, -5.0
    model = sensed_model(shared, SENSORS, actuators, 4.0)
    x = np.arange(model.n_z) / model.n_z
    actions = 5.0 * rng.standard_normal((2, 20, 3))
    fields = [np.cos(2 * np.pi * x), 0.5 + np.sin(4 * np.pi * x)]
    readings = [readings_of(model, *pair) for pair in zip(actions, fields, strict=True)]
    with threadpool_limits(1):
        found = fit_sensed(readings, list(actions), actuators)
    assert found.error < 1e-4
    strengths = found.shared[COEFFICIENTS] + found.shared[SHARED:]
    np.testing.assert_allclose(strengths, [5.0, -5.0, 0.0], atol=0.3)
    B = sensed_model(found.shared, SENSORS, actuators, 4.0).B
    assert np.linalg.norm(B - model.B) < 0.15 * np.linalg.norm(model.B)


def test_an_equation_that_the_calmest_rollouts_do_not_show_is_found_from_large_inputs() -> None:
    """The calmest ones have only what no equation explains, too small to matter in the others."""
    shared, random = np.zeros(unknowns(3)), np.random.default_rng(0)
    shared[[TERMS.index((1, 2)), TERMS.index((1, 0)), COEFFICIENTS]] = 5.0, 1.0, 5.0
    model = sensed_model(shared, SENSORS, DECLARED, 10.0)
    x = (np.arange(model.n_z) + 0.5) / model.n_z
    actions = random.normal(size=(4, 30, 3)) * np.array([1e-4, 1e-4, 3.0, 1.0])[:, None, None]
    fields = [np.cos(2 * np.pi * (x - shift)) for shift in (0.1, 0.4)]
    readings = [*1e-3 * random.normal(size=(2, 30, SENSORS))]
    readings += [readings_of(model, a, z) for a, z in zip(actions[2:], fields, strict=True)]
    with threadpool_limits(1):
        found = fit_sensed(readings, list(actions), DECLARED)
    assert found.error < 1e-4
    np.testing.assert_allclose(found.fields[2:], fields, atol=0.02)


def test_a_front_that_runs_past_several_points_in_a_sampling_time_is_followed() -> None:
    """Burgers' equation, of which one internal step would be beyond the stability limit."""
    shared = np.zeros(unknowns(1))
    shared[[TERMS.index((1, 2)), TERMS.index((2, 1))]] = 40.0, -125.0
    n, actuators = grid_points(16), equally_spaced(1)
    equation, x = SensedEquation(shared, n, actuators), np.arange(n) / n
    field, largest = 1.0 / np.cosh((x[None] - 0.5) / 0.08), np.ones(1)
    (substeps,) = equation.substeps(largest)
    assert 1 < substeps < 64 and equation.substeps(0.01 * largest) == 1

    def after(substeps: int) -> Array:
        step = equation.compiled(substeps, equation.supports)
        z = step.spectra(field)
        for _ in range(10):
            step.advance(z, np.zeros((1, 2)))
        return step.states(z)

    exact, found = after(64), after(int(substeps))
    assert np.abs(np.diff(exact)).max() > 0.1  # a front
    np.testing.assert_allclose(found, exact, atol=1e-2)


def test_neighbours_of_an_equation_are_simulated_as_each_by_itself() -> None:
    rng = np.random.default_rng(2)
    actuators, n, T, R = equally_spaced(3), grid_points(SENSORS), 6, 2
    shared = rng.standard_normal(unknowns(3))
    shared[len(FIRST) : EQUATION] *= 1e-3  # else nothing stays finite
    fields, actions = 0.3 * rng.standard_normal((2, R, 33)), rng.standard_normal((R, T, 3))
    sizes = np.linspace(3.0, 0.1, T)

    def last(unknowns: Array, fields: Array, varied: list[int]) -> Array:
        flow = SensedFlow(unknowns, n, actuators, sizes, DEFAULTS, 10.0, varied, 0.5)
        found = [z.copy() for z in flow.path(fields, actions, T)]
        return found[-1]

    varied = [i for i in range(len(shared)) if i % 5]
    together = last(shared, fields, varied)
    assert len(together) == len(fields) + len(varied)
    np.testing.assert_array_equal(together[:2], last(shared, fields, []))
    for own, change in zip(together[2:], 0.5 * np.eye(len(shared))[varied], strict=True):
        expected = last(shared - change, fields[:1], [])[0]
        np.testing.assert_allclose(own, expected, rtol=1e-9, atol=1e-9)


def test_readings_are_interpolated_by_the_lowest_wavenumbers() -> None:
    n = grid_points(SENSORS)
    sensors = (np.arange(SENSORS) + 0.5) / SENSORS
    field = interpolated(np.cos(2 * np.pi * sensors) + 0.5)
    np.testing.assert_allclose(field, np.cos(2 * np.pi * np.arange(n) / n) + 0.5, atol=1e-12)


def test_a_fourth_derivative_allows_a_negative_diffusion_and_the_fifth_power_a_positive_third() -> (
    None
):
    shared = np.zeros(unknowns(2))
    for term in ((1, 2), (1, 4), (3, 0), (5, 0)):
        shared[TERMS.index(term)] = 1.0 if term == (3, 0) else -1.0
    assert same_bits(well_posed(shared), shared)
    for highest in ((1, 4), (5, 0)):
        shared[TERMS.index(highest)] = 0.5
    bounded = well_posed(shared)
    assert not bounded.any()


def test_short_waves_that_a_fourth_derivative_damps_need_no_internal_steps() -> None:
    """Phase separation: the waves that follow others would ask for eight times as many."""
    shared, actuators, n = np.zeros(unknowns(1)), equally_spaced(1), grid_points(16)
    for term, value in {(1, 2): -630.0, (1, 4): -31.0, (3, 2): 39.5}.items():
        shared[TERMS.index(term)] = value
    equation, x = SensedEquation(shared, n, actuators), np.arange(n) / n
    (substeps,) = equation.substeps(np.array([4.0]))
    assert 1 < substeps <= 8

    def after(substeps: int) -> Array:
        step = equation.compiled(substeps, equation.supports)
        z = step.spectra(4.0 * np.cos(2 * np.pi * x)[None] + np.sin(14 * np.pi * x))
        for _ in range(20):
            step.advance(z, np.zeros((1, 2)))
        return step.states(z)

    np.testing.assert_allclose(after(int(substeps)), after(64), atol=1e-3)
