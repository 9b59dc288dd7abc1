# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Reaction-diffusion plants: exact waves, growth rates, order of convergence, trainings."""

from __future__ import annotations

import pickle
from typing import Any

import numpy as np
import pytest
from scipy import linalg

from pde_sim_node.plants import DynamicsPlant
from pde_sim_node.plants.reaction_diffusion import ReactionDiffusion
from pde_sim_node.plants.reactions import (
    Brusselator,
    ComplexGinzburgLandau,
    FitzHughNagumo,
    GrayScott,
    Plate,
)

ALL = [Plate, GrayScott, Brusselator, FitzHughNagumo, ComplexGinzburgLandau]
WAVES: dict[str, Any] = {
    "periodic": lambda s: np.cos(2 * np.pi * s),
    "neumann": lambda s: np.cos(np.pi * s),
    "dirichlet": lambda s: np.sin(np.pi * s),
}


@pytest.mark.parametrize("walls", WAVES)
def test_heat_decays_exactly_on_a_rectangle(walls: str) -> None:
    plant = Plate(24, 16, growth=0.0, saturation=0.0, walls=walls)
    y, x = (axis.points / axis.length for axis in plant.grid.axes)
    wave = WAVES[walls]
    field = (wave(y)[:, None] * wave(x)).reshape(1, -1)
    factor = 4 if walls == "periodic" else 1
    rate = 0.05 * factor * np.pi**2 * (1 / 1.0**2 + 1 / 1.5**2)
    after = plant.step(field, np.zeros((1, plant.n_a)))
    np.testing.assert_allclose(after, np.exp(-rate * plant.sample_time) * field, atol=1e-14)


@pytest.mark.parametrize("kind", ALL)
@pytest.mark.parametrize("walls", ["periodic", "neumann"])
def test_small_waves_grow_as_the_linearisation_says(
    kind: type[ReactionDiffusion], walls: str
) -> None:
    plant = kind(walls=walls)
    rest, c = np.asarray(plant.rest, dtype=float), len(plant.components)
    at_rest = rest.reshape(1, c, *[1] * len(plant.grid.axes))
    np.testing.assert_allclose(plant.reaction(at_rest), 0.0, atol=1e-14)
    step = 1e-6
    columns = []
    for unit in np.eye(c):
        moved = step * unit.reshape(at_rest.shape)
        columns.append((plant.reaction(at_rest + moved) - plant.reaction(at_rest - moved)).ravel())
    J = np.stack(columns, axis=1) / (2 * step)
    x = plant.grid.axes[-1]
    k = (2 if walls == "periodic" else 1) * np.pi / x.length
    M = linalg.expm(plant.sample_time * (J - k**2 * np.asarray(plant.diffusion)))
    shape = np.broadcast_to(WAVES[walls](x.points / x.length), plant.grid.shape).ravel()
    start = 1e-7 * np.arange(1.0, c + 1)
    z = (plant.target.reshape(c, -1) + start[:, None] * shape).reshape(1, -1)
    after = plant.step(z, np.zeros((1, plant.n_a)))[0] - plant.target
    expected = (M @ start)[:, None] * shape
    np.testing.assert_allclose(after.reshape(c, -1), expected, atol=1e-9 * 3)


@pytest.mark.parametrize("kind", ALL)
def test_halving_the_step_divides_the_error_by_four(kind: type[ReactionDiffusion]) -> None:
    plant: Any = kind()
    z = plant.initial_state(np.random.default_rng(1))[None]
    a = np.random.default_rng(2).standard_normal((1, plant.n_a)) * 0.1
    found = []
    for _ in range(4):
        found.append(plant.step(z, a))
        plant = plant.refined()
    errors = [float(np.abs(one - found[-1]).max()) for one in found[:-1]]
    # Against the third halving: 1 - 1/64, 1/4 - 1/64 and 1/16 - 1/64 of the error.
    assert errors[0] / errors[1] == pytest.approx((1 - 1 / 64) / (1 / 4 - 1 / 64), rel=0.1)
    assert errors[1] / errors[2] == pytest.approx((1 / 4 - 1 / 64) / (1 / 16 - 1 / 64), rel=0.1)


def test_a_plane_wave_of_ginzburg_landau_travels_exactly() -> None:
    """A = sqrt(1 - k^2) exp(i (k x - w t)) with w = beta + (alpha - beta) k^2."""
    alpha, beta, length = 0.5, -0.3, 20.0
    plant = ComplexGinzburgLandau(32, length, alpha, beta, step_time=0.005)
    k = 2 * np.pi / length
    frequency = beta + (alpha - beta) * k**2
    x = plant.grid.axes[0].points

    def wave(t: float) -> np.ndarray:
        A = np.sqrt(1 - k**2) * np.exp(1j * (k * x - frequency * t))
        return np.concatenate([A.real, A.imag])[None]

    z = wave(0.0)
    for _ in range(20):
        z = plant.step(z, np.zeros((1, plant.n_a)))
    np.testing.assert_allclose(z, wave(2.0), atol=1e-5)


# u = exp(-t) m(x, y) is exact for any D where r = -(div(D grad m))/m - 1, so m is any positive field,
# or one that is 0 at the walls where D is flat there.
WIDTH, HEIGHT, MEAN = 1.5, 1.0, 0.05


