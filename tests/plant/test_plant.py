# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The plant: against controlgym, exact solutions, conservation laws, and itself to the last bit."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pde_sim_node.equations import AllenCahn, Burgers, Equation, KortewegDeVries, Schrodinger
from pde_sim_node.plant import DIVERGED_COST
from pde_sim_node.plants import SpectralPlant
from pdeloop.solver import workers
from pdeloop.solver.kernel import fine_length
from pdeloop.solver.reference import ReferenceStep
from pdeloop.training_run import load_compiled, resolve
from tests.support.interpreter import python
from tests.support.small import SMALL
from tests.support.spectral_plants import P1, P2, P3, P10, PROBLEMS, make, unforced

DATA = Path(__file__).parents[1] / "data"


# Against controlgym 1.0.0


@pytest.mark.parametrize(
    ("file", "equation", "grid", "action_weight"),
    [("burgers", Burgers(), P1, 1.0), ("allen_cahn", AllenCahn(), P2, 0.1)],
)
def test_trajectory_costs_and_supports_are_controlgyms(
    file: str, equation: Equation, grid: dict, action_weight: float
) -> None:
    golden = np.load(DATA / f"controlgym_{file}.npz")
    plant = make(equation, **grid, action_weight=action_weight)
    assert np.array_equal(plant.supports, golden["supports"])
    z, total = golden["states"][:1], 0.0
    for k, action in enumerate(golden["actions"]):
        z, cost = plant.evaluate(z, action[None])
        np.testing.assert_allclose(z[0], golden["states"][k + 1], rtol=0, atol=1e-9)
        np.testing.assert_allclose(cost[0], golden["stage_costs"][k], rtol=1e-9)
        total += cost[0]
    np.testing.assert_allclose(total, golden["stage_costs"].sum(), rtol=1e-9)


# Against plain NumPy, on grids of all kinds: powers of two, with threes, prime halves


@pytest.mark.parametrize(
    "n_z", [8, 10, 16, 22, 30, 48, 62, 64, 96, 100, 128, 144, 202, 256, 288, 512]
)
@pytest.mark.parametrize(
    "equation", [Burgers(viscosity=1e-2), AllenCahn(), KortewegDeVries()], ids=lambda e: e.name
)
def test_every_even_grid_agrees_with_plain_numpy(equation: Equation, n_z: int) -> None:
    fine = 2 * fine_length(n_z)
    assert fine >= 1.5 * n_z
    plant = make(equation, n_z=n_z, n_a=2, width=0.3, sample_time=0.004, integration_time=0.001)
    reference = ReferenceStep(equation, plant.supports, integration_time=0.001, steps=4, fine=fine)
    z, actions = plant.reset([0, 1, -1]).copy(), np.array([[1.0, -2.0], [0.5, 0.0], [-1.0, 3.0]])
    for _ in range(3):
        z = reference(z, actions)
        np.testing.assert_allclose(plant.step(actions), z, atol=1e-12)


def test_the_problems_are_dealiased_on_three_halves_of_the_grid() -> None:
    assert [2 * fine_length(n_z) for n_z in (128, 256)] == [192, 384]


# Against exact solutions


def test_a_soliton_travels() -> None:
    alpha, time = 2.0, 2.0
    plant = make(
        KortewegDeVries(length=60.0, alpha_min=alpha, alpha_max=alpha),
        n_z=512, n_a=1, width=0.5, sample_time=0.1, integration_time=0.001,
    )  # fmt: skip
    z = unforced(plant, 20)[-1]
    y = np.sqrt(alpha) / 2 * (plant.x - 30.0 - alpha * time)
    np.testing.assert_allclose(z, -alpha / 2 / np.cosh(y) ** 2, atol=1e-8)


