# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Logs of short steps, with noise or fewer readings than states, give the poles of the plant."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy import linalg

from pdeloop.data_file import Measurements
from pdeloop.identification import identify_data
from pdeloop.identified import Identified


def log(
    order: int, over: float, noise: float, *, readings: int = 1, hold: int = 1
) -> tuple[np.ndarray, Measurements]:
    """A, and 600 rows of a cascade of lags of which the slowest takes `over` rows, about 20."""
    rates, rng = -np.geomspace(1.0, 2.0, order) / over, np.random.default_rng(0)
    F = np.diag(rates) - np.diag(rates[:-1], 1)
    whole = linalg.expm(
        np.block([[F, -2.0 * rates[-1:] * np.eye(order)[:, -1:]], [np.zeros((1, order + 1))]])
    )
    A, B = whole[:order, :order], whole[:order, order:]
    u = np.repeat(rng.uniform(-1.0, 1.0, 600 // hold), hold)[:, None]
    x = np.zeros((601, order))
    for k in range(600):
        x[k + 1] = A @ x[k] + B @ u[k]
    z = x[:, :readings]
    z = 20.0 + z + noise * z.std(axis=0) * rng.standard_normal(z.shape)
    return A, Measurements([(z, u + 50.0)], None, 1.0, sources=[{"trajectory": 0}])


def poles(found: Identified) -> np.ndarray:
    return np.sort(np.linalg.eigvals(found.model.A).real)


def told(found: Identified, text: str) -> bool:
    return any(text in warning for warning in found.warnings)


def test_noise_does_not_draw_the_poles_of_short_steps_to_0() -> None:
    A, data = log(2, 20.0, 0.1, hold=20)
    found, slowest = identify_data(data, {}), np.abs(np.linalg.eigvals(A)).max()
    assert found.pole[0] == pytest.approx(slowest, abs=0.004)
    assert told(found, ", a model in innovation form ")
    given: dict[str, Any] = {"identification": "regression"}
    asked = identify_data(data, given)
    assert abs(asked.pole[0] - slowest) > 0.008
    assert told(asked, "the poles are hardly the plant's: ")


def test_a_log_without_noise_is_exact_with_all_states_and_with_one() -> None:
    A, data = log(3, 6.0, 0.0, readings=3)
    found = identify_data(data, {})
    assert found.innovations is None and not told(found, "innovation")
    np.testing.assert_allclose(poles(found), np.sort(np.linalg.eigvals(A).real), atol=1e-9)
    A, data = log(2, 6.0, 0.0)
    one = identify_data(data, {})
    assert one.innovations is not None
    np.testing.assert_allclose(poles(one)[-2:], np.sort(np.linalg.eigvals(A).real), atol=1e-5)


def test_a_white_input_of_which_one_reading_shows_a_slow_effect_has_one() -> None:
    A, data = log(3, 16.0, 0.05)
    found = identify_data(data, {})
    assert found.pole[0] == pytest.approx(np.abs(np.linalg.eigvals(A)).max(), abs=0.02)


@pytest.mark.parametrize("target", [None, np.array([25.0, 25.0, 25.0])])
def test_a_stable_machine_at_ambient_temperature_has_its_five_poles(
    target: np.ndarray | None,
) -> None:
    """Five hidden states, three thermocouples with 0.05 K of noise, two heaters of up to 5 kW."""
    rng, poles = np.random.default_rng(5), [0.3, 0.6, 0.85, 0.93, 0.97]
    by = np.diag(poles[::-1])
    by[0, 1], by[1, 2] = 0.1, 0.08
    B, C = 0.3 * rng.standard_normal((5, 2)), rng.standard_normal((3, 5))
    u, x, y = np.repeat(rng.uniform(0.0, 5.0, (120, 2)), 5, 0), np.zeros(5), np.empty((600, 3))
    for k in range(600):
        y[k] = C @ x + 0.05 * rng.standard_normal(3) + [20.0, 21.0, 22.0]
        x = by @ x + B @ u[k] + 0.01 * rng.standard_normal(5)
    found = identify_data(Measurements([(y, u[:-1])], target, 1.0), {})
    np.testing.assert_allclose(np.sort(np.abs(found.poles)), poles, atol=0.01)
    assert found.pole[1] < 0.97 < found.pole[2] < 1.0 and max(found.uncertain) < 0.02
