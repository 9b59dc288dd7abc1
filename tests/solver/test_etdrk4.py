# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""ETDRK4: coefficients against their series and exact formulas, and the order of the scheme."""

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import pytest

from pde_sim_node.equations import AllenCahn, Burgers, Equation, KortewegDeVries
from pde_sim_node.plants import SpectralPlant
from pdeloop.solver.etdrk4 import etdrk4_coefficients
from tests.support.plants import plant_of

MAGNITUDES = np.array([0.0, 1e-12, 1e-6, 1e-3, 0.1, 0.5, 0.99, 1.0, 1.01, 1.5, 2.0, 5.0, 30.0])


def phi(order: int, y: complex) -> complex:
    """phi_0 = exp, phi_n+1 = (phi_n - 1/n!) / y: near 0 by its Taylor series, else recursively."""
    if abs(y) < 2:
        return sum(y**j / math.factorial(j + order) for j in range(40))
    value = np.exp(y)
    for n in range(order):
        value = (value - 1 / math.factorial(n)) / y
    return value


@pytest.mark.parametrize("direction", [1, -1, 1j, -1j], ids=["growing", "decaying", "i", "-i"])
def test_coefficients_are_the_exact_ones(direction: complex) -> None:
    dt = 0.25
    y = direction * MAGNITUDES
    c = etdrk4_coefficients(y / dt, dt)
    p1, p2, p3 = (np.array([phi(n, value) for value in y]) for n in (1, 2, 3))
    half = np.array([phi(1, value / 2) for value in y])
    for got, exact in (
        (c.e, np.exp(y)),
        (c.e2, np.exp(y / 2)),
        (c.q, dt / 2 * half),
        (c.f1, dt * (p1 - 3 * p2 + 4 * p3)),
        (c.f2, dt * (p2 - 2 * p3)),
        (c.f3, dt * (4 * p3 - p2)),
    ):
        np.testing.assert_allclose(got, exact, rtol=1e-13, atol=3e-15)


def test_coefficients_of_a_real_operator_are_real() -> None:
    c = etdrk4_coefficients(-MAGNITUDES, 0.1)
    assert all(np.isrealobj(value) for value in vars(c).values())


def test_coefficients_of_a_huge_decay_vanish() -> None:
    c = etdrk4_coefficients(np.array([-1e9]), 1.0)
    assert all(abs(value[0]) <= 1e-9 for value in vars(c).values())


def test_coefficients_refuse_a_growth_that_overflows() -> None:
    with pytest.raises(ValueError, match="integration_time"):
        etdrk4_coefficients(np.array([0.0, 1e4]), 1.0)


@dataclass(frozen=True, kw_only=True)
class Linear(Equation):
    """u_t + c u_x - nu u_xx + u_xxx = 0, all of it in the linear part."""

    name: ClassVar[str] = "linear"
    order: ClassVar[float] = 3.0

    def linear_operator(self, k):
        return -0.7j * k - 0.01 * k**2 + 0.002j * k**3

    def multiplier(self, k):
        return np.zeros_like(k)

    @staticmethod
    def nonlinearity(u: float) -> float:
        return u

    def initial_field(self, x, rng):
        return 0.3 + np.sin(2 * np.pi * x) + 0.5 * np.cos(6 * np.pi * x)

    def target(self, x):
        return np.zeros_like(x)


def small_plant(equation: Equation, n_z: int, sample_time: float, steps: int) -> SpectralPlant:
    times = {"sample_time": sample_time, "integration_time": sample_time / steps, "horizon": 10}
    return plant_of(equation, n_z=n_z, n_a=1, width=0.5, **times)


def test_the_linear_part_is_integrated_exactly() -> None:
    plant = small_plant(Linear(), 32, 0.8, 1)
    z = plant.reset([-1])
    for _ in range(5):
        z = plant.step(np.zeros((1, 1)))

    def mode(j: int) -> np.ndarray:
        k = 2 * np.pi * j
        rate = -0.7j * k - 0.01 * k**2 + 0.002j * k**3
        return np.exp(1j * k * plant.x + rate * 4.0)

    exact = 0.3 + mode(1).imag + 0.5 * mode(3).real
    np.testing.assert_allclose(z[0], exact, atol=2e-14)


@pytest.mark.parametrize(
    ("equation", "n_z", "sample_time", "steps"),
    [
        (Burgers(viscosity=1e-2), 64, 0.05, (16, 32, 64)),
        (AllenCahn(), 64, 0.2, (8, 16, 32)),
        (KortewegDeVries(), 64, 0.1, (16, 32, 64)),
    ],
    ids=["burgers", "allen-cahn", "kdv"],
)
def test_the_error_falls_with_the_fourth_power_of_the_step(
    equation: Equation, n_z: int, sample_time: float, steps: tuple[int, ...]
) -> None:
    action = np.full((1, 1), 0.5)

    def after(count: int) -> np.ndarray:
        plant = small_plant(equation, n_z, sample_time, count)
        return plant.evaluate(plant.reset([-1]), action)[0]

    exact = after(16 * steps[-1])
    errors = [np.abs(after(count) - exact).max() for count in steps]
    orders = np.log2(np.divide(errors[:-1], errors[1:]))
    assert errors[-1] > 1e-12, "roundoff, not the scheme, is what is measured"
    assert orders[-1] == pytest.approx(4, abs=0.3), (errors, orders)