def test_a_uniform_allen_cahn_field_follows_its_ordinary_equation() -> None:
    """u' = V (u - u^3) has u(t) = (1 + (1/u0^2 - 1) exp(-2 V t))^(-1/2); -1, 0 and 1 are at rest."""
    plant = make(AllenCahn(), n_z=32, n_a=1, width=0.5, sample_time=0.1, integration_time=0.001)
    u0 = np.array([-1.0, 0.0, 1.0, 0.2, -0.7, 1.5])
    z, _ = plant.evaluate(np.tile(u0[:, None], 32), np.zeros((6, 1)))
    moving = u0 != 0
    u = np.zeros(6)
    u[moving] = np.sign(u0[moving]) / np.sqrt(1 + (u0[moving] ** -2.0 - 1) * np.exp(-1.0))
    np.testing.assert_allclose(z, np.tile(u[:, None], 32), atol=1e-10)
    np.testing.assert_allclose(z[:3], np.tile(u0[:3, None], 32), atol=1e-14)


# Conservation


@pytest.mark.parametrize(
    ("equation", "grid"), [(Burgers(), P1), (KortewegDeVries(), P3)], ids=["burgers", "kdv"]
)
def test_the_mean_is_conserved_or_grows_by_the_forcing(equation: Equation, grid: dict) -> None:
    plant = make(equation, **grid)
    z = plant.reset([3, 4]).copy()
    actions = np.array([np.zeros(plant.n_a), np.linspace(-1, 2, plant.n_a)])
    rate = actions @ plant.supports.mean(axis=0)
    for k in range(1, 21):
        new = plant.step(actions)
        expected = z.mean(axis=1) + k * plant.sample_time * rate
        np.testing.assert_allclose(new.mean(axis=1), expected, atol=1e-14)


def test_kdv_conserves_momentum_to_the_order_of_the_scheme() -> None:
    def drift(integration_time: float) -> float:
        plant = make(
            KortewegDeVries(), **(P3 | {"sample_time": 0.1, "integration_time": integration_time})
        )
        before = np.sum(plant.reset([-1])[0] ** 2)
        return float(abs(np.sum(unforced(plant, 10)[-1] ** 2) / before - 1))

    coarse, fine = drift(0.01), drift(0.005)
    assert coarse < 1e-4
    assert fine < coarse / 14
    assert drift(0.001) < 1e-9


def test_burgers_loses_energy() -> None:
    plant = make(Burgers(viscosity=1e-2), **P1)
    energy = np.sum(unforced(plant, 20) ** 2, axis=1)
    assert np.all(np.diff(energy) < 0)


# To the last bit


def rollout(plant: SpectralPlant, seeds: list[int], steps: int = 4) -> dict[int, bytes]:
    """States and costs of an episode, by seed; the actions of an environment depend on its seed."""
    draws = [np.random.default_rng(100 + seed).normal(0, 0.3, (steps, plant.n_a)) for seed in seeds]
    history = [plant.reset(seeds).copy()]
    history += [plant.step(np.array([a[k] for a in draws])).copy() for k in range(steps)]
    costs = plant.episode_costs()
    states = np.array(history)
    return {
        seed: states[:, i].tobytes() + costs.mean[i].tobytes() + costs.total[i].tobytes()
        for i, seed in enumerate(seeds)
    }


@PROBLEMS
def test_batch_place_and_threads_change_no_bit(
    equation: Equation, grid: dict, monkeypatch: pytest.MonkeyPatch
) -> None:
    seeds = list(range(64))
    plant = make(equation, **grid)
    alone = {seed: rollout(plant, [seed])[seed] for seed in seeds}
    for batch in (2, 3, 7, 12, 64):
        assert all(alone[s] == bits for s, bits in rollout(plant, seeds[:batch]).items())
    shuffled = [int(s) for s in np.random.default_rng(0).permutation(seeds)]
    assert rollout(plant, shuffled) == alone
    monkeypatch.setattr(workers, "solver_threads", workers.SolverThreads())
    workers.use_cores(range(3))
    monkeypatch.setattr(workers, "SHARED_POINTS", 1)
    threaded = make(equation, **grid)
    for batch in (3, 7, 64):
        assert all(alone[s] == bits for s, bits in rollout(threaded, shuffled[:batch]).items())


def digest() -> str:
    found = hashlib.sha256()
    for equation, grid in (
        (Burgers(), P1),
        (AllenCahn(), P2),
        (KortewegDeVries(), P3),
        (Schrodinger(), P10),
    ):
        for bits in rollout(make(equation, **grid), [5, 0, 9]).values():
            found.update(bits)
    return found.hexdigest()


