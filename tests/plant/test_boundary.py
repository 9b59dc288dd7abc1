# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Plants controlled through an end, against exact solutions, backstepping and the exact LQR."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import pdeloop
from benchmarks.backstepping import reaction_gain, transport_gain
from pde_sim_node.plants import DynamicsPlant
from pde_sim_node.plants.boundary import ReactionDiffusionBoundary, Transport
from pdeloop.method.design.lqt import track_horizon


def test_what_is_given_at_the_end_is_carried_at_unit_speed_at_first_order() -> None:
    """u = f(x + t) without recirculation."""
    errors = []
    for n in (50, 100, 200):
        plant = Transport(n, strength=0.0, step_time=0.1 / (4 * n))
        f = lambda s: np.exp(-40 * (s - 0.8) ** 2)  # noqa: E731
        z = plant.step(f(plant.x), np.array([f(1.05)]))
        inside = plant.x < 0.85  # what entered meanwhile has not come that far
        errors.append(float(np.abs(z - f(plant.x + 0.1))[inside].max()))
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    assert errors[-1] < 0.02 and (orders > 0.8).all(), (errors, orders)


def test_a_wave_grows_as_it_must_at_second_order() -> None:
    """With beta = strength everywhere sin(pi x) grows at the rate strength - pi^2."""
    errors = []
    for n in (10, 20, 40):
        plant = ReactionDiffusionBoundary(n, strength=12.0, rate=0.0, step_time=1e-3 / n**2)
        z = wave = np.sin(np.pi * plant.x)
        for _ in range(20):
            z = plant.step(z, np.zeros(1))
        errors.append(float(np.abs(z - np.exp(0.02 * (12.0 - np.pi**2)) * wave).max()))
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    assert errors[-1] < 1e-3 and (orders > 1.9).all(), (errors, orders)


@pytest.mark.parametrize(
    ("plant", "gain"),
    [
        (Transport(40, step_time=1e-3), transport_gain),
        (ReactionDiffusionBoundary(40, step_time=1e-4), reaction_gain),
    ],
)
def test_backstepping_stabilises_and_the_finite_horizon_lqr_costs_less(
    plant: Any, gain: Any
) -> None:
    made = DynamicsPlant(plant, horizon=round(5.0 / 0.1) if gain is transport_gain else 300)
    assert np.abs(np.linalg.eigvals(plant.A)).max() > 1.0
    k = gain(plant.beta)
    K, _ = track_horizon(plant.A, plant.B, made.cost, np.eye(made.n_z))
    by_kernel = pdeloop.rollout(made, lambda i, z: z @ k[:, None], [0, 1])
    best = pdeloop.rollout(made, lambda i, z: z @ K[i].T, [0, 1])
    assert np.abs(np.linalg.eigvals(plant.A + plant.B @ k[None])).max() < 1.0
    assert (best.costs.mean < by_kernel.costs.mean).all()
    # The value function of the Riccati recursion is not used in the rollout.
    for sign in (1e-3, -1e-3):
        other = pdeloop.rollout(made, lambda i, z, s=sign: z @ ((1 + s) * K[i].T), [0, 1])
        assert (other.costs.mean > best.costs.mean).all()


def test_transport_ends_in_the_time_that_backstepping_promises() -> None:
    """After a time of 1 all has come in through the end, and is 0 up to the size of a step, dx."""
    left = []
    for n in (100, 200, 400):
        finely = type("Finely", (Transport,), {"sample_time": 1.0 / n})(n, step_time=1.0 / n)
        k, z = transport_gain(finely.beta), np.ones(n + 1)
        for _ in range(round(1.1 * n)):
            z = finely.step(z, k @ z[:, None])
        left.append(float(np.abs(z).max()))
    assert (np.array(left[1:]) < 0.7 * np.array(left[:-1])).all(), left
    assert left[-1] < 0.3 and np.abs(finely.step(np.ones(401), np.ones(1))).max() > 1.0


def test_a_beta_of_ones_own_is_that_of_the_task_where_it_is_the_same() -> None:
    for kind, strength, rate in ((Transport, 5.0, 7.35), (ReactionDiffusionBoundary, 50.0, 8.0)):
        own = kind(beta=lambda x, s=strength, g=rate: s * np.cos(g * np.arccos(x)))
        assert np.array_equal(own.A, kind().A)
        still = kind(
            intervals=20, beta=lambda x: 0.0 * x, step_time=1e-4 if kind is Transport else 1e-5
        )
        assert np.abs(np.linalg.eigvals(still.A)).max() < 1.0  # without beta nothing grows
    with pytest.raises(ValueError, match="beta must be a finite number"):
        Transport(beta=[1.0])
