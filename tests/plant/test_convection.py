# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Convection against exact conduction, the critical Rayleigh number and the published heat transfer."""

from __future__ import annotations

import numpy as np
import pytest

from pde_sim_node.plants import DynamicsPlant
from pde_sim_node.plants.buoyant_flow import flow
from pde_sim_node.plants.convection import Convection

NONE = np.zeros((1, 10))


def test_a_layered_temperature_is_conducted_at_rest_as_it_must_at_second_order() -> None:
    """T(y) is held up by the pressure, so that it obeys the heat equation; time steps go with dx^2."""
    errors = []
    for n in (10, 20, 40):
        plant = Convection(n)
        y = plant.grid.axes[0].points
        z = plant.target.reshape(3, n, n).copy()
        z[0] += 0.1 * np.sin(2 * np.pi * y)[:, None]
        after = plant.grid.fields(plant.step(z.reshape(1, -1), NONE)[0])
        decay = np.exp(-plant.kappa * 4 * np.pi**2 * plant.sample_time)
        exact = 0.5 - y + 0.1 * decay * np.sin(2 * np.pi * y)
        errors.append(float(np.abs(after[0] - exact[:, None]).max()))
        assert np.abs(after[1:]).max() < 1e-12
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    assert errors[-1] < 1e-3 and (orders > 1.8).all(), (errors, orders)


@pytest.mark.parametrize(("rayleigh", "grows"), [(2300.0, False), (2900.0, True)])
def test_conduction_loses_its_stability_at_the_critical_rayleigh_number(
    rayleigh: float, grows: bool
) -> None:
    """2585 in a square with adiabatic sides."""
    plant = Convection(20, rayleigh)
    points = plant.grid.axes[0].points
    z = plant.target.reshape(3, 20, 20).copy()
    z[0] += 1e-6 * np.sin(np.pi * points)[:, None] * np.cos(np.pi * points)
    sizes, z = [], z.reshape(1, -1)
    for _ in range(60):
        z = plant.step(z, NONE)
        sizes.append(float(np.linalg.norm(z - plant.target)))
    assert (sizes[-1] > sizes[-20]) == grows


def test_the_heat_that_convection_carries_is_the_published_one() -> None:
    """Nu = 2.158 at Ra = 1e4 (Ouertatani et al. 2008), in the limit of fine grids."""
    found = {n: float(Convection(n).nusselt(Convection(n).mean_state())) for n in (10, 20, 30)}
    limit = found[30] + (found[30] - found[20]) / (1.5**2 - 1)
    assert limit == pytest.approx(2.158, abs=0.01)
    order = np.log2((found[10] - 2.158) / (found[20] - 2.158))
    assert order > 1.8
    resting = Convection(10)
    assert resting.nusselt(resting.target) == pytest.approx(1.0)


def test_a_steady_roll_loses_no_fluid_and_as_much_heat_above_as_below() -> None:
    plant = Convection(20)
    T, u, v = plant.grid.fields(plant.mean_state())
    right = np.pad(u, ((0, 0), (0, 1)))[:, 1:]
    above = np.pad(v, ((0, 1), (0, 0)))[1:]
    assert np.abs(right - u + above - v).max() < 1e-13
    upper = float(np.mean(T[-1] + 0.5) / (0.5 / 20))
    assert upper == pytest.approx(float(plant.nusselt(plant.mean_state())), rel=1e-9)


def test_actions_are_balanced_and_bounded() -> None:
    plant = DynamicsPlant(Convection(10))
    plant.reset([0])
    plant.step(np.arange(10.0)[None])
    expected = (np.arange(10.0) - 4.5) / 4.5 * 0.75
    np.testing.assert_allclose(plant.actions[0], expected)


def test_an_even_temperature_of_the_wall_is_that_of_the_wall() -> None:
    """A fluid between two plates of -1/2 is at rest at -1/2."""
    plant = Convection(10)
    z = np.zeros((3, 10, 10))
    z[0] = -0.5
    flow(z, np.full(10, -0.5), plant.kappa, plant.nu, 0.1, 20, 0.0, *plant._cells)
    np.testing.assert_allclose(z[0], -0.5, atol=1e-13)
    assert np.abs(z[1:]).max() < 1e-13