def test_another_process_gives_the_same_bits() -> None:
    done = python("-c", "from tests.plant.test_plant import digest; print(digest())")
    assert done.stdout.split()[-1] == digest()


def test_a_step_depends_on_the_published_state_alone() -> None:
    plant = make(KortewegDeVries(), **P3, action_weight=0.5)
    before = plant.reset([1, 2]).copy()
    total = np.zeros(2)
    for k in range(5):
        actions = np.full((2, 10), 0.1 * k)
        expected, costs = plant.evaluate(before, actions)
        total += costs
        assert np.array_equal(plant.step(actions), expected)
        by_hand = np.sum((before - plant.target) ** 2, axis=1) + 0.5 * np.sum(actions**2, axis=1)
        np.testing.assert_allclose(costs, by_hand, rtol=1e-13)
        before = expected
    assert np.array_equal(plant.episode_costs().total, total)
    assert np.array_equal(plant.episode_costs().mean, total / 5)


# Episodes


def test_seeds_and_the_mean_field() -> None:
    plant = make(Burgers(), **P1)
    z = plant.reset(np.array([7, -1, 7, 8]))
    assert np.array_equal(z[0], z[2])
    assert not np.array_equal(z[0], z[3])
    assert np.array_equal(z[1], Burgers().initial_field(plant.x, None))
    assert np.array_equal(z[0], Burgers().initial_field(plant.x, np.random.default_rng(7)))
    assert (plant.batch, plant.step_index) == (4, 0)


def test_an_episode_ends_at_its_horizon_and_a_reset_begins_another() -> None:
    plant = make(AllenCahn(), **(P2 | {"horizon": 2}))
    with pytest.raises(RuntimeError, match="reset"):
        plant.step(np.zeros((1, 12)))
    plant.reset([0])
    plant.step(np.ones((1, 12)))
    plant.step(np.ones((1, 12)))
    first = plant.episode_costs()
    with pytest.raises(RuntimeError, match="over after 2 steps"):
        plant.step(np.ones((1, 12)))
    plant.reset([0, 0, 0])
    assert plant.step(np.ones((3, 12))).shape == (3, 256)
    plant.step(np.ones((3, 12)))
    assert np.array_equal(plant.episode_costs().mean, np.repeat(first.mean, 3))


def test_divergence_stops_one_environment_and_touches_no_other() -> None:
    plant = make(Burgers(), **P1)
    quiet, kick = np.full(6, 0.2), np.full(6, 0.2)
    kick[2] = 1e5
    plant.reset([4])
    alone = [plant.step(quiet[None])[0].copy() for _ in range(4)]
    plant.reset([4, 4, 4])
    plant.step(np.array([quiet, quiet, quiet]))
    last_valid = plant.states[1].copy()
    plant.step(np.array([quiet, kick, quiet]))
    plant.step(np.array([quiet, quiet, quiet]))
    plant.step(np.array([quiet, kick, 1e300 * quiet]))
    assert np.array_equal(plant.states[0], alone[3])
    assert np.array_equal(plant.states[1], last_valid)
    assert np.array_equal(plant.states[2], alone[2])
    costs = plant.episode_costs()
    assert costs.diverged_step.dtype == np.int64
    assert costs.diverged_step.tolist() == [-1, 1, 3]
    assert costs.mean[1:].tolist() == [DIVERGED_COST] * 2
    assert costs.total[1:].tolist() == [DIVERGED_COST * 50] * 2
    assert costs.mean[0] == costs.total[0] / 4
    # What a diverged environment left in the scratch must not reach the next.
    plant.reset([4])
    assert all(np.array_equal(plant.step(quiet[None])[0], z) for z in alone)
    assert plant.episode_costs().diverged_step.tolist() == [-1]


def test_a_state_beyond_the_bound_has_diverged() -> None:
    plant = make(AllenCahn(), **P2, divergence_bound=1.05)
    plant.reset([0])
    for _ in range(50):
        plant.step(np.full((1, 12), 20.0))
    assert 0 <= plant.episode_costs().diverged_step[0] < 50
    assert np.abs(plant.states).max() <= 1.2


def test_no_costs_before_the_first_step() -> None:
    plant = make(AllenCahn(), **P2)
    plant.reset([0, 1])
    assert plant.episode_costs().mean.tolist() == [0.0, 0.0]


