# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Unstable modes against theory: their growth, and whether actuators reach and sensors observe them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import pytest
import scipy.fft

import pdeloop
from pde_sim_node.build import build_plant
from pde_sim_node.equations import LinearEquation
from pde_sim_node.plants import SpectralPlant
from pde_sim_node.plants.convection import Convection
from pde_sim_node.plants.loading import as_plant
from pde_sim_node.plants.reactions import Plate
from pdeloop import problem_check, unstable_modes
from pdeloop.messages.problem import load_parameters
from pdeloop.unstable_modes import (
    REACHED,
    controllability,
    controllability_by_powers,
    observability,
)
from tests.support.plants import plant_of


@dataclass(frozen=True, kw_only=True)
class Growing(LinearEquation):
    """u_t = u + 0.2 u_xx on [0, 2 pi): the waves 0, 1 and 2 grow."""

    name: ClassVar[str] = "growing"
    order: ClassVar[float] = 2.0
    length: float = 2 * np.pi

    def linear_operator(self, k: Any) -> Any:
        return 1.0 - 0.2 * k**2

    def initial_field(self, x: Any, rng: Any) -> Any:
        return np.cos(x)

    def target(self, x: Any) -> Any:
        return np.zeros_like(x)


def plant(n_a: int, width: float) -> SpectralPlant:
    return plant_of(Growing(), n_z=32, n_a=n_a, width=width, sample_time=0.1, horizon=5)


def test_the_unstable_modes_are_those_of_the_operator_and_enough_actuators_reach_them() -> None:
    found = controllability(plant(5, 0.1))
    assert found.waves[:, 0].tolist() == [0, 1, 1, 2, 2]
    np.testing.assert_allclose(found.growth, [1.0, 0.8, 0.8, 0.2, 0.2], atol=1e-7)
    assert found.margins.min() > 0.1


@pytest.mark.parametrize(("n_a", "lost"), [(1, [1, 2]), (2, [1, 2]), (4, [2])])
def test_waves_on_which_equally_spaced_actuators_have_one_phase_are_not_reached(
    n_a: int, lost: list[int]
) -> None:
    """A pair cos, sin of one growth rate needs two columns of B, and they see wave n_a / 2 as one."""
    found = controllability(plant(n_a, 0.1))
    assert sorted(set(found.waves[found.margins < 1e-6, 0].tolist())) == lost


@pytest.mark.parametrize(("sensors", "lost"), [(1, [1, 2]), (2, [1, 2]), (4, [2]), (5, [])])
def test_waves_of_which_equally_spaced_sensors_see_one_phase_are_not_observed(
    sensors: int, lost: list[int]
) -> None:
    """As for actuators. Of two waves that look alike between them, the growth tells which it is."""
    found = observability(plant(1, 0.1), plant(1, 0.1).grid.measured(sensors))
    np.testing.assert_allclose(found.growth, [1.0, 0.8, 0.8, 0.2, 0.2], atol=1e-7)
    assert sorted(set(found.waves[found.margins < REACHED, 0].tolist())) == lost


def test_the_margin_of_sensors_does_not_depend_on_the_sampling_time() -> None:
    margins = [
        observability(as_sampled, as_sampled.grid.measured(1)).margins[0]
        for as_sampled in (
            plant_of(Growing(), n_z=32, n_a=1, width=0.1, sample_time=time, horizon=5)
            for time in (0.1, 0.01)
        )
    ]
    assert margins[1] == pytest.approx(margins[0], rel=0.1) and margins[0] > 0.05


def test_the_whole_state_observes_every_wave_alike() -> None:
    found = observability(plant(1, 0.1), np.arange(32))
    np.testing.assert_allclose(found.margins, 1.0, atol=1e-6)


@pytest.mark.parametrize(
    ("equilibrium", "growth"),
    [(1, [0.1308, 0.1308, 0.0824, 0.0824]), (2, [0.139] * 2), (3, [0.0933] * 2)],
)
def test_four_actuators_reach_the_unstable_modes_of_the_equilibria(
    equilibrium: int, growth: list[float]
) -> None:
    """Rates of Cvitanovic, Davidchack, Siminos (2010); a shift of the field keeps its size."""
    values = load_parameters("kuramoto-sivashinsky-22", {"physical.equilibrium": equilibrium})
    found = controllability(build_plant(values))
    grows = found.growth > 1e-3
    np.testing.assert_allclose(np.sort(found.growth[grows])[::-1], growth, atol=2e-4)
    assert found.margins[grows].min() > 0.2


class GrowingPlate(pdeloop.Dynamics):
    """Between walls, cos(i pi y) cos(j pi x / 2) grows at 1 - 0.9 i^2 - 0.2 j^2.

    The only actuator is in the middle, so what is odd in y or in x is out of its reach.
    """

    horizon, sample_time, n_a = 5, 0.1, 1

    def __init__(self) -> None:
        walls = {"periodic": False, "walls": False}
        y, x = pdeloop.Axis("y", 1.0, 6, **walls), pdeloop.Axis("x", 2.0, 8, **walls)
        self.grid = pdeloop.Grid((y, x))
        rates = 1.0 - 0.9 * np.arange(6.0)[:, None] ** 2 - 0.2 * np.arange(8.0) ** 2
        self.factors = np.exp(0.1 * rates)
        away = (y.points[:, None] - 0.5) ** 2 + (x.points - 1.0) ** 2
        self.supports = np.exp(-away / 0.1).reshape(-1, 1)

    def initial_state(self, rng: np.random.Generator) -> np.ndarray:
        return np.zeros(48)

    def step(self, z: np.ndarray, a: np.ndarray) -> np.ndarray:
        waves = scipy.fft.dctn(z.reshape(6, 8), norm="ortho")
        advanced = scipy.fft.idctn(self.factors * waves, norm="ortho").ravel()
        return advanced + 0.1 * (self.supports * a).sum(axis=1)


def test_modes_between_walls_are_told_by_their_half_waves() -> None:
    found = controllability(as_plant(GrowingPlate()))
    assert {tuple(row) for row in found.waves.tolist()} == {(0, 0), (0, 1), (0, 2), (1, 0)}
    np.testing.assert_allclose(found.growth, [1.0, 0.8, 0.2, 0.1], atol=1e-6)
    assert (found.margins < 1e-6).tolist() == [False, True, False, True]
    finding = problem_check._actuators(as_plant(GrowingPlate()))
    assert not finding.good
    assert "do not reach the half waves (0, 1), (1, 0) along y, x: move" in finding.text


@pytest.mark.parametrize("plant", [Plate(10, 8, across=1, up=1), Convection(10)])
def test_of_a_large_state_the_leading_modes_are_those_of_the_whole_matrix(
    plant: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One actuator in the middle of a plate does not reach what is odd about it."""
    made = as_plant(plant)
    whole, leading = controllability(made), controllability_by_powers(made)
    np.testing.assert_allclose(leading.growth, whole.growth, atol=1e-5)
    assert leading.waves.tolist() == whole.waves.tolist()
    lost = whole.margins < REACHED
    assert (leading.margins < REACHED).tolist() == lost.tolist()
    assert lost.sum() == (3 if isinstance(plant, Plate) else 0)
    positions = made.grid.measured(6)
    whole = observability(made, positions)
    monkeypatch.setattr(unstable_modes, "MAX_LINEARISED", 0)
    leading = observability(made, positions)
    np.testing.assert_allclose(leading.growth, whole.growth, atol=1e-5)
    np.testing.assert_allclose(leading.margins, whole.margins, atol=1e-4)
