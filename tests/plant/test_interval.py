# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The plant between walls against exact solutions, with its order of convergence."""

from __future__ import annotations

import copy
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.optimize import brentq

import pdeloop
from pde_sim_node.plants.interval import Interval
from pdeloop.cli import main
from pdeloop.problem_check import check

D = 0.05


def errors(exact: Callable[[np.ndarray, float], np.ndarray], steps: int, **how: Any) -> list[float]:
    """Largest errors after so many samples, on grids and with steps that are halved."""
    found = []
    for level in (1, 2, 4):
        plant = Interval(16 * level + 1, diffusivity=D, step_time=0.05 / (2 * level), **how)
        u = exact(plant.x, 0.0)
        for _ in range(steps):
            u = plant.step(u, np.zeros(plant.n_a))
        found.append(float(np.abs(u - exact(plant.x, 0.05 * steps)).max()))
    return found


KAPPA = brentq(lambda k: k * np.tan(k / 2) - 2.0, 0.1, 3.0)


@pytest.mark.parametrize(
    ("wave", "rate", "walls"),
    [
        (lambda x: np.sin(np.pi * x), D * np.pi**2, ("dirichlet", "dirichlet")),
        (lambda x: np.cos(2 * np.pi * x), D * 4 * np.pi**2, ("neumann", "neumann")),
        (lambda x: np.sin(np.pi * x / 2), D * np.pi**2 / 4, ("dirichlet", "neumann")),
        (lambda x: np.cos(KAPPA * (x - 0.5)), D * KAPPA**2, ("robin", "robin")),
    ],
)
def test_a_wave_decays_as_it_must_and_the_error_falls_by_four(
    wave: Any, rate: float, walls: tuple[str, str]
) -> None:
    """Robin: cos k (x - 1/2) with k tan(k/2) = h is its own multiple under u_xx."""
    how = {"left": walls[0], "right": walls[1], "transfer": 2.0, "growth": 0.3}
    found = errors(lambda x, t: np.exp((0.3 - rate) * t) * wave(x), 10, **how)
    orders = np.log2(np.array(found[:-1]) / found[1:])
    assert found[-1] < 1e-3 and (orders > 1.8).all(), (found, orders)


def test_convection_and_diffusion_are_those_of_the_exact_wave() -> None:
    """u = exp(c x / 2D) sin(pi x) solves it with rate D pi^2 + c^2 / 4D."""
    c = 0.1
    rate = D * np.pi**2 + c**2 / (4 * D)
    found = errors(
        lambda x, t: np.exp(c * x / (2 * D) - rate * t) * np.sin(np.pi * x),
        10,
        advection=c,
        growth=0.0,
    )
    orders = np.log2(np.array(found[:-1]) / found[1:])
    assert found[-1] < 2e-3 and (orders > 1.8).all(), (found, orders)


def test_burgers_travels_into_its_steady_shock() -> None:
    """u = -U tanh(U (x - 1/2) / 2D) is steady; the walls are held at its ends."""
    found = []
    for level in (1, 2, 4):
        plant = Interval(
            32 * level + 1,
            diffusivity=D,
            growth=0.0,
            steepening=1.0,
            inputs="both",
            step_time=0.0125,
        )
        u = -0.5 * np.tanh(0.5 * (plant.x - 0.5) / (2 * D))
        z, ends = u.copy(), u[[0, -1]]
        for _ in range(40):
            z = plant.step(z, ends)
        found.append(float(np.abs(z - u).max()))
    orders = np.log2(np.array(found[:-1]) / found[1:])
    assert found[-1] < 1e-3 and (orders > 1.8).all(), (found, orders)


def test_what_comes_through_a_wall_spreads_to_the_line_between_the_walls() -> None:
    """u = a x for u(0) = 0, u(1) = a; a flux a on the right gives the same line."""
    for right in ("dirichlet", "neumann"):
        plant = Interval(33, diffusivity=1.0, growth=0.0, right=right, inputs="right")
        u = np.zeros(33)
        for _ in range(200):
            u = plant.step(u, np.array([0.7]))
        np.testing.assert_allclose(u, 0.7 * plant.x, atol=1e-9)