# Refusals


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"n_z": 127}, "n_z must be even, got 127: take 128"),
        ({"n_z": 6}, "n_z must be at least 8, got 6"),
        ({"n_z": 128.0}, "n_z must be a whole number, got 128.0"),
        ({"n_a": 0}, "n_a must be at least 1"),
        ({"width": 0.2}, r"width \* n_a must not exceed 1, got 0.2 \* 6"),
        ({"n_a": 128, "width": 0.001}, "width 0.001 gives actuator 0 no grid point"),
        ({"width": -0.1}, "width must be positive and finite, got -0.1"),
        ({"sample_time": 0.051}, "sample_time must be a whole multiple of integration_time"),
        ({"sample_time": 0.001}, "sample_time must be a whole multiple of integration_time"),
        ({"sample_time": 0.0}, "sample_time must be positive and finite"),
        ({"integration_time": float("nan")}, "integration_time must be positive and finite"),
        ({"horizon": 0}, "horizon must be at least 1"),
        ({"state_weight": 0.0}, "state_weight must be positive"),
        ({"action_weight": float("inf")}, "action_weight must be positive and finite"),
        ({"divergence_bound": -1.0}, "divergence_bound must be positive"),
    ],
)
def test_unusable_parameters_are_refused(values: dict, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        make(Burgers(), **(P1 | values))


def test_internal_steps_are_counted_by_rounding() -> None:
    """0.01 // 0.00001 is 999 in floating point: one step too few for the exact linear part."""
    plant = make(AllenCahn(), **(P2 | {"integration_time": 0.00001}))
    exact, _ = make(AllenCahn(), **(P2 | {"integration_time": 0.0001})).evaluate(
        plant.reset([-1]), np.zeros((1, 12))
    )
    np.testing.assert_allclose(plant.step(np.zeros((1, 12))), exact, atol=1e-9)


@pytest.mark.parametrize("seeds", [3, [[1, 2]], [], [0.5], [1, -2]])
def test_unusable_seeds_are_refused_and_change_nothing(seeds: Any) -> None:
    plant = make(AllenCahn(), **P2)
    before = plant.reset([5]).copy()
    plant.step(np.zeros((1, 12)))
    with pytest.raises(ValueError, match=r"seeds must be|initial fields must"):
        plant.reset(np.array(seeds))
    assert plant.step_index == 1
    assert not np.array_equal(plant.states, before)


@pytest.mark.parametrize(
    ("actions", "words"),
    [
        (np.zeros((1, 12)), r"actions must have shape \(2, 12\), got \(1, 12\)"),
        (np.zeros(12), "actions must have shape"),
        (np.full((2, 12), np.nan), "actions must be finite"),
        (np.full((2, 12), -np.inf), "actions must be finite"),
    ],
)
def test_unusable_actions_are_refused_and_change_nothing(actions: np.ndarray, words: str) -> None:
    plant = make(AllenCahn(), **P2)
    before = plant.reset([5, 6]).copy()
    with pytest.raises(ValueError, match=words):
        plant.step(actions)
    assert np.array_equal(plant.states, before)
    assert plant.step_index == 0
    assert plant.episode_costs().total.tolist() == [0.0, 0.0]


def test_a_second_plant_does_not_compile_again() -> None:
    one, other = (make(Burgers(), **P1).parallel for _ in range(2))
    assert one.code == other.code
    assert one.plans["pointwise"][0] == other.plans["pointwise"][0]


COMPILED_AGAIN = """
from numba.core import event

made = []

class Seen(event.Listener):
    def on_start(self, event):
        made.append(event.data["dispatcher"].py_func.__name__.split("-")[0])

    def on_end(self, event):
        pass

event.register("numba:compile", Seen())
from pdeloop.training_run import load_compiled, resolve
from tests.support.small import SMALL

load_compiled(resolve(str(SMALL), {}))
print(*made)
"""


def test_what_a_training_runs_on_is_compiled_once_for_all_processes() -> None:
    load_compiled(resolve(str(SMALL), {}))
    again = set(python("-c", COMPILED_AGAIN).stdout.split())
    assert again & {"environments", "advance", "integrate", "control", "respond", "act"} == set()
