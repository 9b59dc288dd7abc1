# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Models of the whole field: exact derivatives, the same bits in any batch, arrays and back."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numba
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from pdeloop.messages.action_set import ActionSet
from pdeloop.messages.arrays import read_only
from pdeloop.method.models import FieldModel
from pdeloop.method.models.base import model_of
from pdeloop.method.models.finite_difference import advance, features_of, of_features
from pdeloop.method.models.linear import LinearModel, add_products
from pdeloop.method.models.sweep import sweep_of
from pdeloop.solver import polynomial as compiled
from pdeloop.solver import polynomial_integrals, polynomial_step, polynomial_sweep
from tests.support.field_models import MODELS, points, spectral


@pytest.fixture(params=MODELS, scope="module")
def model(request: pytest.FixtureRequest) -> FieldModel:
    return MODELS[request.param]()


def test_covectors_are_pulled_back_by_the_exact_transpose(model):
    z, a, y = points(model)
    on_z, on_a = model.pull_back(z, a, y)
    rng = np.random.default_rng(2)
    dz, da = rng.normal(size=z.shape), rng.normal(size=a.shape)
    h = 1e-6
    slope = (model.step(z + h * dz, a + h * da) - model.step(z - h * dz, a - h * da)) / (2 * h)
    expected = np.sum(y * slope, axis=1)
    found = np.sum(on_z * dz, axis=1) + np.sum(on_a * da, axis=1)
    np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-6 * np.abs(expected).max())


def test_the_linearisation_is_the_derivative_and_transposed_what_pulls_back(model):
    z, a, y = points(model)
    A, B = model.linearise(z[0], a[0])
    on_z, on_a = model.pull_back(z, a, y)
    np.testing.assert_allclose(y[0] @ A, on_z[0], rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(y[0] @ B, on_a[0], rtol=1e-9, atol=1e-9)


def test_rows_do_not_depend_on_what_stands_beside_them(model):
    z, a, y = points(model, 9)
    z[4] *= 1e200  # overflows
    with np.errstate(all="ignore"):
        together = model.step(z, a), *model.pull_back(z, a, y)
        for i in range(9):
            one = slice(i, i + 1)
            alone = model.step(z[one], a[one]), *model.pull_back(z[one], a[one], y[one])
            for all_of_them, own in zip(together, alone, strict=True):
                assert np.array_equal(all_of_them[one], own, equal_nan=True)


@pytest.mark.parametrize("n_z, degree", [(24, 2), (25, 3), (500, 3), (64, 7)])
def test_a_spectral_model_is_its_equation(n_z, degree):
    """Against SciPy's integrator, the powers by convolution of spectra."""
    model = spectral(n_z, degree)
    x = 2 * np.pi * np.arange(n_z) / n_z
    z = 0.3 * np.cos(x + 1) + 0.2 * np.sin(2 * x)
    a = np.array([0.2, -0.1])
    smooth = np.cos(x)[:, None] * [0.3, 0.1]
    model = replace(model, B=smooth, constant=0.1 * np.sin(x), substeps=20)
    fine = 8 * n_z

    def rate(_, v):
        field = np.fft.irfft(v, fine) * fine / n_z
        total = model.linear * v + np.fft.rfft(smooth @ a + model.constant)
        for multiplier, polynomial in zip(model.multipliers, model.polynomials, strict=True):
            g = sum(C * field**p for p, C in enumerate(polynomial, 2))
            total += multiplier * np.fft.rfft(g)[: len(v)] * n_z / fine
        return total

    solved = solve_ivp(rate, (0, 1), np.fft.rfft(z) + 0j, method="DOP853", rtol=1e-11, atol=1e-11)
    expected = np.fft.irfft(solved.y[:, -1], n_z)
    np.testing.assert_allclose(model.step(z[None], a[None])[0], expected, atol=2e-8)


def test_the_smaller_a_field_the_fewer_its_internal_steps():
    model = MODELS["spectral"]()
    z, a, _ = points(model)
    z *= np.array([[0.5], [1.1], [1.5]]) / np.abs(z).max(axis=1, keepdims=True)
    for i, steps in enumerate((1, 2, 3)):
        alone = replace(model, substeps=steps, fewer=np.empty((0, 2)))
        assert np.array_equal(model.step(z, a)[i : i + 1], alone.step(z[i : i + 1], a[i : i + 1]))


def test_a_model_comes_back_from_its_arrays_to_the_bit(model, tmp_path):
    np.savez(tmp_path / "model.npz", **model.arrays())
    with np.load(tmp_path / "model.npz", allow_pickle=False) as arrays:
        again = model_of(dict(arrays))
    z, a, y = points(model)
    assert again.kind == model.kind and (again.n_z, again.n_a) == (model.n_z, model.n_a)
    assert np.array_equal(again.step(z, a), model.step(z, a))
    assert np.array_equal(again.pull_back(z, a, y)[0], model.pull_back(z, a, y)[0])


def test_arrays_of_any_order_and_permission_are_one_type_to_the_compiler() -> None:
    """A run reads some from files and messages, which cannot be written, and slices others."""
    z = np.random.default_rng(0).standard_normal((4, 16))
    frozen = z.copy()
    frozen.setflags(write=False)
    kinds = [z, frozen, np.asfortranarray(z), np.repeat(z, 2, axis=1)[:, ::2], z.astype(np.float32)]
    assert len({numba.typeof(read_only(kind)) for kind in kinds}) == 1
    model = LinearModel("k", np.asfortranarray(np.eye(16)), np.zeros((16, 1)), np.zeros(16))
    features = features_of(1)
    C, B = np.zeros((len(features), 1, 16)), np.zeros((16, 3))[:, ::3]
    differences = of_features("k", features, C, B, np.zeros(16), 1)
    for states in kinds:
        for one in (model, differences):
            np.testing.assert_array_equal(one.step(states, np.zeros((4, 1))), states)
    for kernel in (add_products, advance):
        assert len(kernel.signatures) == 1
    assert z.flags.writeable


def test_what_is_compiled_for_a_small_grid_serves_every_other() -> None:
    polynomial_step.load_compiled()
    model, rng = replace(spectral(n_z=32), substeps=2), np.random.default_rng(0)
    z, a = rng.standard_normal((2, 32)), rng.standard_normal((2, 2))
    model.step(z, a)
    model.pull_back(z, a, z)
    model.compiled.integrals(z, a, z)
    polynomial_sweep.load_compiled()
    sweep = sweep_of(model, ActionSet(low=-1.0), 3, np.ones((1, 2)))
    given = np.ones((1, 33)), np.ones((1, 3, 3)), np.ones((3, 33)), np.ones(3)
    states, requested, actions = sweep.roll(*given, np.ones((1, 3, 32)))
    sweep.roll_back(requested[..., :2], states[:, :-1], actions, np.ones((3, 33)), states[:, -1])
    kernels = compiled.advance, compiled.analysed, compiled.synthesised
    both_ways: Any = polynomial_sweep.roll, polynomial_sweep.roll_back
    for kernel in (*kernels, *both_ways, polynomial_integrals.integrals, compiled.pull_back):
        assert len(kernel.signatures) == 1
