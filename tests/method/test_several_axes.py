# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Finite-difference models of fields on several axes, on all points and on a coarser grid."""

from __future__ import annotations

import numpy as np
import pytest

from pdeloop.method.adapt.improve import ModelBasedSettings
from pdeloop.method.models import Measured, linear
from pdeloop.method.models.linear import ProjectedModel
from tests.support.fitted import fit_field_model

NY, NX, N_A = 6, 8, 2
SHAPE, N_Z = (NY, NX), NY * NX
RNG = np.random.default_rng(0)


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
