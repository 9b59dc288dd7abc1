# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The driven cavity: exact vortices with their order of convergence, its task, and tracking of it."""

from __future__ import annotations

import numpy as np
import pytest

import pdeloop
from pde_sim_node.plants import DynamicsPlant
from pde_sim_node.plants.cavity import Cavity
from pdeloop.method.design.lqt import track_horizon

NU = 0.05


class Vortices(Cavity):
    """Taylor-Green vortices, whose values at the walls are given: no fluid passes, but it slips."""

    time = 0.0

    def exact(self) -> tuple[np.ndarray, np.ndarray]:
        s = np.pi * self.grid.axes[0].points
        decay = np.exp(-2 * np.pi**2 * self.viscosity * self.time)
        u = decay * np.cos(s)[:, None] * np.sin(s)
        return u, -u.T

    def hold_walls(self, u: np.ndarray, v: np.ndarray, a: np.ndarray) -> None:
        for part, exact in zip((u, v), self.exact(), strict=True):
            for wall in (np.s_[0, :], np.s_[-1, :], np.s_[:, 0], np.s_[:, -1]):
                part[(slice(None), *np.atleast_1d(wall))] = exact[wall]


def test_vortices_decay_as_they_must_at_second_order() -> None:
    """With time steps in proportion to dx^2; the nonlinear term is a gradient that p balances."""
    errors = []
    for points, dt in ((11, 1e-3), (21, 2.5e-4), (41, 6.25e-5)):
        plant = Vortices(points, NU, steps=1, step_time=dt)
        u, v = (part[None] for part in plant.exact())
        for _ in range(round(0.05 / dt)):
            plant.time += dt
            u, v = plant._substep(u, v, np.zeros((1, 1)))
        errors.append(float(np.abs(np.stack([u[0], v[0]]) - np.stack(plant.exact())).max()))
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    assert errors[-1] < 2e-4 and (orders > 1.9).all(), (errors, orders)


def test_its_return_is_that_of_the_task() -> None:
    """PDEControlGym's values with its own reference flow: -37.87, -8.55 and -11.77, and -99.75."""
    plant = DynamicsPlant(Cavity())
    for lid, published in ((0.0, -99.75), (1.0, -37.87), (2.0, -8.55), (3.0, -11.77)):
        episode = pdeloop.rollout(plant, lambda k, z, a=lid: np.full((1, 1), a), [0])
        error = episode.states[1:, 0] - plant.cost.target[1:]
        reward = -0.5 * np.sum(error**2) / 441 - 0.05 * np.sum((episode.actions - 2.0) ** 2)
        assert -episode.costs.total[0] == pytest.approx(reward, rel=1e-12)
        assert reward == pytest.approx(published, rel=0.01)


def test_one_random_episode_gives_the_law_that_no_actions_improve_by_a_thousandth() -> None:
    """The best known inputs return -5.1736: `python -m benchmarks published lid`."""
    cavity = Cavity()
    plant = DynamicsPlant(cavity)
    explored = pdeloop.problem(plant=cavity, exploration_variance=1.0).explore(0)
    with pytest.warns(pdeloop.IdentifiabilityWarning, match="never moved"):
        model = pdeloop.identify(explored, n_s=8, constant=None)
    K, b = track_horizon(model.A, model.B, plant.cost, model.U)
    found = pdeloop.rollout(plant, lambda k, z: (z @ model.U) @ K[k].T + b[k], [0])
    rng = np.random.default_rng(0)
    directions = rng.standard_normal((6, plant.horizon))
    around = found.actions[:, 0, 0] + 0.02 * np.vstack([directions, -directions])
    others = pdeloop.rollout(plant, lambda k, z: around[:, k : k + 1], np.zeros(12, int))
    slope = (others.costs.total[:6] - others.costs.total[6:]) / 0.04
    bend = (others.costs.total[:6] + others.costs.total[6:] - 2 * found.costs.total) / 0.02**2
    assert (bend > 0).all()
    assert (slope**2 / (2 * bend) < 1e-3 * found.costs.total).all()


def test_a_batch_has_the_bits_of_one() -> None:
    plant, alone = (DynamicsPlant(Cavity(steps=5, rms=0.3)) for _ in range(2))
    plant.reset(np.arange(5))
    alone.reset([3])
    for k in range(5):
        actions = np.full((5, 1), 0.5 * k)
        assert np.array_equal(plant.step(actions)[3], alone.step(actions[:1])[0])
    assert plant.totals[3] == alone.totals[0]


def test_a_training_from_one_initial_field_comes_to_the_law_that_looks_ahead() -> None:
    """The affine law has to make do without looking ahead; every episode begins at rest."""
    cavity = Cavity(11, steps=60)
    plant = DynamicsPlant(cavity)
    problem = pdeloop.problem(plant=cavity, exploration_variance=1.0, reduced_order=8, law="affine")
    run = pdeloop.train(problem, rollouts=9, evaluation_fields=1)
    with pytest.warns(pdeloop.IdentifiabilityWarning):
        model = pdeloop.identify(problem.explore(0), n_s=8, constant=None)
    K, b = track_horizon(model.A, model.B, plant.cost, model.U)
    best = pdeloop.rollout(plant, lambda k, z: (z @ model.U) @ K[k].T + b[k], [0]).costs.mean[0]
    assert run.costs["lqt"].mean() > 1.02 * best
    assert best < run.costs["adapted"].mean() < 1.005 * best