def manufactured(walls: str) -> tuple[Any, Any, Any]:
    """m, D and r as functions of x and y, by derivatives taken by hand."""
    kx, ky = (2 if walls == "periodic" else 1) * np.pi / np.array([WIDTH, HEIGHT])
    qx, qy = 2 * np.pi / np.array([WIDTH, HEIGHT])
    shift = 0.0 if walls == "dirichlet" else 2.0
    f, df = (np.sin, np.cos) if walls == "dirichlet" else (np.cos, lambda s: -np.sin(s))

    def m(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return shift + f(kx * x) * f(ky * y)

    def d(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return MEAN * (1 + 0.4 * np.cos(qx * x) * np.cos(qy * y))

    def r(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        D_x = -MEAN * 0.4 * qx * np.sin(qx * x) * np.cos(qy * y)
        D_y = -MEAN * 0.4 * qy * np.cos(qx * x) * np.sin(qy * y)
        m_x, m_y = kx * df(kx * x) * f(ky * y), ky * f(kx * x) * df(ky * y)
        bend = -(kx**2 + ky**2) * f(kx * x) * f(ky * y)
        return -(d(x, y) * bend + D_x * m_x + D_y * m_y) / m(x, y) - 1.0

    return m, d, r


@pytest.mark.parametrize("values", ["functions", "values at the points"])
@pytest.mark.parametrize("walls", WAVES)
def test_diffusion_that_depends_on_the_place_has_an_exact_solution_of_second_order(
    walls: str, values: str
) -> None:
    m, D, r = manufactured(walls)
    errors = []
    for level in (1, 2):
        nx, ny = 12 * level, 8 * level
        axes = Plate(nx, ny, WIDTH, HEIGHT, walls=walls).grid.axes
        y, x = np.meshgrid(*(axis.points for axis in axes), indexing="ij")
        given = {"diffusivity": D, "growth": r}
        if values != "functions":  # in a row, as a file has them
            given = {name: own(x, y).ravel().tolist() for name, own in given.items()}
        how = {"saturation": 0.0, "walls": walls, "step_time": 0.1 / (2 * level)}
        plant = Plate(nx, ny, WIDTH, HEIGHT, **given, **how)  # type: ignore[arg-type]
        z = m(x, y).reshape(1, -1)
        for _ in range(5):
            z = plant.step(z, np.zeros((1, plant.n_a)))
        errors.append(float(np.abs(z - np.exp(-0.5) * m(x, y).ravel()).max()))
    assert errors[0] < 0.05 and errors[0] / errors[1] == pytest.approx(4.0, rel=0.2), errors


def test_a_constant_given_at_each_point_leads_to_the_same_heat_and_conserves_it() -> None:
    """Without flux through the walls the mean stays; exact waves are the limit of small cells."""
    exact, cells = (
        Plate(24, 16, diffusivity=D, growth=0.0, saturation=0.0) for D in (0.05, [0.05] * (24 * 16))
    )
    z = exact.initial_state(np.random.default_rng(3))[None]
    none = np.zeros((1, exact.n_a))
    one, other = exact.step(z, none), cells.step(z, none)
    np.testing.assert_allclose(other, one, atol=2e-3)
    assert np.mean(other) == pytest.approx(np.mean(z), abs=1e-14)
    again = pickle.loads(pickle.dumps(cells))
    assert np.array_equal(again.step(z, none), other)


def test_a_batch_on_a_plate_of_variable_diffusivity_has_the_bits_of_one() -> None:
    D = manufactured("neumann")[1]
    plant = Plate(12, 8, diffusivity=D)
    z = np.stack([plant.initial_state(np.random.default_rng(seed)) for seed in range(4)])
    a = np.random.default_rng(9).standard_normal((4, plant.n_a))
    assert np.array_equal(plant.step(z, a)[2], plant.step(z[2:3], a[2:3])[0])


@pytest.mark.parametrize("kind", ALL)
def test_a_batch_has_the_bits_of_one(kind: type[ReactionDiffusion]) -> None:
    plant, alone = DynamicsPlant(kind()), DynamicsPlant(kind())
    plant.reset(np.arange(5))
    alone.reset([3])
    actions = np.random.default_rng(0).standard_normal((3, 5, plant.n_a)) * 0.1
    for a in actions:
        assert np.array_equal(plant.step(a)[3], alone.step(a[3:4])[0])
    assert plant.totals[3] == alone.totals[0]


def test_walls_and_sizes_that_do_not_fit_are_refused() -> None:
    with pytest.raises(ValueError, match="walls must be one of periodic, neumann, dirichlet"):
        Plate(walls="open")
    with pytest.raises(ValueError, match="allow no state but u = 1, v = 0"):
        GrayScott(feed=0.04, kill=0.08)
    with pytest.raises(ValueError, match="diffusivity must be positive, got -"):
        Plate(diffusivity=lambda x, y: x - 0.5)
    with pytest.raises(ValueError, match=r"growth must be .* 768 of them or a function of x and y"):
        Plate(growth=[1.0, 2.0])
    with pytest.raises(ValueError, match="points must be at least 4"):
        Plate(nx=2)
