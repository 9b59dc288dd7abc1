# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Coefficients that depend on x, of an equation of which a few points are measured."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from threadpoolctl import threadpool_limits

from pdeloop.messages.arrays import Array
from pdeloop.method.models.base import DEFAULTS
from pdeloop.method.models.sensed import (
    COEFFICIENTS,
    EQUATION,
    TERMS,
    VARIATIONS,
    SensedModel,
    sensed_model,
    unknowns,
)
from pdeloop.method.models.sensed_fit import Fitted, fit_sensed
from tests.support.sensed import DECLARED, PLACES, readings_of

VARYING = {
    (1, 0, 2, True): 3.0,
    (1, 1, 1, True): 0.5,
    (1, 2, 1, False): 9.0,
    (1, 2, 2, True): -1.0,
    (2, 0, 1, True): -0.5,
    (3, 0, 1, False): -0.4,
}
"""p, j, wave and whether it is a sine, of the unknowns that are not zero, in their units."""


def _unknowns(varying: dict[tuple[int, int, int, bool], float]) -> Array:
    """u_t = (D(x) u_x)_x + r(x) u - u^3 and more, driven by three actuators."""
    shared = np.zeros(unknowns(3))
    for term, value in {(1, 0): 1.0, (1, 2): 12.0, (2, 1): -2.0, (3, 0): -1.0}.items():
        shared[TERMS.index(term)] = value
    for variation, value in varying.items():
        shared[len(TERMS) + VARIATIONS.index(variation)] = value
    shared[COEFFICIENTS] = 10.0
    return shared


def _model(varying: dict[tuple[int, int, int, bool], float]) -> SensedModel:
    return sensed_model(_unknowns(varying), PLACES, DECLARED, 4.0)


def _batch(model: SensedModel) -> tuple[Array, Array]:
    """Fields and actions of two rows."""
    x = np.arange(model.n_z) / model.n_z
    fields = [np.cos(2 * np.pi * x) - 0.5 * np.sin(6 * np.pi * x), 0.8 + np.sin(4 * np.pi * x)]
    return np.stack(fields), np.array([[1.0, 0.0, -2.0], [0.5, 1.5, 0.0]])


def _rate(model: SensedModel, z: Array, a: Array) -> Array:
    """dz/dt with d(D dz/dx)/dx as it is written, on a grid that has room for the products."""
    n, fine = model.n_z, 4 * model.n_z
    k = 2j * np.pi * np.arange(fine // 2 + 1)
    x = 2 * np.pi * np.arange(fine) / fine

    def along(u: Array) -> Array:
        return np.fft.irfft(k * np.fft.rfft(u), fine)

    u = np.fft.irfft(4 * np.fft.rfft(z), fine)
    wave = 2 * np.pi * 8
    rate = 0.01 * (u - 2.0 / wave * along(u**2) - u**3) + 0.12 / wave**2 * along(along(u))
    for (p, j, m, sine), size in VARYING.items():
        own = 0.01 / wave**j * size * (np.sin(m * x) if sine else np.cos(m * x))
        rate += own * u**p if j == 0 else along(own * (u if j == 1 else along(u)))
    spectrum = np.fft.rfft(rate)[: n // 2 + 1] / 4
    return np.fft.irfft(spectrum, n) + model.B @ a


def test_a_step_is_that_of_the_equation_as_it_is_written() -> None:
    model = replace(_model(VARYING), substeps=16, fewer=np.empty((0, 2)))
    fields, actions = _batch(model)
    for z, a, found in zip(fields, actions, model.step(fields, actions), strict=True):
        exact = solve_ivp(lambda _, z, a=a: _rate(model, z, a), (0, 1), z, rtol=1e-9, atol=1e-10)
        resolved = [np.fft.rfft(u)[:-4] / model.n_z for u in (found, exact.y[:, -1])]
        np.testing.assert_allclose(*resolved, atol=1e-6)
        assert np.abs(found - _model({}).step(z[None], a[None])[0]).max() > 0.02


def test_the_internal_steps_follow_them() -> None:
    model = _model(VARYING)
    fine = replace(model, substeps=8 * model.substeps, fewer=np.empty((0, 2)))
    fields, actions = _batch(model)
    for scale in (0.05, 1.0):  # small fields have fewer steps
        exact = fine.step(scale * fields, actions)
        np.testing.assert_allclose(model.step(scale * fields, actions), exact, atol=2e-3)
    varying, plain = (sensed_model(_unknowns(v), PLACES, DECLARED, 20.0) for v in (VARYING, {}))
    assert varying.substeps > plain.substeps
    assert varying.fewer[0, 1] > plain.fewer[0, 1] == 1


@pytest.mark.parametrize("largest", [-5.0, np.inf, np.nan])
def test_a_size_that_is_none_leaves_steps_that_can_be_made(largest: float) -> None:
    """Compiled code has no room for fewer than one."""
    shared = _unknowns({(2, 0, 1, True): 50.0, (1, 2, 1, True): 9.0})
    with np.errstate(all="ignore"):
        model = sensed_model(shared, PLACES, DECLARED, largest)
    assert 1 <= model.substeps <= DEFAULTS.substeps
    assert np.isfinite(model.step(*(0.1 * rows for rows in _batch(model)))).all()
    with pytest.raises(ValueError, match="at least 1 internal step"):
        replace(model, substeps=0, fewer=np.empty((0, 2))).step(*_batch(model))


def _fitted(varying: dict[tuple[int, int, int, bool], float], count: int, sigma: float) -> Fitted:
    """From readings of as many rollouts."""
    model, rng = _model(varying), np.random.default_rng(4)
    x = np.arange(model.n_z) / model.n_z
    drawn = rng.uniform(-1, 1, (count, 5))
    actions = 2.0 * rng.standard_normal((count, 30, 3))
    fields = [
        2.0 * a * np.cos(2 * np.pi * (x - b)) + c * np.cos(4 * np.pi * (x - d)) + e
        for a, b, c, d, e in drawn
    ]
    readings = np.stack([readings_of(model, *pair) for pair in zip(actions, fields, strict=True)])
    readings += sigma * rng.standard_normal(readings.shape)
    with threadpool_limits(1):
        return fit_sensed(list(readings), list(actions), PLACES, DECLARED, sigma)


def test_they_are_found_where_constant_ones_do_not_suffice() -> None:
    """Diffusion and growth that depend on x."""
    varying = {(1, 0, 2, True): 20.0, (1, 2, 1, False): 11.0}
    found = _fitted(varying, 2, 0.0)
    for variation, size in varying.items():
        assert found.shared[len(TERMS) + VARIATIONS.index(variation)] == pytest.approx(
            size, rel=0.1
        )
    assert found.shared[TERMS.index((1, 2))] == pytest.approx(12.0, rel=0.1)
    assert found.error < 1e-5


@pytest.mark.parametrize("sigma", [0.0, 0.1])
def test_constant_ones_stay_where_they_suffice(sigma: float) -> None:
    found = _fitted({}, 4, sigma)
    assert not found.shared[len(TERMS) : EQUATION].any()
    assert found.error < 1e-3
