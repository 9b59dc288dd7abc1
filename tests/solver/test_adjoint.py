# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The adjoint of the plant's step against finite differences of the plant and exact identities."""

from dataclasses import dataclass

import numpy as np
import pytest

from pde_sim_node.build import build_plant
from pde_sim_node.equations import Burgers
from pde_sim_node.plants import SpectralPlant
from pdeloop.episode import projected_law, rollout
from pdeloop.gradients import Gradients
from pdeloop.messages.problem import load_parameters
from tests.support.plants import Advection, plant_of

PROBLEMS = ("burgers", "allen-cahn", "kdv")


def shipped(problem: str, **changes: object) -> SpectralPlant:
    return build_plant({**load_parameters(problem, {}), **changes})


def derivative(f, h: float) -> np.ndarray:
    """df(s)/ds at 0, with an error of order h^4."""
    return (8 * (f(h) - f(-h)) - (f(2 * h) - f(-2 * h))) / (12 * h)


def somewhere(
    plant: SpectralPlant, batch: int = 3
) -> tuple[np.ndarray, np.ndarray, np.random.Generator]:
    """States off the initial manifold, actions, and a generator for more."""
    rng = np.random.default_rng(5)
    states = plant.reset(np.arange(batch)).copy()
    actions = 0.3 * rng.standard_normal((batch, plant.n_a))
    for _ in range(3):
        states, _ = plant.evaluate(states, actions)
    return states, actions, rng


# 100 grid points have no compiled transform of their length: the published grid is a matrix product.
@pytest.mark.parametrize("problem", PROBLEMS)
@pytest.mark.parametrize("n_z", [None, 100])
def test_the_transposed_step_agrees_with_finite_differences_of_the_plant(problem, n_z):
    plant = shipped(problem, **({} if n_z is None else {"n_z": n_z}))
    states, actions, rng = somewhere(plant)
    y, dz = rng.standard_normal((2, *states.shape))
    da = rng.standard_normal(actions.shape)
    on_states, on_actions = plant.adjoint().pull_back(states, actions, y)
    for change_z, change_a in ((dz, 0 * da), (0 * dz, da)):
        moved = derivative(
            lambda s, z=change_z, a=change_a: plant.evaluate(states + s * z, actions + s * a)[0],
            1e-4,
        )
        expected = (moved * y).sum(axis=1)
        got = (on_states * change_z).sum(axis=1) + (on_actions * change_a).sum(axis=1)
        scale = np.linalg.norm(moved, axis=1) * np.linalg.norm(y, axis=1)
        assert (np.abs(got - expected) <= 1e-9 * scale).all()


@pytest.mark.parametrize("problem", PROBLEMS)
@pytest.mark.parametrize("n_z", [None, 100])
def test_its_way_forward_is_the_step_of_the_plant_to_the_bit(problem, n_z):
    plant = shipped(problem, **({} if n_z is None else {"n_z": n_z}))
    states, actions, _ = somewhere(plant)
    expected = plant.evaluate(states, actions)[0]
    assert plant.adjoint().step(states, actions).tobytes() == expected.tobytes()


def test_of_a_linear_plant_it_is_the_transposed_matrix():
    """With g = 0, f is affine: its matrix, column by column, transposed to rounding."""
    grid = {"n_z": 16, "n_a": 3, "width": 0.2, "horizon": 1}
    plant = plant_of(Advection(), **grid, sample_time=0.1, integration_time=0.05)
    columns = plant.evaluate(np.eye(16), np.zeros((16, 3)))[0].T
    inputs = plant.evaluate(np.zeros((3, 16)), np.eye(3))[0].T
    rows, on_actions = plant.adjoint().pull_back(np.zeros((16, 16)), np.zeros((16, 3)), np.eye(16))
    np.testing.assert_allclose(rows, columns, atol=1e-14)
    np.testing.assert_allclose(on_actions, inputs, atol=1e-14)


