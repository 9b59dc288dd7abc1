# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A model with a constant term has the poles of the plant, whatever the zero of its data."""

from __future__ import annotations

import numpy as np
import pytest

import pdeloop

A, B = np.array([[0.95, 0.04], [0.03, 0.9]]), np.array([[0.2], [0.0]])


@pytest.mark.parametrize("offset", [0.0, 20.0, 293.15])
def test_a_regulated_plant_in_kelvins_has_the_poles_of_its_deviations(offset: float) -> None:
    """Regulated about a set point, so that hardly anything but the offset tells the constant."""
    rng = np.random.default_rng(3)
    z, states, actions = np.array([1.0, 0.5]), [], []
    for _ in range(600):
        a = 0.5 - 0.4 * (z[:1] - 1.0) + 0.3 * rng.standard_normal(1)
        states.append(z + offset + 0.002 * rng.standard_normal(2))
        actions.append(a)
        z = A @ z + B @ a
    states.append(z + offset)
    model = pdeloop.identify((np.array(states), np.array(actions)), n_s=2, constant=True)
    found = np.sort(np.linalg.eigvals(model.A).real)
    np.testing.assert_allclose(found, np.sort(np.linalg.eigvals(A).real), atol=0.01)
    rest = np.linalg.solve(np.eye(2) - A, B @ [0.5]) + offset
    s = model.U.T @ rest
    np.testing.assert_allclose(model.A @ s + model.B @ [0.5] + model.d, s, atol=0.01)
