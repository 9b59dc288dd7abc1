# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Convolution models are found from one episode, and a law improved on one is a minimum there."""

from __future__ import annotations

import numpy as np
import pytest

from loop_method.adapt.simulation import Loop, improve, mismatch, mismatch_of_pieces
from loop_method.field_models.convolution import ConvolutionModel, fit_convolutions

Array = np.ndarray
N_Z, N_A, STEPS = 16, 3, 60


def plant(seed: int = 0, cubic: float = -0.3) -> ConvolutionModel:
    """Damped transport with a reaction, whatever the place on the domain."""
    wavenumbers = np.arange(N_Z // 2 + 1)
    linear = 1.04 * np.exp(-0.004 * wavenumbers**2 + 0.1j * wavenumbers)
    # Of an even number of points the highest wavenumber has a real symbol.
    linear[-1] = abs(linear[-1])
    symbols = np.stack([linear, 0.02j * wavenumbers, cubic + 0.0 * linear])[:, None, None]
    symbols[1, ..., -1] = 0.0
    B = np.random.default_rng(seed).standard_normal((N_Z, N_A))
    return ConvolutionModel(symbols, 0.1 * B, 0.02 * np.ones(N_Z))


def episode(model: ConvolutionModel, seed: int, size: float = 1.0) -> tuple[Array, Array]:
    rng = np.random.default_rng(seed)
    x = 2.0 * np.pi * np.arange(N_Z) / N_Z
    states = [0.4 * np.sin(x + rng.uniform(0, 6)) + 0.2 * rng.standard_normal(N_Z)]
    actions = size * rng.standard_normal((STEPS, N_A))
    for a in actions:
        states.append(model.step(states[-1], a))
    return np.array(states), actions


def coupled_plant(seed: int = 0) -> ConvolutionModel:
    """Two components that drive each other, differently at every wavenumber; the second is moved."""
    turn = 0.1 * np.arange(1, N_Z // 4 + 2)
    symbols = 0.99 * np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
    B = np.random.default_rng(seed).standard_normal((N_Z, N_A))
    B[: N_Z // 2] = 0.0
    return ConvolutionModel(symbols[None].astype(np.complex128), 0.1 * B, 0.02 * np.ones(N_Z))


def fitted(
    states: Array, actions: Array, ridge: float = 1e-14, degree: int = 3, components: int = 1
) -> ConvolutionModel:
    weights = np.ones(len(actions))
    (model,) = fit_convolutions(
        *(states[:-1], actions, states[1:], weights),
        degrees=(degree,),
        ridges=(ridge,),
        components=components,
    )
    return model


def test_one_episode_determines_a_convolution_model() -> None:
    true = plant()
    states, actions = episode(true, 1)
    model = fitted(states, actions)
    np.testing.assert_allclose(model.symbols, true.symbols, atol=1e-4)
    np.testing.assert_allclose(model.B, true.B, atol=1e-5)
    # Also where no data were.
    z, a = episode(true, 2, size=2.0)
    np.testing.assert_allclose(model.step(z[:-1], a), z[1:], atol=1e-4)


def test_one_episode_determines_how_components_drive_each_other() -> None:
    true = coupled_plant()
    model = fitted(*episode(true, 1), degree=1, components=2)
    np.testing.assert_allclose(model.symbols, true.symbols, atol=1e-7)
    z, a = episode(true, 2)
    np.testing.assert_allclose(model.step(z[:-1], a), z[1:], atol=1e-7)


def test_a_shifted_field_has_a_shifted_future() -> None:
    model = plant()
    z = np.random.default_rng(3).standard_normal(N_Z)
    none = np.zeros(N_A)
    for shift in (1, 5):
        ahead = model.step(np.roll(z, shift), none)
        np.testing.assert_allclose(ahead, np.roll(model.step(z, none), shift), atol=1e-13)


@pytest.mark.parametrize("model", [plant(), coupled_plant()])
def test_jacobians_are_derivatives_of_the_step(model: ConvolutionModel) -> None:
    rng = np.random.default_rng(4)
    V = np.linalg.qr(rng.standard_normal((N_Z, 5)))[0]
    z = rng.standard_normal((2, N_Z))
    found = model.jacobians(z, V)
    for k in range(2):
        for j in range(5):
            step = 1e-6 * V[:, j]
            ends = [model.step(z[k] + s * step, np.zeros(N_A)) for s in (1.0, -1.0)]
            np.testing.assert_allclose(found[k, :, j], V.T @ (ends[0] - ends[1]) / 2e-6, atol=1e-7)


def loop(limit: float = 0.0) -> Loop:
    U = np.linalg.qr(np.random.default_rng(5).standard_normal((N_Z, 4)))[0]
    return Loop(U, 0.1 * np.ones(N_Z), 1.0, 0.5, STEPS, limit)


@pytest.mark.parametrize("limit", [0.0, 0.2])
def test_an_improved_law_is_a_minimum_on_the_model(limit: float) -> None:
    model, closed = plant(), loop(limit)
    fields = np.stack([episode(model, seed)[0][0] for seed in (6, 7)])
    start = np.zeros((N_A, 5))
    V = np.hstack([closed.U, np.linalg.qr(closed.U, mode="complete")[0][:, 4:]])
    found = improve(closed, model, start, fields, V, damping=0.0)
    before, after = (closed.simulate(model, t, fields).cost for t in (start, found.theta))
    assert found.fall == pytest.approx(before - after)
    assert after < 0.9 * before
    rng = np.random.default_rng(8)
    for _ in range(20 if not limit else 0):  # with saturated actions it need not be smooth there
        step = 0.1 * rng.standard_normal(start.shape)
        assert closed.simulate(model, found.theta + step, fields).cost > after
    # A trust region that weighs more moves less.
    held = improve(closed, model, start, fields, V, damping=100.0)
    assert np.linalg.norm(held.theta) < 0.5 * np.linalg.norm(found.theta)
    assert closed.simulate(model, held.theta, fields).cost < before


def test_a_model_is_judged_by_the_rollouts_that_it_reproduces() -> None:
    model, closed = plant(), loop()
    theta = 0.1 * np.random.default_rng(9).standard_normal((N_A, 5))
    field = episode(model, 10)[0][:1]
    states = closed.simulate(model, theta, field).states[:, 0]
    assert mismatch(closed, model, [(theta, states)], 9.0) == 0.0
    other = mismatch(closed, plant(cubic=-0.2), [(theta, states)], 9.0)
    assert 1e-6 < other < 1.0
    # One that grows without bound counts as the worst.
    unstable = ConvolutionModel(1.5 * model.symbols, model.B, model.constant)
    assert mismatch(closed, unstable, [(theta, states)], 9.0) == 2.0


def test_a_model_that_is_known_to_be_too_far_off_is_not_simulated_further(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    model, closed = plant(), loop()
    theta = np.zeros((N_A, 5))
    fields = [episode(model, seed)[0][:1] for seed in range(8)]
    measured = [(theta, closed.simulate(model, theta, f).states[:, 0]) for f in fields]
    unstable = ConvolutionModel(1.5 * model.symbols, model.B, model.constant)
    simulated = []
    simulate = Loop.simulate

    def counted(*what: object) -> object:
        simulated.append(what)
        return simulate(*what)  # type: ignore[arg-type]

    monkeypatch.setattr(Loop, "simulate", counted)
    assert 0.05 < mismatch(closed, unstable, measured, 0.05) <= 2.0
    assert len(simulated) == 1
    assert mismatch(closed, unstable, measured, 9.0) == 2.0
    assert len(simulated) == 1 + len(measured)


def test_a_model_of_a_chaotic_plant_reproduces_pieces_alone() -> None:
    def logistic(rate: float) -> ConvolutionModel:
        """z+ = rate z (1 - z) at every point."""
        symbols = rate * np.array([1.0, -1.0])[:, None, None, None] * np.ones(N_Z // 2 + 1)
        return ConvolutionModel(symbols.astype(complex), np.zeros((N_Z, N_A)), np.zeros(N_Z))

    closed, theta = loop(), np.zeros((N_A, 5))
    field = np.random.default_rng(11).uniform(0.1, 0.9, (1, N_Z))
    measured = [(theta, closed.simulate(logistic(3.9), theta, field).states[:, 0])]
    near, far = logistic(3.9001), logistic(3.0)
    assert mismatch(closed, near, measured, 9.0) > 0.1
    assert 0.0 < mismatch_of_pieces(closed, near, measured, 6) < 1e-4
    assert mismatch_of_pieces(closed, far, measured, 6) > 0.1
    assert mismatch_of_pieces(closed, logistic(30.0), measured, 20) == np.inf