def test_it_is_linear_in_the_covector_and_does_not_depend_on_batch():
    plant = shipped("burgers")
    states, actions, rng = somewhere(plant, 5)
    y1, y2 = rng.standard_normal((2, *states.shape))
    one = plant.adjoint()
    both = one.pull_back(states, actions, 2 * y1 - 3 * y2)
    first, second = one.pull_back(states, actions, y1), one.pull_back(states, actions, y2)
    for total, a, b in zip(both, first, second, strict=True):
        np.testing.assert_allclose(total, 2 * a - 3 * b, rtol=0, atol=1e-11 * np.abs(a).max())
    alone = one.pull_back(states[3:4], actions[3:4], y1[3:4])
    for i in range(2):
        assert alone[i][0].tobytes() == first[i][3].tobytes()


def test_a_nonlinearity_without_a_derivative_is_refused_with_the_reason():
    @dataclass(frozen=True, kw_only=True)
    class Kinked(Burgers):
        name = "kinked"

        @staticmethod
        def nonlinearity(u: float) -> float:
            return abs(u) * u

    @dataclass(frozen=True, kw_only=True)
    class Branching(Burgers):
        name = "branching"

        @staticmethod
        def nonlinearity(u: float) -> float:
            return u * u if u > 0 else 0.0

    grid = {"n_z": 32, "n_a": 2, "width": 0.2, "horizon": 5}
    for kind in (Kinked, Branching):
        plant = plant_of(kind(), **grid, sample_time=0.05, integration_time=0.0025)
        with pytest.raises(ValueError, match="complex"):
            plant.adjoint()


@pytest.mark.parametrize("problem", [*PROBLEMS, "wave"])
def test_gradients_of_whole_episodes_agree_with_finite_differences(problem):
    """By the policy, the actions and the initial fields; of a linear plant, too."""
    plant = shipped(problem, horizon=25)
    rng = np.random.default_rng(2)
    gradients = Gradients(plant)
    U = np.linalg.qr(rng.standard_normal((plant.n_z, 4)))[0]
    seeds = [3, 1, 4]
    fields = plant.reset(seeds).copy()

    def check(function, at, gradient, h=1e-4):
        direction = rng.standard_normal(at.shape)
        slope = derivative(lambda s: function(at + s * direction).cost, h)
        assert slope == pytest.approx((gradient * direction).sum(), rel=1e-8)

    policy = 0.1 * rng.standard_normal((plant.n_a, 8))
    found = gradients.of_policy(U, policy, seeds)
    check(lambda p: gradients.of_policy(U, p, seeds), policy, found.gradient)
    check(lambda z: gradients.of_policy(U, policy, z), fields, found.of_fields, h=1e-5)
    actions = 0.1 * rng.standard_normal((plant.horizon, 3, plant.n_a))
    found = gradients.of_actions(actions, seeds)
    check(lambda a: gradients.of_actions(a, seeds), actions, found.gradient)
    check(lambda z: gradients.of_actions(actions, z), fields, found.of_fields, h=1e-5)


def test_the_law_of_a_policy_costs_what_the_controller_makes_it_cost():
    """It is the projected law that runs in the loop."""
    plant = shipped("burgers", horizon=40)
    rng = np.random.default_rng(3)
    U = np.linalg.qr(rng.standard_normal((plant.n_z, 3)))[0]
    policy = 0.2 * rng.standard_normal((plant.n_a, 6))
    measured = rollout(plant, projected_law(plant, U, policy), [7, 8]).costs.mean
    found = Gradients(plant).of_policy(U, policy, [7, 8])
    assert found.cost == pytest.approx(measured.mean(), rel=1e-11)


def test_a_rollout_that_diverges_costs_infinity():
    plant = shipped("kdv", horizon=30)
    policy = np.full((plant.n_a, 8), 1e3)
    U = np.linalg.qr(np.random.default_rng(0).standard_normal((plant.n_z, 4)))[0]
    cost, gradient, _ = Gradients(plant).of_policy(U, policy, [0])
    assert cost == np.inf and not gradient.any()