def test_a_reaction_saturates() -> None:
    plant = Interval(17, left="neumann", right="neumann", growth=1.0, saturation=4.0)
    u = np.full(17, 0.1)
    for _ in range(400):
        u = plant.step(u, np.zeros(3))
    np.testing.assert_allclose(u, 0.5, rtol=1e-6)


def test_a_law_holds_what_grows_and_check_finds_nothing() -> None:
    values = pdeloop.problem(plant=Interval(17)).values
    found = {finding.name: finding for finding in check(values)}
    assert all(finding.good for finding in found.values()), found
    assert "halving" in found["integration step"].text


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"left": "open"}, "left must be one of dirichlet, neumann, robin, got 'open'"),
        ({"inputs": "top"}, "inputs must be one of inside, left, right, both"),
        ({"points": 3}, "points must be at least 5"),
        ({"diffusivity": 0.0}, "diffusivity must be positive"),
    ],
)
def test_what_it_cannot_be_is_refused(given: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        Interval(**given)


def test_it_is_shipped_by_name_and_trained(tmp_path: Path) -> None:
    words = ["--rollouts", "9", "--evaluation-fields", "2", "--reduced-order", "6", "--in-process"]
    problem = tmp_path / "rod.yaml"
    problem.write_text(
        "/**: {ros__parameters: {plant: interval, "
        "physical: {points: 17, right: neumann, inputs: right, growth: 0.5}, "
        "optimizer_settings: {iterations: 3, mixtures: 2}, "
        "field_model_settings: {folds: 2, largest_degree: 2}}}"
    )
    out = tmp_path / "run"
    assert main(["train", str(problem), *words, "--out", str(out)]) == 0
    run = pdeloop.load_run(out)
    assert run.values["physical.left"] == "dirichlet" and run.values["n_a"] == 1
    assert run.costs["adapted"].mean() < run.costs["none"].mean()


def test_it_can_be_copied() -> None:
    plant = Interval(17, growth=0.5)
    z = plant.initial_state(np.random.default_rng(0))
    again = copy.deepcopy(plant)
    assert np.array_equal(again.step(z, np.ones(3)), plant.step(z, np.ones(3)))


def coefficients() -> dict[str, Any]:
    """With these 2 + cos(pi x) is 0.4 times itself: the growth follows from that."""

    def growth(x: np.ndarray) -> np.ndarray:
        v, slope, bend = 2 + np.cos(np.pi * x), -np.pi * np.sin(np.pi * x), -(np.pi**2)
        diffused = diffusivity(x) * bend * np.cos(np.pi * x) + 0.06 * np.cos(2 * x) * slope
        return 0.4 - (diffused - 0.1 * x * slope) / v

    def diffusivity(x: np.ndarray) -> np.ndarray:
        return 0.05 + 0.03 * np.sin(2 * x)

    return {"diffusivity": diffusivity, "advection": lambda x: 0.1 * x, "growth": growth}


@pytest.mark.parametrize("wall", ["neumann", "dirichlet"])
def test_coefficients_that_depend_on_the_place_have_their_order(wall: str) -> None:
    """Walls without flux; and walls that are held where the wave is."""
    found = []
    for level in (1, 2, 4):
        how = {"left": wall, "right": wall, "step_time": 0.05 / (2 * level)}
        plant = Interval(16 * level + 1, inputs="both", **coefficients(), **how)
        v = 2 + np.cos(np.pi * plant.x)
        u = v.copy()
        if wall == "neumann":
            for _ in range(10):
                u = plant.step(u, np.zeros(2))
            found.append(float(np.abs(u - np.exp(0.4 * 0.5) * v).max()))
            continue
        # Held at its ends a multiple of itself is steady where the growth is less by the rate.
        growth = coefficients()["growth"]
        own = coefficients() | {"growth": lambda x, growth=growth: growth(x) - 0.4}
        plant = Interval(16 * level + 1, inputs="both", **own, **how)
        for _ in range(40):
            u = plant.step(u, np.array([3.0, 1.0]))
        found.append(float(np.abs(u - v).max()))
    orders = np.log2(np.array(found[:-1]) / found[1:])
    assert found[-1] < 1e-3 and (orders > 1.8).all(), (found, orders)


def test_forcing_reaction_and_steepening_that_depend_on_the_place_balance() -> None:
    """A field is steady under the forcing that its terms leave over, to second order in the grid."""
    wave = lambda x: np.sin(np.pi * x) * np.exp(x)  # noqa: E731

    def forcing(x: np.ndarray) -> np.ndarray:
        e, s, c = np.exp(x), np.sin(np.pi * x), np.cos(np.pi * x)
        u, u_x = e * s, e * (s + np.pi * c)
        u_xx = e * (s + 2 * np.pi * c - np.pi**2 * s)
        D, D_x = 0.1 * (1 + x**2), 0.2 * x
        return -(D * u_xx + D_x * u_x - x * u_x - (1 - x) * u * u_x - x * u - (1 + x) * u**3)

    found = []
    for level in (1, 2, 4):
        plant = Interval(
            16 * level + 1,
            diffusivity=lambda x: 0.1 * (1 + x**2),
            advection=lambda x: x,
            steepening=lambda x: 1 - x,
            growth=lambda x: -x,
            saturation=lambda x: 1 + x,
            forcing=forcing,
        )
        u = wave(plant.x)
        for _ in range(40):
            u = plant.step(u, np.zeros(3))
        found.append(float(np.abs(u - wave(plant.x)).max()))
    orders = np.log2(np.array(found[:-1]) / found[1:])
    assert found[-1] < 2e-3 and (orders > 1.8).all(), (found, orders)


def test_inputs_of_a_shape_of_ones_own_force_with_it() -> None:
    plant = Interval(33, shapes=lambda x: np.stack([x, np.sin(x)], axis=1), growth=0.0)
    assert plant.n_a == 2 and np.array_equal(plant.supports[:, 0], plant.x)
    a, rest = np.array([1e-3, 2e-3]), np.zeros(33)
    expected = 0.05 * (
        1e-3 * plant.x + 2e-3 * np.sin(plant.x)
    )  # far from the walls, which are held
    moved = plant.step(rest, a)
    assert moved[16] == pytest.approx(expected[16], rel=1e-3)


def test_a_number_and_a_function_that_is_one_are_the_same_plant_to_the_bit() -> None:
    given = {"diffusivity": 0.05, "growth": 1.2, "saturation": 0.3, "steepening": 0.5}
    numbers, functions, values = (
        Interval(33, **{name: how(own) for name, own in given.items()})
        for how in (
            lambda own: own,
            lambda own: lambda x: np.full_like(x, own),
            lambda own: [own] * 33,
        )
    )
    u = numbers.mean_state()
    for other in functions, values:
        assert np.array_equal(numbers.step(u, np.ones(3)), other.step(u, np.ones(3)))


def test_functions_tell_one_plant_from_another() -> None:
    def of(size: float) -> int:
        return (
            pdeloop.problem(plant=Interval(growth=lambda x: size * x))
            .plant()
            .definition.fingerprint
        )

    assert of(1.0) == of(1.0) != of(2.0)


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ({"diffusivity": lambda x: x - 0.5}, "diffusivity must be positive, got -0.5 somewhere"),
        ({"growth": lambda x: x[:-1]}, "growth must be a finite number, 65 of them or a function"),
        ({"advection": lambda x: np.log(-1 - x)}, "got NaN or infinity"),
        ({"forcing": [1.0, 2.0]}, r"got shape \(2,\)"),
        ({"shapes": lambda x: x}, "shapes must give 65 x n_a finite numbers"),
        ({"shapes": lambda x: x[:, None], "inputs": "left"}, "for inputs left"),
    ],
)
@pytest.mark.filterwarnings("ignore:invalid value")
def test_coefficients_that_are_none_are_refused(given: dict[str, Any], told: str) -> None:
    with pytest.raises(ValueError, match=told):
        Interval(**given)
