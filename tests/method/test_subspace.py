# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Subspace identification: the model of a plant of which little is measured, and its law."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy import linalg

from pdeloop.messages.cost import Cost
from pdeloop.messages.model_rows import pack, unpack
from pdeloop.method.design.lqg import kalman_filter, law_of_innovations
from pdeloop.method.design.lqt import DesignError, track_outputs
from pdeloop.method.laws import Observer
from pdeloop.method.reduce.channels import Channels
from pdeloop.method.reduce.identifiability import NotIdentifiableError
from pdeloop.method.reduce.subspace import InnovationModel, subspace_model

N, N_A, N_Y = 4, 2, 3
RNG = np.random.default_rng(2)
A = RNG.standard_normal((N, N))
A *= 0.95 / np.abs(linalg.eigvals(A)).max()
B = np.diag([2.0, 1.0, 0.2, 3.0])[:, :N_A]  # unequal actuators
C = RNG.standard_normal((N_Y, N))
W, V = 0.05 * np.eye(N), 0.1 * np.eye(N_Y)
Q, R = 1.0, 0.3


@cache
def measured(steps: int = 3000) -> list[tuple[np.ndarray, np.ndarray]]:
    """Two trajectories with white actions."""
    found, rng = [], np.random.default_rng(7)
    for _ in range(2):
        x, a = rng.standard_normal(N), rng.standard_normal((steps, N_A))
        y = []
        for k in range(steps + 1):
            y.append(C @ x + np.sqrt(V) @ rng.standard_normal(N_Y))
            if k < steps:
                x = A @ x + B @ a[k] + np.sqrt(W) @ rng.standard_normal(N)
        found.append((np.array(y), a))
    return found


@cache
def identified() -> InnovationModel:
    return subspace_model(measured(), order=N)


def test_it_finds_the_response_to_actions_and_the_innovations_of_the_kalman_filter() -> None:
    model, true = identified(), kalman_filter(A, C, W, V)
    power, own = np.eye(N), np.eye(N)
    for _ in range(6):
        expected = C @ power @ B
        found = model.U @ model.C @ own @ model.B
        assert np.linalg.norm(found - expected) < 0.05 * np.linalg.norm(C @ B)
        power, own = A @ power, model.A @ own
    expected = C @ true.P @ C.T + V
    found = model.U @ model.innovations @ model.U.T
    np.testing.assert_allclose(found, expected, atol=0.05 * np.trace(expected))
    assert np.abs(linalg.eigvals(model.A - model.G @ model.C)).max() < 1.0


def cost_of(law: Observer) -> float:
    """What the law costs in the long run on the true plant, about the target 0."""
    p, U = law.parts(law.theta_start), law.model.U
    into_s = U.T @ C
    acts = np.hstack([p["D"] @ into_s, p["K"]])
    matrix = np.block([[A, np.zeros((N, len(U.T)))], [p["G"] @ into_s, p["F"]]])
    matrix += np.vstack([B, law.model.B]) @ acts
    noisy = np.vstack([B @ p["D"], p["G"] + law.model.B @ p["D"]]) @ U.T
    into = np.hstack([np.vstack([np.eye(N), np.zeros((len(U.T), N))]), noisy])
    moments = linalg.solve_discrete_lyapunov(matrix, into @ linalg.block_diag(W, V) @ into.T)
    own = p["D"] @ U.T
    action = acts @ moments @ acts.T + own @ V @ own.T
    return float(Q * np.trace(C @ moments[:N, :N] @ C.T) + R * np.trace(action))


def test_its_law_costs_what_lqg_with_the_true_plant_costs() -> None:
    cost = Cost(N_Y, N_A, 1, state_weight=Q, action_weight=R)
    law = law_of_innovations(identified(), np.zeros(N_Y), cost)
    found, true = cost_of(Observer(law, 10)), kalman_filter(A, C, W, V)
    gains = track_outputs(A, B, C, cost)
    error = (np.eye(N) - true.M @ C) @ true.P
    S = R * np.eye(N_A) + B.T @ gains.P @ B
    optimum = np.trace(gains.P @ W) + np.trace(gains.K_a.T @ S @ gains.K_a @ error)
    assert optimum <= found * (1 + 1e-9) and found < 1.02 * optimum


def test_its_offset_is_kept_where_the_reduced_target_is_0() -> None:
    """Against a drift, and to the target of the actions: at rest no other offset costs less."""
    model, a_r = replace(identified(), d=np.array([0.5, -1.0, 0.3, 0.2])), np.array([0.4, -0.2])
    cost = Cost(N_Y, N_A, 1, state_weight=Q, action_weight=R, action_target=a_r)
    rows = unpack(pack(law_of_innovations(model, np.zeros(N_Y), cost)), N_A, filtered=True)
    law = Observer(rows, 10)
    b = law.parts(law.theta_start)["b"]

    def at_rest(b: np.ndarray) -> float:
        x = linalg.solve(np.eye(N) - rows.A - rows.B @ rows.K_a, rows.B @ b + rows.d)
        y, a = model.U @ model.C @ x, rows.K_a @ x + b - a_r
        return float(Q * y @ y + R * a @ a)

    assert not rows.s_r.any()
    for step in 1e-3 * np.eye(N_A):
        up, down = at_rest(b + step) - at_rest(b), at_rest(b - step) - at_rest(b)
        assert up == pytest.approx(down, rel=1e-6) and up > 0.0


