# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Known plants are recovered from few rollouts, whatever their units, and bad data harm no one."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks.families import equations, plants
from pde_sim_node.equations.random_modes import AllenCahnModes, BurgersModes, KortewegDeVriesModes
from pdeloop.messages.action_set import ActionSet
from pdeloop.method.models import FieldModelSettings, Measured
from pdeloop.method.models.base import errors, samples_of
from pdeloop.method.models.linear import fit_linear
from tests.support.fitted import fit_field_model
from tests.support.plants import plant_of

N_Z, N_A = 64, 4
WAVES = np.arange(N_Z // 2 + 1)


@cache
def explored(equation, sample_time, steps, count, horizon=60, variance=0.1, n_z=N_Z):
    """Explorations of a spectral plant from random modes, and its target."""
    plant = plant_of(
        equation,
        n_z=n_z,
        n_a=N_A,
        width=0.1,
        sample_time=sample_time,
        integration_time=sample_time / steps,
        horizon=horizon,
    )
    found = []
    for seed in range(count):
        states = [plant.reset([seed])[0].copy()]
        actions = np.random.default_rng(seed).normal(size=(horizon, N_A)) * np.sqrt(variance)
        states += [plant.step(a[None])[0].copy() for a in actions]
        found.append(Measured(np.array(states), actions))
    return found, plant.field_target


@cache
def rolled_out(name, count, variance, horizon=80):
    """Explorations of a plant in NumPy, and its target."""
    plant = getattr(plants, name)()
    found = []
    for seed in range(count):
        rng = np.random.default_rng(seed)
        actions = rng.normal(size=(horizon, plant.n_a)) * np.sqrt(variance)
        states = [plant.initial_state(rng)]
        for a in actions:
            states.append(plant.step(states[-1][None], a[None])[0])
        found.append(Measured(np.array(states), actions))
    return found, plant.target


def test_burgers_is_recovered_with_its_coefficients():
    equation = BurgersModes(viscosity=1e-2)
    rollouts, target = explored(equation, 0.05, 20, 3)
    fitted = fit_field_model(rollouts[:2], target)
    assert fitted.error < 1e-5 and [kind for kind, _ in fitted.candidates] == ["linear", "poly2"]
    k = 2 * np.pi * WAVES
    low = slice(1, 8)
    linear, squares = fitted.model.symbols
    np.testing.assert_allclose(linear[low], -0.05 * 1e-2 * k[low] ** 2, rtol=1e-3)
    np.testing.assert_allclose(squares[low], -0.05 * 0.5j * k[low], rtol=1e-3)
    assert errors(fitted.model, rollouts[2:], target, 2.0)[0] < 1e-5
    # The rate of u u_x is in proportion to u: half of the field needs half of the steps.
    whole = fitted.model.substeps
    assert len(fitted.model.fewer) > 1
    largest = max(np.abs(rollout.states).max() for rollout in rollouts[:2])
    for size, steps in fitted.model.fewer:
        assert abs(steps / whole - size / largest) <= 1.5 / whole


@pytest.mark.parametrize(
    "equation, sample_time, steps, kind, error",
    [
        (AllenCahnModes(), 0.01, 1, "poly3", 1e-6),
        (KortewegDeVriesModes(), 0.01, 10, "poly2", 1e-4),
        (equations.Kawahara(), 0.02, 10, "fifth2", 1e-3),
        (equations.BenjaminOno(), 0.05, 5, "nonlocal2", 1e-3),
        (equations.BenjaminBonaMahony(), 0.1, 2, "free2", 1e-5),
        (equations.SineReaction(), 0.02, 1, "poly7", 2e-3),
    ],
    ids=lambda value: getattr(value, "name", None),
)
def test_equations_are_recovered(equation, sample_time, steps, kind, error):
    rollouts, target = explored(equation, sample_time, steps, 5, n_z=128)
    fitted = fit_field_model(rollouts[:3], target)
    assert fitted.model.kind == kind
    assert fitted.error < error
    assert errors(fitted.model, rollouts[4:], target, 2.0)[0] < error  # the fourth is out of range


@pytest.mark.parametrize(
    "name, count, variance, error, degree",
    [
        ("AllenCahnInhomogeneous", 5, 0.1, 1e-2, 3),
        ("BurgersBetweenWalls", 3, 0.1, 1e-3, 3),
        ("FitzHughNagumo", 3, 0.1, 1e-3, 3),
        ("CoupledPendulums", 3, 1.0, 1e-3, 7),
        ("RandomLinear", 3, 0.01, 1e-2, 2),
    ],
)
def test_plants_that_are_no_periodic_equation_are_recovered(name, count, variance, error, degree):
    rollouts, target = rolled_out(name, count, variance)
    few = FieldModelSettings(folds=2, largest_degree=degree)
    fitted = fit_field_model(rollouts[:-1], target, settings=few)
    assert errors(fitted.model, rollouts[-1:], target, 2.0)[0] < error


@cache
def in_own_units():
    """The model that the next test compares with."""
    return fit_field_model(*explored(KortewegDeVriesModes(), 0.01, 10, 2))


@settings(max_examples=8, deadline=None)
@given(st.floats(-6, 6), st.floats(-6, 6))
def test_units_change_neither_the_kind_nor_the_error(of_states, of_actions):
    rollouts, target = explored(KortewegDeVriesModes(), 0.01, 10, 2)
    size, reach = 10.0**of_states, 10.0**of_actions
    scaled = [Measured(size * r.states, reach * r.actions) for r in rollouts]
    before, after = in_own_units(), fit_field_model(scaled, size * target)
    assert after.model.kind == before.model.kind
    assert after.error == pytest.approx(before.error, rel=0.5)


def test_an_input_that_is_never_used_and_a_constant_one_do_no_harm():
    rollouts, target = explored(AllenCahnModes(), 0.01, 1, 2)
    rollouts = [
        replace(r, actions=np.column_stack([r.actions, np.zeros(60), np.full(60, 3.0)]))
        for r in rollouts
    ]
    fitted = fit_field_model(rollouts, target)
    assert fitted.error < 1e-6
    assert np.abs(fitted.model.B[:, -2]).max() < 1e-12 * np.abs(fitted.model.B).max()


def test_samples_that_are_no_numbers_are_left_out():
    rollouts, target = explored(AllenCahnModes(), 0.01, 1, 2)
    spoilt = rollouts[0].states.copy()
    spoilt[50:] = np.nan
    actions = rollouts[1].actions.copy()
    actions[40] = np.inf
    spoilt = [replace(rollouts[0], states=spoilt), replace(rollouts[1], actions=actions)]
    assert fit_field_model(spoilt, target).error < 1e-6


def test_saturated_actions_are_known_by_their_limit():
    rollouts, target = explored(AllenCahnModes(), 0.01, 1, 2)
    beyond = [
        replace(r, actions=r.actions * np.where(np.abs(r.actions) < 0.3, 1, 9)) for r in rollouts
    ]
    limited = [replace(r, actions=np.clip(r.actions, -0.3, 0.3)) for r in beyond]
    found = fit_field_model(beyond, target, action_set=ActionSet(limit=0.3))
    assert found.error == fit_field_model(limited, target).error


@pytest.mark.parametrize("n_z", [5, 9, 17])
def test_odd_and_small_states_can_be_fitted(n_z):
    rng = np.random.default_rng(n_z)
    A = 0.9 * np.linalg.qr(rng.normal(size=(n_z, n_z)))[0]
    rollouts = []
    for _ in range(3):
        actions, states = rng.normal(size=(n_z + 20, 1)), [rng.normal(size=n_z)]
        for a in actions:
            states.append(A @ states[-1] + a)
        rollouts.append(Measured(np.array(states), actions))
    fitted = fit_field_model(rollouts, np.zeros(n_z))
    assert fitted.error < 0.05


@pytest.mark.parametrize("steps", [0, 1, 3, 6, 20])
def test_few_samples_give_no_model_or_one_and_no_traceback(steps):
    rollouts, target = explored(AllenCahnModes(), 0.01, 1, 2)
    short = [Measured(r.states[: steps + 1], r.actions[:steps]) for r in rollouts]
    for data in (short, short[:1], [Measured(r.states[:-1], r.actions) for r in short]):
        fitted = fit_field_model(data, target)
        assert fitted is None or np.isfinite(fitted.error)


def test_data_that_overflow_every_kind_are_no_error():
    rng = np.random.default_rng(0)
    rollouts = [Measured(rng.normal(size=(21, 16)) * 1e200, rng.normal(size=(20, 2)))] * 2
    fitted = fit_field_model(rollouts, np.zeros(16))
    assert fitted is None or fitted.error > 0.5


def test_a_field_that_rests_is_no_error():
    rollouts = [Measured(np.ones((31, 16)), np.zeros((30, 2)))] * 2
    fitted = fit_field_model(rollouts, np.zeros(16))
    assert fitted.error < 1e-6


def test_an_offset_changes_no_linear_model() -> None:
    """Kelvin and degrees Celsius: what a ridge holds at zero is no offset of the data."""
    rng = np.random.default_rng(11)
    A, B = 0.95 * np.eye(3) + 0.02 * rng.standard_normal((3, 3)), 0.3 * rng.standard_normal((3, 2))
    z, actions = [rng.standard_normal(3)], 0.5 + 0.2 * rng.standard_normal((80, 2))
    for a in actions:
        z.append(A @ z[-1] + B @ a)
    states = np.array(z)
    celsius, kelvin = (
        fit_linear(samples_of([Measured(own, actions)]), kind="linear", ridge=1e-4)
        for own in (states, states + 273.15)
    )
    assert celsius is not None and kelvin is not None
    np.testing.assert_allclose(kelvin.A, celsius.A, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(kelvin.B, celsius.B, rtol=1e-6, atol=1e-9)
    moved = kelvin.step(states[:1] + 273.15, actions[:1]) - 273.15
    np.testing.assert_allclose(moved, celsius.step(states[:1], actions[:1]), atol=1e-9)
