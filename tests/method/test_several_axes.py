# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Finite-difference models of fields on several axes, on all points and on a coarser grid."""

from __future__ import annotations

import numpy as np
import pytest

from pdeloop.method.adapt.improve import ModelBasedSettings
from pdeloop.method.models import Measured, linear
from pdeloop.method.models.base import model_of
from pdeloop.method.models.finite_difference import (
    Feature,
    FiniteDifferenceModel,
    features_of,
    of_features,
)
from pdeloop.method.models.linear import ProjectedModel, coarse_points
from tests.support.fitted import fit_field_model

NY, NX, N_A = 6, 8, 2
SHAPE, N_Z = (NY, NX), NY * NX
RNG = np.random.default_rng(0)


def model(components: int = 1, scale: float = 0.05) -> FiniteDifferenceModel:
    features = features_of(components, axes=2)
    numbers = [
        scale * RNG.standard_normal((len(features), components, N_Z)),
        RNG.standard_normal((components * N_Z, N_A)),
        scale * RNG.standard_normal(components * N_Z),
    ]
    return of_features("x1e-5", features, *numbers, 3, SHAPE)


def coarse() -> ProjectedModel:
    points = np.sort(RNG.choice(2 * N_Z, N_Z, replace=False))
    return ProjectedModel(model(), np.eye(2 * N_Z)[points], RNG.standard_normal((2 * N_Z, N_Z)) / 7)


@pytest.mark.parametrize("order", range(5))
def test_a_difference_is_along_one_axis_of_a_ring(order: int) -> None:
    """Of a small step the change is the sampling time times the rate."""
    features = features_of(1, axes=2)
    C = np.zeros((len(features), 1, N_Z))
    size = 1e-6
    C[features.index(Feature((0,), order))] = size
    own = of_features("x-shared", features, C, np.zeros((N_Z, N_A)), np.zeros(N_Z), 1, SHAPE)
    z = RNG.standard_normal(SHAPE)
    after = own.step(z.reshape(1, -1), np.zeros((1, N_A))).reshape(SHAPE)
    axis = 1 if order in (1, 2) else 0
    up, down = np.roll(z, -1, axis), np.roll(z, 1, axis)
    expected = z if order == 0 else 0.5 * (up - down) if order % 2 else up - 2.0 * z + down
    np.testing.assert_allclose((after - z) / size, expected, atol=1e-4)


@pytest.mark.parametrize("made", [model, lambda: model(2), coarse], ids=["one", "two", "coarse"])
def test_the_pull_back_is_the_transposed_derivative(made: type) -> None:
    own = made()
    z, a = 0.3 * RNG.standard_normal((3, own.n_z)), RNG.standard_normal((3, N_A))
    dz, da = RNG.standard_normal(z.shape), RNG.standard_normal(a.shape)
    y, h = RNG.standard_normal(z.shape), 1e-6
    on_z, on_a = own.pull_back(z, a, y)
    slope = (own.step(z + h * dz, a + h * da) - own.step(z - h * dz, a - h * da)) / (2.0 * h)
    wanted = np.sum(slope * y, axis=1)
    found = np.sum(on_z * dz, axis=1) + np.sum(on_a * da, axis=1)
    np.testing.assert_allclose(found, wanted, rtol=1e-6)
    alone = own.step(z[1:2], a[1:2])
    assert np.array_equal(alone, own.step(z, a)[1:2])


@pytest.mark.parametrize("made", [model, coarse], ids=["all points", "coarse"])
def test_a_model_comes_back_from_its_arrays_or_is_refused(made: type) -> None:
    own = made()
    again = model_of(own.arrays())
    z, a = RNG.standard_normal((2, own.n_z)), RNG.standard_normal((2, N_A))
    assert again.kind == "x1e-5" and np.array_equal(again.step(z, a), own.step(z, a))
    prefix = "inner." if isinstance(own, ProjectedModel) else ""
    for shape in ((NY, NX + 1), (N_Z,), (-NY, -NX), (NY, 0)):
        with pytest.raises(ValueError, match="axes"):
            model_of(own.arrays() | {f"{prefix}axes": np.array(shape)})


def plate(ny: int, nx: int, count: int) -> list[Measured]:
    """u_t = div(D grad u) + r u - u^3 without flux through the walls, D and r of x and y."""
    y, x = np.meshgrid((np.arange(ny) + 0.5) / ny, (np.arange(nx) + 0.5) / nx, indexing="ij")
    D, r = 0.03 + 0.02 * np.sin(2 * x + y), 1.0 + 0.8 * np.cos(3 * y) * x
    B = np.stack([np.exp(-8 * ((x - c) ** 2 + (y - c) ** 2)) for c in (0.3, 0.7)])
    found = []
    for _ in range(count):
        waves = [np.cos(i * np.pi * x) * np.cos(j * np.pi * y) for i in range(3) for j in range(3)]
        u = np.tensordot(0.3 * RNG.standard_normal(9), waves, axes=1)
        states, actions = [u.ravel()], RNG.standard_normal((40, 2))
        for a in actions:
            for _ in range(10):
                rate = r * u - u**3 + np.tensordot(a, B, axes=1)
                for axis, n in enumerate((ny, nx)):
                    mean = 0.5 * (np.take(D, range(n - 1), axis) + np.take(D, range(1, n), axis))
                    flux = mean * np.diff(u, axis=axis) * n**2
                    rate += np.diff(flux, axis=axis, prepend=0.0, append=0.0)
                u = u + 0.005 * rate
            states.append(u.ravel())
        found.append(Measured(np.array(states), actions))
    return found


@pytest.mark.parametrize("points", [256, 64], ids=["all points", "coarse"])
def test_a_reacting_plate_between_walls_is_predicted(
    points: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Well enough to be believed, as no linear model is; every second point suffices for that."""
    believed = ModelBasedSettings().believed
    ny, nx = 12, 16
    monkeypatch.setattr(linear, "_COARSE_POINTS", points)
    found = fit_field_model(plate(ny, nx, 6), np.zeros(ny * nx), line=False, shape=(ny, nx))
    assert found is not None and found.error <= believed
    assert found.model.kind.startswith("x") and found.model.n_z == ny * nx
    assert isinstance(found.model, ProjectedModel) == (points < ny * nx)
    errors = dict(found.candidates)
    assert min(errors[kind] for kind in errors if not kind.startswith("x")) > believed


def test_a_coarse_grid_has_equally_spaced_points() -> None:
    points, few = coarse_points((24, 32), 256)
    assert few == (12, 16)
    rows, columns = np.unravel_index(points, (24, 32))
    assert set(np.diff(np.unique(rows))) == {2} == set(np.diff(np.unique(columns)))
    assert coarse_points((4, 4), 16)[1] == (4, 4)
