# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The differential equation behind a plant is found from few rollouts and reproduces them."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.warm_start import warm_start
from loop_interfaces.problem import load_parameters
from loop_method.adapt.simulation import Loop, adjoint_gradient, mismatch
from loop_method.field_models.differential import DifferentialModel, fit_differential
from pdeloop.in_process import LocalPair

N_Z, N_A = 65, 2


def equation(rate: float = 1.0, quadratic: float = -0.5) -> DifferentialModel:
    """z_t = rate (0.02 z_xx + quadratic (z^2)_x) + B a, B of mean 0."""
    k = np.arange(N_Z // 2 + 1)
    B = np.random.default_rng(0).standard_normal((N_Z, N_A))
    B -= B.mean(axis=0)
    symbols = (rate * np.array([-0.02 * k**2, quadratic * 1j * k])).astype(np.complex128)
    return DifferentialModel(symbols, 0.1 * B, np.zeros(N_Z))


def test_one_episode_determines_the_equation() -> None:
    true, rng = equation(rate=0.3), np.random.default_rng(1)
    x = 2.0 * np.pi * np.arange(N_Z) / N_Z
    states, actions = [np.sin(x) + 0.5 * np.cos(2.0 * x)], rng.standard_normal((60, N_A))
    for a in actions:
        states.append(true.step(states[-1], a))
    z = np.array(states)
    model = fit_differential(z[:-1], actions, z[1:])
    np.testing.assert_allclose(model.symbols, true.symbols, atol=5e-3 * np.abs(true.symbols).max())
    np.testing.assert_allclose(model.B, true.B, atol=0.01)
    np.testing.assert_allclose(model.constant, true.constant, atol=0.01)


@pytest.mark.parametrize("quadratic", [0.0, -0.5])
def test_jacobians_are_derivatives_of_the_step_to_second_order_in_its_length(
    quadratic: float,
) -> None:
    rng = np.random.default_rng(2)
    z = np.sin(2.0 * np.pi * np.arange(N_Z) / N_Z + 1.0)
    V = np.eye(N_Z)
    errors = []
    for rate in (0.02, 0.01):
        model, a = equation(rate, quadratic), rate * rng.standard_normal(N_A)
        model = DifferentialModel(model.symbols, rate * model.B, model.constant)
        ends = [model.step(z + s * 1e-6 * V, a[None]) for s in (1.0, -1.0)]
        errors.append(np.abs(model.jacobians(z[None], V)[0] - (ends[0] - ends[1]).T / 2e-6).max())
    if quadratic:
        assert errors[1] < 0.3 * errors[0]
    else:
        assert errors[0] < 1e-8


def test_transposed_is_the_derivative_of_the_step() -> None:
    model, rng = equation(rate=0.1), np.random.default_rng(4)
    z, a, p = (rng.standard_normal((3, n)) for n in (N_Z, N_A, N_Z))
    z = np.fft.irfft(np.fft.rfft(z)[:, :9], N_Z)
    along, more = np.fft.irfft(np.fft.rfft(p)[:, :9], N_Z), rng.standard_normal((3, N_A))
    ends = [model.step(z + s * 1e-5 * along, a + s * 1e-5 * more) for s in (1.0, -1.0)]
    found, of_actions = model.transposed(z, a, p)
    expected = np.sum(p * (ends[0] - ends[1]), axis=1) / 2e-5
    np.testing.assert_allclose(
        np.sum(found * along, axis=1) + np.sum(of_actions * more, axis=1), expected, rtol=1e-3
    )


@pytest.mark.parametrize("limit", [0.0, 0.1])
def test_adjoint_gradient_is_that_of_the_simulated_cost(limit: float) -> None:
    model, x = equation(rate=0.1), 2.0 * np.pi * np.arange(N_Z) / N_Z
    U = np.linalg.qr(np.stack([np.cos(x), np.sin(x)], axis=1))[0]
    loop = Loop(U, 0.1 * np.cos(x), 1.0, 2.0, 30, limit)
    fields = np.stack([np.sin(x) + 0.5 * np.cos(2.0 * x), np.cos(x - 1.0)])
    theta = 0.05 * np.random.default_rng(6).standard_normal((N_A, 3))
    found = adjoint_gradient(loop, model, theta, loop.simulate(model, theta, fields))
    changes = 1e-5 * np.eye(theta.size).reshape(-1, *theta.shape)
    costs = [[loop.simulate(model, theta + s * d, fields).cost for s in (1, -1)] for d in changes]
    expected = np.array([plus - minus for plus, minus in costs]) / 2e-5
    np.testing.assert_allclose(found, expected, atol=2e-3 * np.abs(expected).max())


def test_samples_at_rest_do_not_decide_about_the_actuators() -> None:
    true, rng = equation(rate=0.3), np.random.default_rng(5)
    x = 2.0 * np.pi * np.arange(N_Z) / N_Z

    def episode(steps: int, gains: float, noise: float) -> tuple[np.ndarray, ...]:
        """z, a and z after; random actions where there are no gains."""
        states, actions = [np.sin(x) + 0.5 * np.cos(2.0 * x)], []
        for _ in range(steps):
            law = -gains * true.B.T @ states[-1]
            actions.append(law if gains else rng.standard_normal(N_A))
            states.append(true.step(states[-1], actions[-1]))
        z = np.array(states) + noise * rng.standard_normal((steps + 1, N_Z))
        return z[:-1], np.array(actions), z[1:]

    exploration, to_rest = episode(60, 0.0, 0.0), episode(400, 1.0, 1e-3)
    pooled = (np.concatenate(parts) for parts in zip(exploration, to_rest, strict=True))
    np.testing.assert_allclose(fit_differential(*pooled).B, true.B, atol=0.01)


def test_burgers_is_recognised_and_simulated_where_fronts_cross_six_points_a_sample() -> None:
    values = load_parameters("burgers", {"optimizer": "gauss_newton"})
    pair = LocalPair(values)
    plant, training = pair.plant, warm_start(values, pair)
    context = training._context(0)
    assert context is not None
    rollouts = [context.exploration, *context.measured]
    z, after = (
        np.concatenate([r.states[part] for r in rollouts]) for part in (slice(-1), slice(1, None))
    )
    model = fit_differential(z, np.concatenate([r.actions for r in rollouts]), after)
    k = 2.0 * np.pi * np.arange(plant.n_z // 2 + 1)
    for found, true in zip(model.symbols, (-1e-4 * k**2, -0.5j * k), strict=True):
        np.testing.assert_allclose(found / plant.sample_time, true, atol=0.1 * np.abs(true).max())
    q, r = context.state_weight, context.action_weight
    loop = Loop(context.U, context.target, q, r, context.horizon, 0.0)
    measured = [(loop.theta(m.policy), m.acted_from) for m in context.measured]
    assert mismatch(loop, model, measured, 1.0) < 0.01
