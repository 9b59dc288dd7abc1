# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A convecting layer against exact conduction, the onset of convection, its budgets and symmetries."""

from __future__ import annotations

import numpy as np
import pytest

from pde_sim_node.plants.convection_layer import ConvectionLayer, mirrored
from pdeloop.messages.arrays import Array

NONE = np.zeros((1, 12))


def test_a_layered_temperature_is_conducted_at_rest_as_it_must_at_second_order() -> None:
    errors = []
    for rows in (8, 16, 32):
        plant = ConvectionLayer(48, rows)
        y = np.cumsum(plant.heights) - 0.5 * plant.heights
        layered = np.sin(2 * np.pi * y)[:, None]
        z = plant.target.reshape(3, rows, 48).copy()
        z[0] += 0.1 * layered
        before = z.ravel()[None]
        after = plant.grid.fields(plant.step(before, NONE)[0] - plant.target)
        decay = np.exp(-plant.kappa * 4 * np.pi**2 * plant.sample_time)
        errors.append(float(np.abs(after[0] - 0.1 * decay * layered).max()))
        assert np.abs(after[1:]).max() < 1e-12
        assert plant.nusselt(plant.target) == 1.0
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    assert errors[-1] < 1e-3 and (orders > 1.6).all(), (errors, orders)


@pytest.mark.parametrize(("rayleigh", "grows"), [(1780.0, False), (1980.0, True)])
def test_conduction_loses_its_stability_at_the_critical_rayleigh_number(
    rayleigh: float, grows: bool
) -> None:
    """1879 for the wavenumber 4 between rigid plates (Chandrasekhar 1961, table III)."""
    plant = ConvectionLayer(48, 16, rayleigh)
    z = plant.target.reshape(3, 16, 48).copy()
    z[0] += 1e-6 * plant.heights[:, None] * np.cos(4 * plant.grid.axes[1].points)
    sizes, z = [], z.reshape(1, -1)
    for _ in range(40):
        z = plant.step(z, NONE)
        sizes.append(float(np.linalg.norm(z - plant.target)))
    assert (sizes[-1] > sizes[-10]) == grows


@pytest.fixture(scope="module")
def steady() -> tuple[ConvectionLayer, Array]:
    plant = ConvectionLayer(48, 16, rayleigh=1e4)
    return plant, plant.developed(0)


def test_heat_passes_walls_and_layer_alike_and_what_buoyancy_does_is_dissipated(
    steady: tuple[ConvectionLayer, Array],
) -> None:
    plant, z = steady
    T, u, v = plant.grid.fields(z)
    h, dx = plant.heights, np.pi / 48
    above = np.pad(v, ((0, 1), (0, 0)))[1:]
    divergence = (np.roll(u, -1, axis=1) - u) / dx + (above - v) / h[:, None]
    assert np.abs(divergence).max() < 1e-12
    heat = float(plant.nusselt(z))
    for wall in (0.5 - T[0], T[-1] + 0.5):
        assert float(wall.mean()) / (h[0] / 2) == pytest.approx(heat, rel=1e-6)
    apart = np.concatenate([h[:1], 0.5 * (h[1:] + h[:-1]), h[-1:]])[:, None]
    mirror = np.concatenate([-u[:1], u, -u[-1:]])
    v = np.pad(v, ((0, 1), (0, 0)))
    parts = (
        (((np.roll(u, -1, axis=1) - u) / dx) ** 2 * h[:, None]).sum(),
        (((v[1:] - v[:-1]) / h[:, None]) ** 2 * h[:, None]).sum(),
        (((v - np.roll(v, 1, axis=1)) / dx) ** 2 * apart).sum(),
        ((np.diff(mirror, axis=0) / apart) ** 2 * apart * _within(16)).sum(),
    )
    assert 1 + 0.7 * sum(parts) / 48 == pytest.approx(heat, rel=2e-3)
    assert heat > 2.0


def _within(rows: int) -> Array:
    """The share of the first and last difference of u that is within the layer."""
    share = np.ones((rows + 1, 1))
    share[[0, -1]] = 0.5
    return share


def test_a_shifted_and_mirrored_flow_is_moved_as_the_flow_is(
    steady: tuple[ConvectionLayer, Array],
) -> None:
    plant, z = steady
    a = np.random.default_rng(0).uniform(-1.0, 1.0, (1, 12))
    after = plant.grid.fields(plant.step(z[None], a)[0])
    begun = plant.grid.fields(z)
    shifted, rolled = np.roll(begun, 4, axis=-1), np.roll(a, 1, axis=1)
    for start, actions, expected in (
        (shifted, rolled, np.roll(after, 4, axis=-1)),
        (mirrored(begun), a[:, ::-1], mirrored(after)),
    ):
        found = plant.step(start.reshape(1, -1), actions)[0]
        np.testing.assert_allclose(found, expected.ravel(), atol=1e-12)
    seen = plant.readings(np.roll(after, 4, axis=-1).ravel())
    np.testing.assert_allclose(seen, np.roll(plant.readings(after.ravel()), 4, axis=-1), atol=1e-12)


def test_actions_are_bounded_one_by_one_so_that_they_can_cool_the_wall() -> None:
    """Three heaters of twelve at the upper limit: the mean that the source's rule leaves is -0.094."""
    plant = ConvectionLayer(48, 8)
    a = np.where(np.arange(12) % 4 == 0, 1.0, -1.0)[None]
    b = plant.heated(a)
    np.testing.assert_allclose(np.unique(b), [-0.375, 0.75])
    assert b.mean() == pytest.approx(-0.09375)


def test_time_steps_are_of_second_order() -> None:
    plant = ConvectionLayer(48, 8)
    z = plant.initial_state(np.random.default_rng(0))[None]
    a = np.random.default_rng(1).uniform(-1.0, 1.0, (1, 12))
    found = [ConvectionLayer(48, 8, refinement=r).step(z, a)[0] for r in (4, 8, 16)]
    ratio = np.linalg.norm(found[1] - found[0]) / np.linalg.norm(found[2] - found[1])
    assert 3.5 < ratio < 4.5, ratio


def test_columns_that_the_sensors_do_not_share_are_refused() -> None:
    with pytest.raises(ValueError, match="multiple of 48"):
        ConvectionLayer(50)
