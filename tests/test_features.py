"""Quadratic features of the law: derivatives, the controller's law, and a plant that needs them."""

from __future__ import annotations

import numpy as np
import pytest

from controller_node.lqt import track
from controller_node.policy import ProjectedLaw
from controller_node.reduced_model import ReducedModel
from loop_interfaces.policy_columns import policy_columns, quadratic_columns, with_features
from tuner_node.optimizers import Context, GaussNewton, RolloutResult, Trajectory
from tuner_node.optimizers.features import Features, known_columns
from tuner_node.optimizers.fit import LocalModel
from tuner_node.optimizers.proposal import Proposer
from tuner_node.optimizers.sensitivity import Path, expand, predict_difference

N_Z, N_S, N_A, R, STEPS = 24, 3, 2, 4, 12
S_R = np.array([0.2, -0.1, 0.3])
N_F = N_S + 1 + quadratic_columns(N_S)


def quadratic_policy(seed: int = 0) -> np.ndarray:
    return 0.1 * np.random.default_rng(seed).standard_normal(
        (N_A, policy_columns(N_S, "quadratic"))
    )


def basis() -> np.ndarray:
    return np.linalg.qr(np.random.default_rng(1).standard_normal((N_Z, N_S)))[0]


def by_hand(policy: np.ndarray, s: np.ndarray, s_r: np.ndarray) -> np.ndarray:
    e = s - s_r
    a = policy[:, :N_S] @ s + policy[:, N_S : 2 * N_S] @ s_r
    column = 2 * N_S
    for i in range(N_S):
        for j in range(i, N_S):
            a = a + policy[:, column] * e[i] * e[j]
            column += 1
    assert column == policy.shape[1]
    return a


