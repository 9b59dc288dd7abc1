# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Plans on a model: their gradient, the optimum of a linear plant, bounds, and a target over time."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import linalg
from scipy.optimize import LinearConstraint, minimize

from pdeloop.messages.action_set import ActionSet
from pdeloop.messages.arrays import Array
from pdeloop.messages.cost import Cost
from pdeloop.method.laws.plans import Planner
from pdeloop.method.models.base import FieldModel
from pdeloop.method.models.finite_difference import Feature, FiniteDifferenceModel, of_features
from pdeloop.method.models.linear import LinearModel
from pdeloop.method.models.spectral import SpectralModel
from pdeloop.method.models.sweep import SpectralSweep, Sweep

N_Z, N_A, T = 16, 2, 30


def linear(seed: int = 0, n_z: int = N_Z, radius: float = 1.1) -> LinearModel:
    rng = np.random.default_rng(seed)
    A = rng.standard_normal((n_z, n_z))
    A *= radius / np.abs(np.linalg.eigvals(A)).max()
    return LinearModel("linear", A, rng.standard_normal((n_z, N_A)), np.zeros(n_z))


def spectral() -> SpectralModel:
    """Burgers with a linear instability, in fewer steps where the field is small."""
    k = 1j * np.arange(N_Z // 2 + 1)
    B = np.random.default_rng(1).standard_normal((N_Z, N_A))
    few = np.array([[0.8, 2.0]])
    linear, polynomials = 0.05 + 0.05 * k**2, np.array([[-0.1]])
    return SpectralModel("poly2", linear, k[None], polynomials, B, np.full(N_Z, 0.02), 4, 3.0, few)


def differences() -> FiniteDifferenceModel:
    features = Feature((0,)), Feature((0,), 2), Feature((0, 0, 0))
    C = np.tile(np.array([0.3, 0.1, -0.2])[:, None, None], (1, 1, N_Z))
    B = 0.3 * np.random.default_rng(1).standard_normal((N_Z, N_A))
    return of_features("x-shared", features, C, B, np.full(N_Z, 0.02), 3)


def planner(model: FieldModel, cost: Cost | None = None, **changed: object) -> Planner:
    rng = np.random.default_rng(2)
    given = {
        "cost": cost or Cost(model.n_z, N_A, T, action_weight=0.5, target=0.3),
        "action_set": ActionSet(N_A),
        "K": 0.05 * rng.standard_normal((N_A, model.n_z)),
        "b": 0.1 * rng.standard_normal(N_A),
        "around": True,
        "steps": 12,
        "terminal": True,
    }
    return Planner(model, **{**given, **changed})  # type: ignore[arg-type]


def general_cost(horizon: int = T) -> Cost:
    """Matrices, outputs, a target over time and one of the actions, and a terminal weight."""
    rng = np.random.default_rng(3)
    C, root = rng.standard_normal((5, N_Z)), rng.standard_normal((2, 2))
    return Cost(
        N_Z,
        N_A,
        horizon,
        state_weight=np.arange(1.0, 6.0),
        action_weight=root @ root.T + np.eye(2),
        target=rng.standard_normal((horizon, 5)),
        output=C,
        action_target=[0.2, -0.1],
        terminal_weight=2.0,
    )


@pytest.mark.parametrize("k", [0, T - 12])
@pytest.mark.parametrize("model", [linear(), spectral(), differences()], ids=lambda m: m.kind)
@pytest.mark.parametrize("cost", [None, general_cost()], ids=["plain", "general"])
def test_the_gradient_is_that_of_the_cost(model: FieldModel, cost: Cost | None, k: int) -> None:
    """Also with actions at their bounds, and where the plan ends with the episode."""
    own = planner(model, cost, action_set=ActionSet(N_A, [-0.4, -np.inf], [0.5, 0.6]))
    rng = np.random.default_rng(k)
    z, v = rng.standard_normal((3, N_Z)), 0.5 * rng.standard_normal((3, 12, N_A))
    d = rng.standard_normal(v.shape)
    J, g, kept = own.gradient(v, z, k)
    assert not np.allclose(kept, v)  # some are projected
    np.testing.assert_allclose(J, own.costs(v, z, k), rtol=1e-12)
    np.testing.assert_allclose(J, own.costs(kept, z, k), rtol=1e-9)
    slopes = (own.costs(v + 1e-6 * d, z, k) - own.costs(v - 1e-6 * d, z, k)) / 2e-6
    np.testing.assert_allclose((g * d).sum(axis=(1, 2)), slopes, rtol=1e-5)


def test_a_spectral_model_is_compiled_and_gives_what_its_steps_give() -> None:
    model, rng = spectral(), np.random.default_rng(4)
    own, other = planner(model), planner(model)
    assert isinstance(own._sweep, SpectralSweep)
    other.__dict__["_sweep"] = Sweep(model, other.action_set, np.zeros((0, N_A)))
    z, v = rng.standard_normal((2, N_Z)), rng.standard_normal((2, 12, N_A))
    for found, expected in zip(own.gradient(v, z, 3), other.gradient(v, z, 3), strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-11)


@pytest.mark.parametrize("around", [False, True])
def test_of_a_linear_plant_it_is_the_regulator_of_the_riccati_equation(around: bool) -> None:
    """With the cost to go the plan's first action is optimal whatever its length."""
    model, cost = linear(), Cost(N_Z, N_A, 4096, action_weight=0.5)
    A, B = model.A, model.B
    P = linalg.solve_discrete_are(A, B, np.eye(N_Z), 0.5 * np.eye(N_A))
    K = -linalg.solve(0.5 * np.eye(N_A) + B.T @ P @ B, B.T @ P @ A)
    own = planner(model, cost, around=around, K=0.9 * K, b=np.zeros(N_A), steps=3, first=60)
    z = np.random.default_rng(5).standard_normal((2, N_Z))
    a, *_ = own.step(np.zeros((2, 3, N_A)), z, 0)
    np.testing.assert_allclose(a, z @ K.T, rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("around", [True, False], ids=["around", "bare"])
def test_plans_deviate_from_a_law_with_an_offset_for_each_step(around: bool) -> None:
    """Or are compared with it; beyond its last row that stays."""
    model, rng, k = linear(n_z=4), np.random.default_rng(3), T - 5
    rows = rng.standard_normal((T, N_A))
    own = planner(model, b=rows, around=around, steps=8, terminal=False)
    z = rng.standard_normal((2, 4))
    expected, states = np.zeros(2), z
    for i in range(k, k + 5):
        a = states @ own.K.T + rows[i]
        own.cost.add(expected, states, a, i)
        states = model.step(states, a)
    own.cost.add_terminal(expected, states)
    plan = own._affine_plan(z, k, 5)
    assert plan.any() != around
    np.testing.assert_allclose(own.costs(plan, z, k), expected, rtol=1e-12)
    found = own.gradient(plan, z, k)[1]
    d = rng.standard_normal(plan.shape)
    rise = own.costs(plan + 1e-5 * d, z, k) - own.costs(plan - 1e-5 * d, z, k)
    np.testing.assert_allclose((found * d).sum(axis=(1, 2)), rise / 2e-5, rtol=1e-5)


RATED = ActionSet(N_A, [-0.4, -np.inf], [0.5, 0.6], rate=[0.3, 0.8])


@pytest.mark.parametrize("around", [False, True])
@pytest.mark.parametrize("model", [linear(), spectral()], ids=lambda m: m.kind)
def test_the_gradient_is_that_of_the_cost_within_rate_limits(
    model: FieldModel, around: bool
) -> None:
    own = planner(model, general_cost(), action_set=RATED, around=around)
    rng = np.random.default_rng(0)
    last = rng.uniform([-0.4, -0.6], [0.5, 0.6], (3, N_A))
    z, v = own.after(rng.standard_normal((3, N_Z)), last), rng.standard_normal((3, 12, N_A))
    moved = np.diff(own.actions_of(v, z), axis=1, prepend=last[:, None])
    at_limit = np.isclose(np.abs(moved), RATED.rate)
    assert (np.abs(moved) <= RATED.rate + 1e-12).all() and 0.2 < at_limit.mean() < 0.8
    J, g, kept = own.gradient(v, z, 2)
    np.testing.assert_allclose(J, own.costs(kept, z, 2), rtol=1e-9)
    d = np.where(g != 0.0, rng.standard_normal(v.shape), 0.0)
    slopes = (own.costs(v + 1e-6 * d, z, 2) - own.costs(v - 1e-6 * d, z, 2)) / 2e-6
    np.testing.assert_allclose((g * d).sum(axis=(1, 2)), slopes, rtol=1e-5)


def test_within_rate_limits_a_plan_saves_what_quadratic_programming_does() -> None:
    allowed = ActionSet(N_A, -0.5, [0.3, np.inf], rate=[0.2, 0.3])
    own = planner(linear(radius=0.9), action_set=allowed, around=False)
    free, rng = replace(own, action_set=ActionSet(N_A)), np.random.default_rng(6)
    last = rng.uniform(-0.3, 0.3, N_A)
    field = rng.standard_normal((1, N_Z))
    z = own.after(field, last[None])
    v, (J,) = own.begin(z)
    moves = np.kron(np.eye(12) - np.eye(12, k=-1), np.eye(N_A))
    first, rate = np.append(last, np.zeros(11 * N_A)), np.tile(allowed.rate, 12)

    def cost(w: Array) -> tuple[float, Array]:
        of_w, g, _ = free.gradient(w.reshape(1, 12, N_A), field, 0)
        return float(of_w[0]), g.ravel()

    found = minimize(
        cost,
        np.zeros(12 * N_A),
        jac=True,
        method="SLSQP",
        bounds=list(zip(np.tile(allowed.low, 12), np.tile(allowed.high, 12), strict=True)),
        constraints=[LinearConstraint(moves, first - rate, first + rate)],
        options={"ftol": 1e-10, "maxiter": 300},
    )
    taken = own.actions_of(v, z)[0]
    moved = np.abs(np.diff(taken, axis=0, prepend=last[None]))
    assert (moved <= allowed.rate + 1e-9).all() and (moved > 0.99 * allowed.rate).sum() > 2
    (none,) = own.costs(np.zeros((1, 12, N_A)), z, 0)
    assert found.success and found.fun * (1.0 - 1e-9) <= J
    assert none - J > 0.99 * (none - found.fun)


def test_the_affine_law_acts_where_no_plan_is_finite_and_its_plan_is_taken_where_it_is_better() -> (
    None
):
    model = linear()
    own = planner(model)
    z = np.random.default_rng(7).standard_normal((1, N_Z))
    a, _, fell = own.step(np.full((1, 12, N_A), 1e200), z, 1)
    assert np.abs(a).max() < 100 and fell.all()
    lost = planner(LinearModel("linear", np.full((N_Z, N_Z), 1e200), model.B, model.constant))
    a, plan, fell = lost.step(np.zeros((1, 12, N_A)), z, 1)
    assert fell.all()
    np.testing.assert_allclose(a, z @ lost.K.T + lost.b)
    assert not plan.any()


def test_a_search_begins_however_long_its_first_step_has_to_be() -> None:
    """Without a cost to go cheap actions alone give a length that is far too long."""
    cost = Cost(N_Z, N_A, T, action_weight=0.01, target=0.3)
    own = planner(linear(), cost, around=False, terminal=False)
    z, none = np.random.default_rng(8).standard_normal((2, N_Z)), np.zeros((2, 12, N_A))
    assert (own.improved(none, z, 0, 30)[1] < 0.6 * own.costs(none, z, 0)).all()


def test_a_target_over_time_is_foreseen() -> None:
    """It is worth moving before the target does."""
    rows = np.repeat([0.0, 1.0], T // 2)[:, None] * np.ones(1)
    cost = Cost(1, N_A, T, target=rows, action_weight=0.5)
    model = LinearModel("linear", np.eye(1), np.ones((1, N_A)), np.zeros(1))
    own = planner(model, cost, around=False, terminal=False, K=np.zeros((N_A, 1)), b=np.zeros(N_A))
    acted = np.zeros(T)
    z, plan = np.zeros((1, 1)), np.zeros((1, 12, N_A))
    for k in range(T):
        a, plan, _ = own.step(plan, z, k)
        plan, z, acted[k] = own.shifted(plan), model.step(z, a), a[0, 0]
    assert acted[T // 2 - 1] > 0.05 > abs(acted[0])