def test_the_order_and_the_past_are_those_of_the_least_error_on_held_out_measurements() -> None:
    trajectories = [(z[:801], a[:800]) for z, a in measured()]
    found = subspace_model(trajectories)
    assert len(found.A) == N and found.past > 1
    assert 0.0 < found.error < 1.0
    # Fewer readings than states, with as much past as that needs.
    few = subspace_model([(z[:, :1], a) for z, a in trajectories], order=N)
    assert len(few.A) == N and few.U.shape == (1, 1) and few.past >= N


def test_a_past_that_is_given_keeps_the_order_on_fewer_data() -> None:
    """A past may be as long as the log from which it was chosen allows, but not its parts."""
    turn = 0.98 * np.array([[np.cos(0.3), np.sin(0.3)], [-np.sin(0.3), np.cos(0.3)]])
    a, y = np.random.default_rng(4).standard_normal((300, 1)), np.zeros((301, 2))
    for k in range(300):
        y[k + 1] = turn @ y[k] + [0.0, a[k, 0]]
    model = subspace_model([(y, a)], order=2, past=36, constant=True, simulations=True)
    np.testing.assert_allclose(np.abs(np.linalg.eigvals(model.A)), 0.98, atol=1e-3)


def test_waves_that_hardly_decay_get_as_many_states_and_a_long_past() -> None:
    """Thirty oscillators, which no model of 48 states predicts."""
    rng, angles = np.random.default_rng(3), np.linspace(0.1, 3.0, 30)
    turns = [[[np.cos(t), -np.sin(t)], [np.sin(t), np.cos(t)]] for t in angles]
    own = 0.999 * linalg.block_diag(*turns)
    moved, seen = rng.standard_normal((60, 3)), rng.standard_normal((4, 60)) / 8
    data = []
    for _ in range(2):
        x, a, y = rng.standard_normal(60), rng.standard_normal((600, 3)), []
        for k in range(601):
            y.append(seen @ x + 0.02 * rng.standard_normal(4))
            x = own @ x + moved @ a[min(k, 599)]
        data.append((np.array(y), a))
    model = subspace_model(data)
    assert len(model.A) == 64 and model.past == 16
    found = np.abs(linalg.eigvals(model.A)).max()
    assert found == pytest.approx(0.999, abs=2e-3)


def test_data_that_do_not_determine_it_are_refused_by_name() -> None:
    z, a = measured()[0]
    with pytest.raises(
        NotIdentifiableError, match="4 steps do not determine a model with 2 inputs"
    ):
        subspace_model([(z[:5], a[:4])])
    with pytest.raises(NotIdentifiableError, match="the input valve never moved"):
        still = a * [1.0, 0.0]
        subspace_model([(z, still)], order=N, channels=Channels(inputs=("pump", "valve")))
    blind = InnovationModel(
        np.diag([1.1, 0.5]),
        np.ones((2, 1)),
        np.eye(2)[1:],
        np.ones((2, 1)),
        np.eye(1),
        np.eye(1),
        2,
    )
    with pytest.raises(DesignError, match=r"do not observe a mode that grows by the factor 1\.1"):
        law_of_innovations(
            blind, np.zeros(1), Cost(1, blind.B.shape[1], 1, state_weight=Q, action_weight=R)
        )


def test_a_stable_machine_at_ambient_temperature_is_stable() -> None:
    """Five states, three thermocouples at 20 to 22 degC, two heaters that are on half of the time."""
    rng = np.random.default_rng(5)
    A = np.diag([0.97, 0.93, 0.85, 0.6, 0.3])
    A[0, 1], A[1, 2] = 0.1, 0.08
    B, C = 0.3 * rng.standard_normal((5, 2)), rng.standard_normal((3, 5))
    u, x, y = np.repeat(rng.uniform(0.0, 5.0, (120, 2)), 5, 0), np.zeros(5), np.empty((600, 3))
    for k in range(600):
        y[k] = C @ x + 0.005 * rng.standard_normal(3) + [20.0, 21.0, 22.0]
        x = A @ x + B @ u[k] + 0.001 * rng.standard_normal(5)
    model = subspace_model([(y, u[:-1])], order=5, constant=True)
    poles = np.sort(np.abs(np.linalg.eigvals(model.A)))[::-1]
    np.testing.assert_allclose(poles[:3], [0.97, 0.93, 0.85], atol=0.02)
    assert model.d is not None
    # At rest, with the heaters off, it predicts the ambient temperature.
    rest = model.U @ model.C @ np.linalg.solve(np.eye(len(A)) - model.A, model.d)
    np.testing.assert_allclose(rest, [20.0, 21.0, 22.0], atol=0.2)
