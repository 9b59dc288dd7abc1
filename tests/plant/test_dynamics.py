# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A plant of a user's own: its states and costs against the formula, its derivatives and copies."""

from __future__ import annotations

import copy
import pickle
import threading
from typing import Any

import numpy as np
import pytest

import pdeloop
from pde_sim_node.definition import described
from pde_sim_node.instruments import InstrumentedPlant
from pde_sim_node.plant import DIVERGED_COST, Instruments, Plant
from pde_sim_node.plants import DynamicsPlant
from pdeloop.unstable_modes import linearisation
from tests.support.linear_dynamics import A, B, Linear


class Batch(Linear):
    batched = True

    def step(self, z: np.ndarray, a: np.ndarray) -> np.ndarray:
        return (A * z[:, None]).sum(axis=2) + (B * a[:, None]).sum(axis=2)


def actions(batch: int, steps: int = 4) -> np.ndarray:
    return np.random.default_rng(3).standard_normal((steps, batch, 2))


@pytest.mark.parametrize("kind", [Linear, Batch])
def test_states_and_costs_are_those_of_the_formula(kind: type[Linear]) -> None:
    plant = DynamicsPlant(kind())
    assert isinstance(plant, Plant)
    z = plant.reset([5, 0, 5]).copy()
    assert np.array_equal(z[0], np.random.default_rng(5).standard_normal(3))
    assert np.array_equal(z[0], z[2]) and not np.array_equal(z[0], z[1])
    total = np.zeros(3)
    for a in actions(3):
        total += 2.0 * ((z - [1, 0, -1]) ** 2).sum(axis=1) + 0.5 * (a**2).sum(axis=1)
        z = z @ A.T + a @ B.T
        np.testing.assert_allclose(plant.step(a), z, rtol=1e-13)
    costs = plant.episode_costs()
    np.testing.assert_allclose(costs.total, total, rtol=1e-13)
    np.testing.assert_allclose(costs.mean, total / 4, rtol=1e-13)
    assert (costs.diverged_step == -1).all()
    with pytest.raises(RuntimeError, match="the episode is over after 4 steps"):
        plant.step(actions(3)[0])


def test_an_environment_is_the_same_to_the_bit_in_every_batch_and_in_evaluate() -> None:
    plant, alone = DynamicsPlant(Linear()), DynamicsPlant(Linear())
    plant.reset([0, 1, 2])
    alone.reset([1])
    for a in actions(3):
        before = plant.states.copy()
        plant.step(a)
        assert np.array_equal(alone.step(a[1:2])[0], plant.states[1])
        assert np.array_equal(plant.evaluate(before, a)[0], plant.states)
    assert plant.totals[1] == alone.totals[0]


def test_what_diverges_keeps_its_state_and_costs_much() -> None:
    plant = DynamicsPlant(Linear(), divergence_bound=3.0)
    plant.reset(np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 2.9]]))
    plant.step(np.zeros((2, 2)))
    states = plant.step(np.array([[0.0, 0.0], [1.0, 0.0]])).copy()
    assert plant.diverged_step.tolist() == [-1, 0]
    assert states[1].tolist() == [0.0, 0.0, 2.9]
    costs = plant.episode_costs()
    assert costs.mean[1] == DIVERGED_COST and costs.mean[0] < 10
    plant.restart(np.array([1]), [7])
    assert plant.diverged_step.tolist() == [-1, -1]
    assert np.array_equal(plant.states[1], np.random.default_rng(7).standard_normal(3))


class Reusing(Linear):
    """Returns the array that it computes in, as solvers do."""

    def __init__(self) -> None:
        super().__init__()
        self.own = np.zeros(3)

    def initial_state(self, rng: np.random.Generator) -> np.ndarray:
        self.own[:] = super().initial_state(rng)
        return self.own

    def step(self, z: np.ndarray, a: np.ndarray) -> np.ndarray:
        self.own[:] = super().step(z, a)
        return self.own


def test_a_plant_may_return_the_array_that_it_computes_the_next_state_in() -> None:
    reusing, plant = DynamicsPlant(Reusing()), DynamicsPlant(Linear())
    assert np.array_equal(reusing.reset([0, 1, 2]), plant.reset([0, 1, 2]))
    for a in actions(3):
        assert np.array_equal(reusing.step(a), plant.step(a))


def test_sizes_may_be_whole_numbers_of_numpy() -> None:
    linear = Linear()
    vars(linear).update(n_z=np.int32(3), n_a=np.int64(2), horizon=np.int16(4))
    plant = DynamicsPlant(linear)
    assert pdeloop.Grid.parse(plant.grid.text) == plant.grid == pdeloop.Grid.vector(3)
    axis = pdeloop.Axis("x", np.float32(2.0), np.int32(5))
    assert pdeloop.Grid.parse(pdeloop.Grid((axis,)).text) == pdeloop.Grid((axis,))