def test_the_controllers_law_and_the_optimisers_features_are_the_same_law() -> None:
    U, policy = basis(), quadratic_policy()
    states = np.random.default_rng(2).standard_normal((20, N_Z))
    target = np.random.default_rng(3).standard_normal(N_Z)
    law = ProjectedLaw([U], target)
    law.set(np.repeat(policy[None], 20, axis=0))
    s_r = U.T @ target
    expected = np.array([by_hand(policy, s, s_r) for s in states @ U])
    np.testing.assert_allclose(law.actions(states), expected, rtol=1e-12, atol=1e-12)
    features = Features(s_r, 1.0, quadratic=True)
    b = policy[:, N_S : 2 * N_S] @ s_r
    theta = np.column_stack([policy[:, :N_S], b, policy[:, 2 * N_S :]])
    np.testing.assert_allclose(features(states @ U) @ theta.T, expected, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("count", [1, 2, 5, 9])
def test_a_quadratic_environment_is_bit_identical_in_any_batch(count: int) -> None:
    rng = np.random.default_rng(4)
    models = [np.linalg.qr(rng.standard_normal((N_Z, N_S)))[0] for _ in range(2)]
    target = rng.standard_normal(N_Z)
    policies = rng.standard_normal((9, N_A, policy_columns(N_S, "quadratic")))
    states, index = rng.standard_normal((9, N_Z)), np.arange(9) % 2
    whole = ProjectedLaw(models, target)
    whole.set(policies, index)
    reference = whole.actions(states)
    order = rng.permutation(9)[:count]
    part = ProjectedLaw(models, target)
    part.set(policies[order], index[order])
    assert np.array_equal(part.actions(states[order]), reference[order])


def test_a_policy_without_products_acts_to_the_bit_like_the_affine_one() -> None:
    rng = np.random.default_rng(5)
    target, states = rng.standard_normal(N_Z), rng.standard_normal((6, N_Z))
    affine = rng.standard_normal((6, N_A, 2 * N_S))
    law, wide = (ProjectedLaw([basis()], target) for _ in range(2))
    law.set(affine)
    wide.set(with_features(affine, "quadratic"))
    assert np.array_equal(law.actions(states), wide.actions(states))
    assert with_features(affine, "affine") is affine


def test_feedback_is_the_derivative_of_the_law() -> None:
    features = Features(S_R, 1.0, quadratic=True)
    theta = np.random.default_rng(6).standard_normal((N_A, N_F))
    s = np.random.default_rng(7).standard_normal((5, N_S))
    feedback = features.feedback(theta, s)
    h = 1e-6
    for j in range(N_S):
        e = h * np.eye(N_S)[j]
        difference = (features(s + e) - features(s - e)) @ theta.T / (2 * h)
        np.testing.assert_allclose(feedback[:, :, j], difference, atol=1e-8)


def planted() -> LocalModel:
    rng = np.random.default_rng(0)
    H = 0.1 * rng.standard_normal((R, R, R))
    return LocalModel(
        centre=0.1 * rng.standard_normal(R),
        constant=0.05 * rng.standard_normal(R),
        linear=0.3 * rng.standard_normal((R, R)) - 0.3 * np.eye(R),
        B=rng.standard_normal((R, N_A)),
        quadratic=0.5 * (H + H.transpose(0, 2, 1)),
        cubic=np.zeros((R, 0, 0, 0)),
    )


THETA = 0.1 * np.random.default_rng(9).standard_normal((N_A, N_F))
START = np.array([0.5, -0.3, 0.2, 0.4])
TARGET = np.append(S_R, 0.0)


def roll(model: LocalModel, theta: np.ndarray, x: np.ndarray) -> Path:
    features = Features(S_R, 1.0, quadratic=True)
    states, actions = [], []
    for _ in range(STEPS):
        a = theta @ features(x[None, :N_S])[0]
        states.append(x)
        actions.append(a)
        x = model.step(x, a)
    s = np.array(states)
    return Path(s, np.array(actions), features(s[:, :N_S]), features.feedback(theta, s[:, :N_S]))


def test_gradient_is_that_of_the_closed_loop() -> None:
    model, q, r, h = planted(), 1.5, 0.3, 1e-6

    def mean_cost(theta: np.ndarray) -> float:
        path = roll(model, theta, START)
        return float(q * np.sum((path.x - TARGET) ** 2) + r * np.sum(path.a**2)) / STEPS

    path = roll(model, THETA, START)
    expansion = expand(
        path,
        model.jacobians(path.x),
        model.B,
        target=TARGET,
        state_weight=q,
        action_weight=r,
        gamma=1.0,
    )
    for i in range(THETA.size):
        e = h * np.eye(THETA.size)[i].reshape(THETA.shape)
        difference = (mean_cost(THETA + e) - mean_cost(THETA - e)) / (2 * h)
        assert expansion.gradient[i] == pytest.approx(difference, rel=1e-6, abs=1e-8)


def test_differences_are_predicted_to_first_order() -> None:
    model = planted()
    first = roll(model, THETA, START)
    errors = []
    for scale in (1e-3, 5e-4):
        change = scale * np.random.default_rng(5).standard_normal(THETA.shape)
        second = roll(model, THETA + change, START + scale * np.ones(R))
        predicted = predict_difference(
            model.jacobians(first.x)[None],
            model.B,
            first.K[None],
            initial=(second.x - first.x)[:1],
            forcing=(second.features @ change.T)[None],
            gammas=np.array([1.0]),
        )[0, 0]
        errors.append(np.abs(predicted - (second.x - first.x)).max())
    assert errors[0] / errors[1] == pytest.approx(4.0, rel=0.2)


class BentPlant:
    """e' = A e + B (a - N(e, e)): linear in the actions a - N(e, e), so linear gains and Q = N cancel
    the bend, which no affine law does.
    """

    horizon = 40
    weight = 0.05

    def __init__(self) -> None:
        rng = np.random.default_rng(10)
        self.A = 0.98 * np.linalg.qr(rng.standard_normal((N_S, N_S)))[0]
        self.B = 0.3 * np.linalg.qr(rng.standard_normal((N_S, N_S)))[0]
        self.U = basis()
        self.target = self.U @ S_R
        self.products = 0.4 * rng.standard_normal((N_S, quadratic_columns(N_S)))
        model = ReducedModel(A=self.A, B=self.B, U=self.U)
        K = track(model, state_weight=1.0, action_weight=self.weight).K_a
        self.lqr = np.hstack([K, -K])

    @property
    def affine(self) -> np.ndarray:
        """Where to start."""
        return 0.6 * self.lqr

    def run(self, policy: np.ndarray, seed: int, noise: np.ndarray | None = None) -> RolloutResult:
        e = np.random.default_rng(seed).uniform(-1.0, 1.0, N_S)
        law = ProjectedLaw([self.U], self.target)
        law.set(policy[None])
        rows, columns = np.triu_indices(N_S)
        states, actions, cost = [self.U @ (S_R + e)], [], 0.0
        for k in range(self.horizon):
            a = law.actions(states[-1][None])[0] if noise is None else noise[k]
            cost += float(np.sum(e * e)) + self.weight * float(a @ a)
            e = self.A @ e + self.B @ (a - self.products @ (e[rows] * e[columns]))
            actions.append(a)
            if np.abs(e).max() > 100:
                return RolloutResult(
                    1e9, True, Trajectory(np.array(states), np.array(actions)[:-1])
                )
            states.append(self.U @ (S_R + e))
        return RolloutResult(
            cost / self.horizon, False, Trajectory(np.array(states), np.array(actions))
        )

    def context(self) -> Context:
        noise = 0.2 * np.random.default_rng(1).standard_normal((self.horizon, N_S))
        explored = self.run(self.affine, 77, noise).trajectory
        assert explored is not None
        return Context(self.U, self.target, 1.0, self.weight, self.horizon, explored)

    def mean_cost(self, policy: np.ndarray) -> float:
        return float(np.mean([self.run(policy, 10**6 + i).cost for i in range(30)]))


def adapt(plant: BentPlant, features: str, iterations: int = 30) -> GaussNewton:
    start = with_features(plant.affine, features)
    optimizer = GaussNewton(start, seed=5, iterations=iterations, context=plant.context(), fields=4)
    while not optimizer.done:
        asked = optimizer.ask()
        optimizer.tell([plant.run(rollout.policy, rollout.field_seed) for rollout in asked])
    return optimizer


def test_the_quadratic_law_beats_every_affine_one_where_the_plant_is_bent() -> None:
    plant = BentPlant()
    start = plant.mean_cost(plant.affine)
    cancelling = plant.mean_cost(np.hstack([plant.lqr, plant.products]))
    affine = plant.mean_cost(adapt(plant, "affine", 60).best_policy)
    quadratic = plant.mean_cost(adapt(plant, "quadratic", 30).best_policy)
    # The affine optimum lies between; half its rollouts are enough to reach what cancelling reaches.
    assert cancelling < 0.985 * affine < affine < 0.9 * start
    assert quadratic < 0.5 * (affine + cancelling)


def test_resumes_in_the_middle_to_the_bit() -> None:
    plant = BentPlant()
    whole = adapt(plant, "quadratic", 8)
    start = with_features(plant.affine, "quadratic")
    settings = {"seed": 5, "iterations": 8, "context": plant.context(), "fields": 4}
    optimizer = GaussNewton(start, **settings)
    while not optimizer.done:
        state = optimizer.state()
        optimizer = GaussNewton(start, **settings)
        optimizer.restore(state)
        asked = optimizer.ask()
        optimizer.tell([plant.run(rollout.policy, rollout.field_seed) for rollout in asked])
    assert np.array_equal(optimizer.best_policy, whole.best_policy)
    assert optimizer.best_policy[:, 2 * N_S :].any()


def test_a_step_moves_theta_by_what_it_says() -> None:
    plant = BentPlant()
    policy = with_features(plant.affine, "quadratic")
    proposer = Proposer(plant.context(), policy, 3)
    step = np.random.default_rng(8).standard_normal((N_S, N_F))
    moved = proposer.moved(policy, step)
    np.testing.assert_allclose(proposer.theta(moved) - proposer.theta(policy), step, atol=1e-12)
    assert known_columns(N_S) == (6, 12)
