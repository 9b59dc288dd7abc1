# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The polynomial model: products of state and action, units, noise, and a state that rests."""

from __future__ import annotations

import numpy as np
import pytest

from pdeloop.method.models import Measured
from pdeloop.method.models.polynomial import PolynomialModel, fit_polynomial
from tests.support.fitted import fit_field_model

N_Z, N_A, T = 5, 2, 60


def cooled_cell(units: np.ndarray | float = 1.0, rollouts: int = 6) -> list[Measured]:
    """A cell that a current heats with I^2, cooled by a flow that carries its temperature."""
    rng = np.random.default_rng(3)
    A = 0.9 * np.eye(N_Z) + 0.05 * np.eye(N_Z, k=1)
    found = []
    for _ in range(rollouts):
        z = rng.normal(size=N_Z)
        states, actions = [z], 0.7 * rng.normal(size=(T, N_A))
        for current, flow in actions:
            z = A @ z
            z[0] += 0.1 * current
            z[-1] += 0.2 * current**2 - 0.1 * flow * states[-1][-1] - 0.02 * states[-1][0] ** 2
            states.append(z)
        found.append(Measured(np.array(states) * units, actions))
    return found


def fitted(units: np.ndarray | float = 1.0) -> PolynomialModel:
    model = fit_polynomial(cooled_cell(units))
    assert model is not None
    return model


def test_products_of_state_and_action_are_found_and_linear_models_are_not_enough() -> None:
    rollouts = cooled_cell()
    model, new = fitted(), cooled_cell(rollouts=9)[-1]
    change = new.states[1:] - new.states[:-1]
    missed = model.step(new.states[:-1], new.actions) - new.states[1:]
    assert np.sum(missed**2) < 1e-6 * np.sum(change**2)
    chosen = fit_field_model(rollouts, np.zeros(N_Z), line=False)
    assert chosen is not None and chosen.error < 1e-3
    assert dict(chosen.candidates)["linear"] > 0.02


def test_noise_explains_no_more_of_an_error_than_it_is_worth() -> None:
    """A tank that a valve empties: linear but for the product, which noise of 0.2 % does not hide."""
    rng, noise = np.random.default_rng(6), 0.01
    L = np.eye(8, k=1) + np.eye(8, k=-1) - np.diag([1, 2, 2, 2, 2, 2, 2, 1])
    rollouts = []
    for _ in range(8):
        z = 5.0 + rng.normal() + 0.3 * rng.normal(size=8)
        states, actions = [z], rng.uniform(size=(T, 2))
        for heat, valve in actions:
            z = z + 0.1 * L @ z + 0.3 * heat - 0.2 * valve * z
            states.append(z)
        measured = np.array(states) + noise * rng.normal(size=(T + 1, 8))
        rollouts.append(Measured(measured, actions))
    found = fit_field_model(rollouts, np.full(8, 3.0), noise=noise, line=False)
    assert found is not None and found.model.kind == "polynomial"
    assert 0.01 < dict(found.candidates)["linear"] < 0.05  # enough where noise is large
    z, a = np.full((1, 8), 4.0), np.array([[0.0, 1.0]])
    np.testing.assert_allclose(found.model.step(z, a) - z, -0.2 * z, rtol=0.1)


def test_units_change_nothing() -> None:
    units = np.array([1.0, 1e3, 1e-3, 50.0, 273.0])
    plain, scaled = fitted(), fitted(units)
    rng = np.random.default_rng(0)
    z, a = rng.normal(size=(4, N_Z)), rng.normal(size=(4, N_A))
    np.testing.assert_allclose(scaled.step(z * units, a), plain.step(z, a) * units, rtol=1e-6)


@pytest.mark.filterwarnings("error")
def test_a_state_that_rests_is_predicted_to_rest() -> None:
    """At a stop nothing moves: there are no modes to take the mean of."""
    rest, actions = np.full((81, 3), 2.0), np.random.default_rng(0).standard_normal((80, 1))
    model = fit_polynomial([Measured(rest, actions)])
    assert model is not None
    np.testing.assert_array_equal(model.step(rest[1:], actions), rest[1:])