def test_a_state_may_have_the_shape_of_its_grid() -> None:
    class Shaped(pdeloop.Dynamics):
        n_a = 1
        grid = pdeloop.Grid((pdeloop.Axis("y", 1.0, 2), pdeloop.Axis("x", 1.0, 3)), ("u", "v"))

        def initial_state(self, rng: Any) -> Any:
            return np.arange(12.0).reshape(2, 2, 3)

        def step(self, z: Any, a: Any) -> Any:
            return z.reshape(2, 2, 3) + a

    plant = DynamicsPlant(Shaped())
    assert plant.reset([0]).tolist() == [list(range(12))]
    assert plant.step(np.ones((1, 1))).tolist() == [list(range(1, 13))]


def test_the_mean_state_is_the_average_of_a_hundred_draws_unless_it_is_known() -> None:
    drawn = [np.random.default_rng(seed).standard_normal(3) for seed in range(100)]
    assert np.array_equal(DynamicsPlant(Linear()).reset([-1])[0], np.mean(drawn, axis=0))

    class Known(Linear):
        def mean_state(self) -> np.ndarray:
            return np.array([0.0, 0.0, 3.0])

    assert DynamicsPlant(Known()).reset([-1]).tolist() == [[0.0, 0.0, 3.0]]


# Instruments, derivatives and checks, as of any plant


def test_instruments_wrap_it() -> None:
    limited = InstrumentedPlant(
        DynamicsPlant(Linear()), Instruments(action_limit=0.1, sensors=2, measurement_noise=0.01)
    )
    limited.reset([1], np.array([4]))
    plain = DynamicsPlant(Linear())
    plain.reset([1])
    for _ in range(2):
        seen = limited.step(np.array([[5.0, -5.0]]))
        plain.step(np.array([[0.1, -0.1]]))
    assert np.array_equal(limited.states, plain.states)
    assert seen.shape == (1, 2)
    reading = np.sqrt(3 / 2) * plain.states[0, limited.positions]
    assert 0 < np.abs(seen[0] - reading).max() < 0.1
    assert limited.definition.fingerprint != plain.definition.fingerprint


def test_gradients_are_those_of_its_pull_back() -> None:
    given = actions(2)
    found = pdeloop.Gradients(Linear()).of_actions(given, [0, 1])

    def cost(a: np.ndarray) -> float:
        plant = DynamicsPlant(Linear())
        return float(pdeloop.rollout(plant, lambda k, z: a[k], [0, 1]).costs.mean.mean())

    for index in ((0, 0, 1), (2, 1, 0)):
        move = np.zeros_like(given)
        move[index] = 1e-6
        slope = (cost(given + move) - cost(given - move)) / 2e-6
        assert found.gradient[index] == pytest.approx(slope, rel=1e-6)


def test_a_plant_without_derivatives_says_so() -> None:
    class Plain(Linear):
        pull_back = pdeloop.Dynamics.pull_back

    with pytest.raises(
        ValueError, match=r"Plain has no derivatives.* no method pull_back\(z, a, y\)"
    ):
        pdeloop.Gradients(Plain())


def test_the_linearisation_is_that_of_the_formula() -> None:
    found = linearisation(DynamicsPlant(Linear()))
    np.testing.assert_allclose(found[0], A, atol=1e-9)
    np.testing.assert_allclose(found[1], B, atol=1e-9)


# Fingerprints and copies


def test_a_fingerprint_is_of_the_source_and_of_the_arguments() -> None:
    def number(made: pdeloop.Dynamics, **settings: Any) -> int:
        return DynamicsPlant(made, **settings).definition.fingerprint

    known = number(Linear())
    assert number(Linear()) == number(Linear(1.0)) == number(Linear(gain=1.0)) == known
    others = [
        number(Linear(gain=2.0)),
        number(Linear(shape=(1, 3))),
        number(Linear(), horizon=5),
        number(Batch()),
        number(Batch(2.0)),
    ]
    assert len({known, *others}) == 6


def test_an_array_as_argument_has_a_fingerprint_and_what_cannot_be_kept_has_none() -> None:
    first, second = np.arange(3.0), np.array([0.0, 1.0, 2.0 + 2**-50])
    assert described("x", first) == described("x", np.arange(3.0)) != described("x", second)
    with pytest.raises(ValueError, match="the parameter x is a lock, which has no fingerprint"):
        described("x", threading.Lock())


def test_a_plant_can_be_copied_and_pickled() -> None:
    plant = DynamicsPlant(Linear(gain=3.0))
    plant.reset([2])
    plant.step(np.ones((1, 2)))
    copies = copy.deepcopy(plant), pickle.loads(pickle.dumps(plant))
    expected = plant.step(np.ones((1, 2))).copy()
    for again in copies:
        assert np.array_equal(again.step(np.ones((1, 2))), expected)
        assert again.definition.fingerprint == plant.definition.fingerprint
