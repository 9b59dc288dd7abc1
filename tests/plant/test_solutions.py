# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The plants against exact solutions and against an independent integrator."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from pde_sim_node.equations import (
    CahnHilliard,
    ConvectionDiffusionReaction,
    Equation,
    Fisher,
    GinzburgLandau,
    KuramotoSivashinsky,
    Schrodinger,
    Wave,
)
from pde_sim_node.plants import SpectralPlant
from pdeloop.solver.exact import exact_propagator
from tests.support.plants import plant_of


def make(equation: Equation, **values: Any) -> SpectralPlant:
    grid = {"n_z": 128, "n_a": 1, "width": 1.0, "sample_time": 0.1, "horizon": 1000}
    return plant_of(equation, **(grid | values))


def held(plant: SpectralPlant, z: np.ndarray, steps: int, action: float = 0.0) -> np.ndarray:
    z = z.reshape(1, -1)
    for _ in range(steps):
        z, _ = plant.evaluate(z, np.full((1, plant.n_a), action))
    return z[0]


# Fisher and Ginzburg-Landau: travelling fronts, and uniform fields


def two_fronts(x: np.ndarray, front: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    """A front to the right and its mirror image: 1 between them, 0 outside."""
    return front(x) + front(-x) - 1


@pytest.mark.parametrize(
    ("equation", "front"),
    [
        (
            # Ablowitz & Zeppetella, Bull. Math. Biol. 41 (1979): speed 5/sqrt(6) in units of
            # sqrt(rho D), where 2 is the slowest.
            Fisher(length=200.0, diffusivity=0.5, reaction=2.0),
            lambda y, t: (1 + np.exp((2 * y - 20 - 5 / np.sqrt(6) * 2 * t) / np.sqrt(6))) ** -2.0,
        ),
        (
            # Between 1 and the unstable 0, with speed 3/sqrt(2).
            GinzburgLandau(length=100.0),
            lambda y, t: 1 / (1 + np.exp((y - 20 - 3 / np.sqrt(2) * t) / np.sqrt(2))),
        ),
    ],
    ids=["fisher", "ginzburg-landau"],
)
def test_fronts_travel_with_their_exact_speed_and_shape(equation: Equation, front: Any) -> None:
    plant = make(equation, n_z=1024, sample_time=0.5, integration_time=0.005)
    x = plant.x - equation.length / 2
    z = held(plant, two_fronts(x, lambda y: front(y, 0.0)), 4)
    np.testing.assert_allclose(z, two_fronts(x, lambda y: front(y, 2.0)), atol=2e-6)


def test_a_uniform_field_follows_the_logistic_equation_and_its_forced_kin() -> None:
    """u' = rho u (1 - u) + a = -rho (u - p)(u - q), whose (u - p)/(u - q) decays exponentially."""
    equation = Fisher(reaction=0.8)
    plant = make(equation, n_z=32, sample_time=0.5, integration_time=0.005)
    for action in (0.0, 0.3, -0.15):
        p, q = np.sort(np.roots([-0.8, 0.8, action]).real)[::-1]
        u0 = 0.6
        ratio = (u0 - p) / (u0 - q) * np.exp(-0.8 * (p - q) * 2.0)
        z = held(plant, np.full(32, u0), 4, action)
        np.testing.assert_allclose(z, (p - ratio * q) / (1 - ratio), atol=1e-11)


# Kuramoto-Sivashinsky and Cahn-Hilliard: an independent integration, on a finer grid


def kuramoto_sivashinsky(k: np.ndarray, u: np.ndarray) -> np.ndarray:
    """u_t = -(u^2/2)_x - u_xx - u_xxxx by pseudo-spectral derivatives, written out."""
    v = np.fft.rfft(u)
    return np.fft.irfft((k**2 - k**4) * v - 0.5j * k * np.fft.rfft(u * u), u.shape[-1])


def cahn_hilliard(k: np.ndarray, u: np.ndarray) -> np.ndarray:
    v = np.fft.rfft(u)
    return np.fft.irfft((k**2 - 0.02 * k**4) * v - k**2 * np.fft.rfft(u**3), u.shape[-1])


@pytest.mark.parametrize(
    ("equation", "derivative", "n_z", "time", "steps"),
    [
        (KuramotoSivashinsky(length=22.0), kuramoto_sivashinsky, 64, 4.0, (40, 80, 160)),
        (CahnHilliard(), cahn_hilliard, 64, 0.05, (20, 40, 80)),
    ],
    ids=["kuramoto-sivashinsky", "cahn-hilliard"],
)
def test_an_independent_integration_is_met_with_order_four(
    equation: Equation, derivative: Any, n_z: int, time: float, steps: tuple[int, ...]
) -> None:
    """Against SciPy's implicit Radau method on a grid twice as fine, under a held action."""
    action = 0.4
    fine = 2 * n_z
    x = equation.length * np.arange(fine) / fine
    k = 2 * np.pi * np.fft.rfftfreq(fine, equation.length / fine)
    start = equation.initial_field(x, None)
    # Only what both grids can represent.
    modes = np.fft.rfft(start)
    modes[n_z // 2 :] = 0
    start = np.fft.irfft(modes)
    # A support of half the domain has a jump; what both grids share of it is the coarse one.
    plants = [
        make(equation, n_z=n_z, sample_time=time, integration_time=time / s, width=0.5)
        for s in steps
    ]
    forcing = np.fft.rfft(plants[0].supports[:, 0])
    forcing[-1] /= 2
    forced = np.fft.irfft(np.pad(forcing, (0, fine // 2 - n_z // 2)), fine) * fine / n_z
    done = solve_ivp(
        lambda _, u: (derivative(k, u.T) + action * forced).T,
        (0.0, time), start, method="Radau", rtol=1e-10, atol=1e-12, vectorized=True,
    )  # fmt: skip
    assert done.success
    exact = done.y[::2, -1]
    errors = [np.abs(held(plant, start[::2], 1, action) - exact).max() for plant in plants]
    orders = np.log2(np.divide(errors[:-1], errors[1:]))
    assert errors[-1] < 1e-6, errors
    assert orders[-1] == pytest.approx(4, abs=0.4), (errors, orders)


def test_phases_separate_and_keep_the_mean_and_lower_the_energy() -> None:
    """Cahn-Hilliard: the free energy, integral of (u^2-1)^2/4 + gamma u_x^2/2, never rises.

    In the end it is that of two interfaces, each of surface energy (2/3) sqrt(2 gamma).
    """
    plant = make(CahnHilliard(), sample_time=0.01, integration_time=0.0005)
    k = 2 * np.pi * np.fft.rfftfreq(128, 2.0 / 128)
    z = plant.reset([-1])[0].copy()
    mean, energies = z.mean(), []
    for _ in range(40):
        u_x = np.fft.irfft(1j * k * np.fft.rfft(z))
        energies.append(np.mean((z**2 - 1) ** 2 / 4 + 0.01 * u_x**2))
        z = held(plant, z, 1)
    assert z.mean() == pytest.approx(mean, abs=1e-13)
    assert np.all(np.diff(energies) < 1e-12)
    assert 2.0 * energies[-1] == pytest.approx(2 * 2 / 3 * np.sqrt(2 * 0.02), rel=0.01)
    assert energies[0] > 1.4 * energies[-1]


def test_kuramoto_sivashinsky_is_chaotic_and_bounded() -> None:
    """Two fields 1e-6 apart separate to the size of the attractor, which stays bounded."""
    plant = make(KuramotoSivashinsky(), n_z=256, sample_time=0.5, integration_time=0.0625)
    pair = np.repeat(plant.reset([-1]).copy(), 2, axis=0)
    pair[1, 0] += 1e-6
    nothing = np.zeros((2, 1))
    for _ in range(500):
        pair, _ = plant.evaluate(pair, nothing)
    assert np.abs(pair).max() < 5
    assert np.abs(pair[0] - pair[1]).max() > 1


# Linear plants: exact for any sampling time, forced and unforced


def test_convection_diffusion_and_reaction_of_a_wave() -> None:
    equation = ConvectionDiffusionReaction(diffusivity=0.01, velocity=0.3, reaction=0.5)
    plant = make(equation, n_z=100, sample_time=0.7)
    k, t = 6 * np.pi, 1.4
    z = held(plant, np.sin(k * plant.x), 2)
    exact = np.exp((0.5 - 0.01 * k**2) * t) * np.sin(k * (plant.x - 0.3 * t))
    np.testing.assert_allclose(z, exact, atol=1e-14)


def test_a_held_action_on_a_uniform_field_grows_as_its_ordinary_equation_says() -> None:
    """u' = rho u + a."""
    plant = make(ConvectionDiffusionReaction(reaction=0.5), n_z=100, sample_time=0.7)
    z = held(plant, np.full(100, 0.2), 3, action=-0.3)
    grown = np.exp(0.5 * 2.1)
    np.testing.assert_allclose(z, np.full(100, 0.2 * grown - 0.3 * (grown - 1) / 0.5), atol=1e-13)


def test_dalembert_and_the_conserved_energy_of_the_wave_equation() -> None:
    """u = (f(x - ct) + f(x + ct))/2 for a field f at rest, on a periodic domain."""
    equation = Wave(length=20.0, speed=1.5)
    plant = make(equation, n_z=512, sample_time=0.7)
    x, t = plant.x, 7 * 0.7

    def f(y: np.ndarray) -> np.ndarray:
        return np.exp(-(((y - 10 + 10) % 20 - 10) ** 2))

    def f_x(y: np.ndarray) -> np.ndarray:
        away = (y - 10 + 10) % 20 - 10
        return -2 * away * np.exp(-(away**2))

    z = held(plant, np.concatenate([f(x), 0 * x]), 7)
    u, v = np.split(z, 2)
    np.testing.assert_allclose(u, (f(x - 1.5 * t) + f(x + 1.5 * t)) / 2, atol=1e-12)
    np.testing.assert_allclose(v, 1.5 * (f_x(x + 1.5 * t) - f_x(x - 1.5 * t)) / 2, atol=1e-12)
    assert np.sum(1.5**2 * f_x(x) ** 2) == pytest.approx(energy(u, v, 1.5), rel=1e-12)


def energy(u: np.ndarray, v: np.ndarray, speed: float) -> float:
    k = 2 * np.pi * np.fft.rfftfreq(len(u), 20.0 / len(u))
    u_x = np.fft.irfft(1j * k * np.fft.rfft(u))
    return float(np.sum(speed**2 * u_x**2 + v**2))


def test_a_mode_of_the_wave_equation_swings_about_its_forced_position() -> None:
    """Under a support of half the domain mode 1 obeys w'' = -(c k)^2 w + a s_1."""
    plant = make(Wave(speed=0.4), n_z=128, sample_time=0.25, width=0.5)
    z = held(plant, np.zeros(128), 5, action=1.5)
    omega = 0.4 * 2 * np.pi
    support = 1.5 * np.fft.rfft(plant.supports[:, 0])[1]
    u, v = (np.fft.rfft(part)[1] for part in np.split(z, 2))
    assert u == pytest.approx(support * (1 - np.cos(omega * 1.25)) / omega**2, abs=1e-12)
    assert v == pytest.approx(support * np.sin(omega * 1.25) / omega, abs=1e-12)


def test_a_free_particle_disperses() -> None:
    """psi = (1 + i b t)^(-1/2) exp(-y^2/(2 s^2 (1 + i b t))) moving with hbar k/m."""
    hbar, mass, potential = 0.8, 1.6, 0.5
    equation = Schrodinger(length=40.0, planck=hbar, mass=mass, potential=potential)
    plant = make(equation, n_z=512, sample_time=0.9)
    x, k0, s = plant.x - 15, 3.0, 1.5

    def packet(t: float) -> np.ndarray:
        growing = 1 + 1j * hbar * t / (mass * s**2)
        y = x - hbar * k0 / mass * t
        phase = k0 * x - hbar * k0**2 * t / (2 * mass) - potential * t / hbar
        return np.exp(-(y**2) / (2 * s**2 * growing) + 1j * phase) / np.sqrt(growing)

    psi = packet(0.0)
    z = held(plant, np.concatenate([psi.real, psi.imag]), 3)
    u, v = np.split(z, 2)
    np.testing.assert_allclose(u + 1j * v, packet(2.7), atol=1e-12)
    assert np.sum(z**2) == pytest.approx(np.sum(np.abs(psi) ** 2), rel=1e-13)


@pytest.mark.parametrize("n_x", [8, 10, 16, 22, 48, 62, 100, 128])
def test_a_linear_plant_is_the_same_on_grids_of_all_kinds(n_x: int) -> None:
    """Against the exponential of the whole discretised system, with two of each: kinds of grid
    (powers of two, threes, primes), supports and components.
    """
    from scipy.linalg import expm

    equation = Wave(speed=0.3)
    plant = make(equation, n_z=2 * n_x, n_a=2, width=0.3, sample_time=0.2)
    modes = np.fft.fft(np.eye(n_x), axis=0)
    k = 2 * np.pi * np.fft.fftfreq(n_x, 1 / n_x)
    second = np.real(np.linalg.solve(modes, np.diag(-(0.3**2) * k**2) @ modes))
    whole = np.zeros((2 * n_x + 2, 2 * n_x + 2))
    whole[:n_x, n_x : 2 * n_x] = np.eye(n_x)
    whole[n_x : 2 * n_x, :n_x] = second
    whole[n_x : 2 * n_x, 2 * n_x :] = plant.supports
    z, actions = plant.reset([0, 1]).copy(), np.array([[1.0, -2.0], [0.5, 3.0]])
    expected = expm(0.2 * whole) @ np.hstack([z, actions]).T
    np.testing.assert_allclose(plant.step(actions), expected[: 2 * n_x].T, atol=1e-12)


def test_the_exact_propagator_of_matrices_is_that_of_scalars() -> None:
    linear = np.array([0.0, 1e-12, -0.3, 2.0 - 4j, -900.0 + 1j])
    e, f = exact_propagator(linear, 0.25)
    np.testing.assert_allclose(e[:, 0, 0], np.exp(0.25 * linear), rtol=1e-15)
    pairs = np.zeros((5, 2, 2), dtype=complex)
    pairs[:, 0, 0] = pairs[:, 1, 1] = linear
    pair_e, pair_f = exact_propagator(pairs, 0.25)
    np.testing.assert_allclose(pair_e[:, 1, 1], e[:, 0, 0], rtol=1e-11, atol=1e-15)
    np.testing.assert_allclose(pair_f[:, 0, 0], f[:, 0, 0], rtol=1e-11, atol=1e-15)
    assert not pair_e[:, 0, 1].any()


def test_a_growth_that_overflows_is_refused() -> None:
    with pytest.raises(ValueError, match="take a smaller sample_time"):
        exact_propagator(np.array([0.0, 1e4]), 1.0)


# What does not fit


def test_components_that_do_not_fit_are_refused() -> None:
    with pytest.raises(
        ValueError, match=r"2 times an even number of grid points.*got 130: take 132"
    ):
        make(Wave(), n_z=130)

    class Tangled(Fisher):
        components = ("u", "v")

    with pytest.raises(ValueError, match="only a LinearEquation may have"):
        make(Tangled(), n_z=128)

    class Flat(Wave):
        def linear_operator(self, k: np.ndarray) -> np.ndarray:
            return k

    with pytest.raises(ValueError, match="an array of 33 x 2 x 2 finite numbers"):
        make(Flat(), n_z=128)

    class Short(Wave):
        def target(self, x: np.ndarray) -> np.ndarray:
            return x

    with pytest.raises(ValueError, match="target of the equation must return 2 x 64 finite"):
        make(Short(), n_z=128)
