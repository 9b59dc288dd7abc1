# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Kolmogorov flow: exact vortices, the laminar flow, order four, energy and the bits of a batch."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from pde_sim_node.plants import DynamicsPlant
from pde_sim_node.plants.vorticity import Kolmogorov


def test_vortices_decay_exactly_and_the_laminar_flow_stays() -> None:
    """cos x cos y does not carry itself, so that it only decays, at the rate 2 nu."""
    plant = Kolmogorov(16, force=1e-300)
    x = plant.grid.axes[0].points
    vortices = (np.cos(x)[:, None] * np.cos(x)).reshape(1, -1)
    nothing = np.zeros((1, plant.n_a))
    expected = np.exp(-2 * plant.nu * plant.sample_time) * vortices
    np.testing.assert_allclose(plant.step(vortices, nothing), expected, atol=1e-13)
    laminar = Kolmogorov(16)
    np.testing.assert_allclose(
        laminar.step(laminar.target[None], nothing)[0], laminar.target, atol=1e-9
    )


def test_halving_the_step_divides_the_error_by_sixteen() -> None:
    plant: Any = Kolmogorov(16, viscosity=0.02, spread=3.0, step_time=0.1)
    z = plant.initial_state(np.random.default_rng(0))[None]
    a, found = np.random.default_rng(1).standard_normal((1, plant.n_a)), []
    for _ in range(4):
        found.append(plant.step(z, a))
        plant = plant.refined()
    errors = [float(np.abs(one - found[-1]).max()) for one in found[:-1]]
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    assert (orders > 3.7).all(), (errors, orders)


def test_without_viscosity_and_forces_energy_and_enstrophy_are_kept() -> None:
    """Up to the time step, whose error is of fourth order."""
    plant = Kolmogorov(16, viscosity=1e-12, force=1e-14, spread=1.0, step_time=0.01)
    z = plant.initial_state(np.random.default_rng(2))[None]
    before = z.copy()
    for _ in range(5):
        z = plant.step(z, np.zeros((1, plant.n_a)))
    assert np.abs(z - before).max() > 0.1

    def energy(w: np.ndarray) -> float:
        spectrum = np.fft.rfft2(w.reshape(16, 16))
        full = np.fft.irfft2(plant._inverse * spectrum, s=(16, 16))
        return float(np.mean(full * w.reshape(16, 16)))

    assert np.mean(z**2) == pytest.approx(np.mean(before**2), rel=1e-7)
    assert energy(z) == pytest.approx(energy(before), rel=1e-7)


def test_a_batch_has_the_bits_of_one() -> None:
    plant, alone = DynamicsPlant(Kolmogorov(16)), DynamicsPlant(Kolmogorov(16))
    plant.reset(np.arange(3))
    alone.reset([2])
    a = np.random.default_rng(0).standard_normal((3, plant.n_a))
    assert np.array_equal(plant.step(a)[2], alone.step(a[2:])[0])
