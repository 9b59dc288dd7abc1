# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Costs and bounds that a plant declares: what an episode costs, trainings with them, and refusals."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import pdeloop
from pde_sim_node.dynamics import Dynamics
from pde_sim_node.plants import DynamicsPlant
from pdeloop.messages.action_set import ActionSet
from pdeloop.messages.model_rows import ModelRows
from pdeloop.messages.spec import ParameterError
from pdeloop.method.adapt import ModelBased
from pdeloop.method.design.lqt import regulator, track_horizon
from pdeloop.method.laws import FeedForward, Law, Observer
from pdeloop.method.laws.registry import laws_of
from pdeloop.method.models.linear import LinearModel
from tests.support.small import FEW_FITS
from tuner_node.build import remarks_on

N_Z, N_A, T = 6, 2, 20
A = 0.95 * np.linalg.qr(np.random.default_rng(0).standard_normal((N_Z, N_Z)))[0]
B = np.random.default_rng(1).standard_normal((N_Z, N_A))


class Servo(Dynamics):
    """Two outputs of a linear system are to follow waves, and its actions are near (0.5, -0.5)."""

    n_z, n_a, horizon = N_Z, N_A, T
    output = np.eye(2, N_Z)
    state_weight = np.array([4.0, 1.0])
    action_weight = np.array([[0.5, 0.1], [0.1, 0.4]])
    action_target = np.array([0.5, -0.5])
    terminal_weight = 3.0
    target = np.sin(0.2 * np.arange(T + 1))[:, None] + np.array([2.0, 1.0])

    def initial_state(self, rng: np.random.Generator) -> np.ndarray:
        return rng.standard_normal(N_Z)

    def step(self, z: np.ndarray, a: np.ndarray) -> np.ndarray:
        return A @ z + B @ a


def test_an_episode_costs_the_stages_and_its_last_state() -> None:
    plant = DynamicsPlant(Servo())
    given = np.random.default_rng(2).standard_normal((T, 3, N_A))
    episode = pdeloop.rollout(plant, lambda k, z: given[k], [0, 1, 2])
    y = episode.states[:, :, :2] - Servo.target[:, None]
    a = given - Servo.action_target
    expected = (y[:T] ** 2 @ Servo.state_weight).sum(axis=0)
    expected += np.einsum("kmi,ij,kmj->m", a, Servo.action_weight, a)
    expected += 3.0 * (y[T] ** 2).sum(axis=1)
    np.testing.assert_allclose(episode.costs.total, expected, rtol=1e-12)
    alone = pdeloop.rollout(plant, lambda k, z: given[k, 1:2], [1])
    assert alone.costs.total[0] == episode.costs.total[1]


def test_no_law_costs_less_than_lq_tracking_over_the_horizon() -> None:
    plant = DynamicsPlant(Servo())
    K, b = track_horizon(A, B, plant.cost, np.eye(N_Z))

    def cost(shift: np.ndarray) -> float:
        law = lambda k, z: z @ K[k].T + b[k] + shift[k]  # noqa: E731
        return float(pdeloop.rollout(plant, law, [5]).costs.mean[0])

    best, rng = cost(np.zeros((T, N_A))), np.random.default_rng(3)
    for size in (1e-3, 1e-1):
        shift = size * rng.standard_normal((T, N_A))
        up, down = cost(shift) - best, cost(-shift) - best
        assert up == pytest.approx(down, rel=1e-6) and up > 0.0  # the slope is zero there


@pytest.mark.parametrize("kind", [FeedForward, Observer])
def test_the_law_with_a_feedforward_looks_ahead_about_any_origin(kind: type[Law]) -> None:
    """From the mean target, far from 0, it takes the best way, with one feedback for all steps."""
    rest = np.full((1, N_Z), 300.0)
    d = rest[0] - A @ rest[0]

    class Waves(Servo):
        action_target = np.zeros(N_A)
        target = 300.0 + np.sin(0.1 * np.pi * np.arange(T + 1))[:, None] * np.array([2.0, 1.0])

        def step(self, z: np.ndarray, a: np.ndarray) -> np.ndarray:
            return A @ z + B @ a + d

    plant = DynamicsPlant(Waves())
    best, known = track_horizon(A, B, plant.cost, np.eye(N_Z), d), _feedforward(plant, d)
    (law,) = laws_of(kind, [known.model], T, plant.cost.texts)
    start, memory = law.parts(law.theta_start), law.memory_start()
    found, expected = (
        pdeloop.rollout(plant, own, rest)
        for own in (
            lambda k, z: law.action(start, z[0], memory, k)[None],
            lambda k, z: z @ best.K[k].T + best.b[k],
        )
    )
    np.testing.assert_allclose(found.actions, expected.actions, atol=1e-9)
    (constant,) = laws_of(kind, [law.model], T)
    b = np.atleast_2d(constant.parts(constant.theta_start)["b"])
    assert np.ptp(b, axis=0).max() == 0.0


def _feedforward(plant: DynamicsPlant, d: np.ndarray) -> FeedForward:
    """The law of rows that know of the constant term d by K_b alone, as those without a filter do."""
    mean = plant.cost.target[:T].mean(axis=0)
    K, b = track_horizon(A, B, plant.cost.through(np.eye(N_Z), mean), np.eye(N_Z), d)
    z_r = plant.field_target
    K_b = np.outer(b[0], z_r) / (z_r @ z_r)
    rows = ModelRows(A=A, B=B, U=np.eye(N_Z), K_a=K[0], K_b=K_b, s_r=z_r)
    (law,) = laws_of(FeedForward, [rows], T, plant.cost.texts)
    assert isinstance(law, FeedForward)
    return law


def test_a_law_with_a_feedforward_holds_a_plant_that_moves_by_itself() -> None:
    """An offset of the plant is in its start; without it the target was missed by the offset."""
    d = np.linspace(1.5, -1.0, N_Z)

    class Moved(Servo):
        def step(self, z: np.ndarray, a: np.ndarray) -> np.ndarray:
            return A @ z + B @ a + d

    plant, best = (
        DynamicsPlant(Moved()),
        track_horizon(A, B, DynamicsPlant(Servo()).cost, np.eye(N_Z), d),
    )
    laws = [_feedforward(plant, own) for own in (d, np.zeros(N_Z))]
    knows, ignores = (
        pdeloop.rollout(
            plant,
            lambda k, z, law=law: law.action(law.parts(law.theta_start), z[0], np.zeros(0), k)[
                None
            ],
            [5],
        ).costs.mean[0]
        for law in laws
    )
    least = pdeloop.rollout(plant, lambda k, z: z @ best.K[k].T + best.b[k], [5]).costs.mean[0]
    assert least < knows < 1.06 * least and ignores > 1.5 * least


def test_a_training_designs_and_adapts_for_it() -> None:
    run = pdeloop.train(
        plant=Servo(), law="affine", rollouts=9, evaluation_fields=2, reduced_order=N_Z, **FEW_FITS
    )
    plant, U = DynamicsPlant(Servo()), run.models[0].U
    z_r, about = plant.field_target, regulator(LinearModel("", A, B, np.zeros(N_Z)), plant.cost)
    assert about is not None
    first, n_s = run.warm[0], U.shape[1]
    np.testing.assert_allclose(first[:, :n_s] @ U.T, about.K, atol=1e-6)
    np.testing.assert_allclose(first[:, n_s:] @ U.T @ z_r, about.b, atol=1e-6)
    best = track_horizon(A, B, plant.cost, np.eye(N_Z))
    laws = {
        "best": lambda k, z: z @ best.K[k].T + best.b[k],
        "first": pdeloop.projected_law(plant, U, first),
        "adapted": pdeloop.projected_law(plant, U, run.policies[0]),
    }
    fields = np.arange(100, 130)
    cost = {name: pdeloop.rollout(plant, law, fields).costs.mean for name, law in laws.items()}
    assert (cost["best"] < cost["adapted"]).all() and (cost["best"] < cost["first"]).all()
    assert cost["adapted"].mean() < cost["first"].mean()


def test_a_moving_target_is_followed_by_default() -> None:
    run = pdeloop.train(
        plant=Servo(), rollouts=12, evaluation_fields=2, reduced_order=N_Z, **FEW_FITS
    )
    assert run.values["law"] == "feedforward"
    plant, fields = DynamicsPlant(Servo()), np.arange(100, 130)
    best = track_horizon(A, B, plant.cost, np.eye(N_Z))
    laws = {"best": lambda k, z: z @ best.K[k].T + best.b[k], "adapted": run.law()}
    cost = {name: pdeloop.rollout(plant, law, fields).costs.mean for name, law in laws.items()}
    assert cost["adapted"].mean() <= 1.03 * cost["best"].mean()


FEW: dict[str, Any] = {"evaluation_fields": 20, "reduced_order": 2, **FEW_FITS}


class Offset(pdeloop.Dynamics):
    """A plant that a constant disturbance moves away from its target of 0."""

    n_z, n_a, horizon, action_weight = 2, 1, 30, 0.1
    A, B, d = np.array([[1.0, 0.3], [-0.1, 0.9]]), np.array([[0.0], [0.4]]), np.array([0.0, 0.3])

    def __init__(self, share: float = 1.0) -> None:
        self.share = share

    def initial_state(self, rng: np.random.Generator) -> np.ndarray:
        return rng.standard_normal(2)

    def step(self, z: np.ndarray, a: np.ndarray) -> np.ndarray:
        return self.A @ z + self.B @ a + self.share * self.d

    def least_cost(self, fields: np.ndarray) -> float:
        """By dynamic programming with the state [z; 1]."""
        A, B = (
            np.block([[self.A, self.d[:, None]], [np.zeros((1, 2)), 1.0]]),
            np.r_[self.B, [[0.0]]],
        )
        P = Q = np.diag([1.0, 1.0, 0.0])
        for _ in range(self.horizon - 1):  # the last action only costs: it is 0
            K = np.linalg.solve(self.action_weight * np.eye(1) + B.T @ P @ B, B.T @ P @ A)
            P = A.T @ P @ (A - B @ K) + Q
        x = np.c_[fields, np.ones(len(fields))]
        return float(np.mean(np.einsum("mi,ij,mj->m", x, P, x)) / self.horizon)


def test_a_constant_disturbance_is_met_at_a_target_of_0_by_default() -> None:
    run = pdeloop.train(plant=Offset(), rollouts=9, **FEW)
    assert run.values["law"] == "feedforward"
    fields = DynamicsPlant(Offset()).reset(run.evaluation[0]).copy()
    least = Offset().least_cost(fields)
    assert least <= np.mean(run.costs["adapted"]) <= 1.01 * least
    assert pdeloop.problem(plant=Offset(0.0)).values["law"] == "affine"
    assert pdeloop.problem(plant=Offset(), law="observer").values["law"] == "observer"


def test_actions_with_a_target_of_their_own_are_held_at_a_target_of_0_by_default() -> None:
    class Held(Offset):
        action_target, action_weight = 1.5, 5.0

    own = Held(0.0)
    run = pdeloop.train(plant=own, rollouts=9, **FEW)
    assert run.values["law"] == "feedforward"
    plant = DynamicsPlant(own)
    best = track_horizon(own.A, own.B, plant.cost, np.eye(2))
    law: Any = lambda k, z: z @ best.K[k].T + best.b[k]  # noqa: E731
    least = pdeloop.rollout(plant, law, run.evaluation[0]).costs.mean.mean()
    assert least <= np.mean(run.costs["adapted"]) <= 1.01 * least < 0.9 * np.mean(run.costs["none"])


def test_an_optimizer_that_cannot_use_a_cost_says_so() -> None:
    class OfWeights(ModelBased):
        name = "of_weights"
        any_cost = False

    with pytest.raises(ParameterError, match="OfWeights' needs scalar weights"):
        pdeloop.train(plant=Servo(), optimizer=OfWeights, rollouts=20)


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        (
            {"target": np.zeros((7, 2))},
            "Servo: target must be a number, 2 numbers, or 20 or 21 rows",
        ),
        ({"action_low": [1.0, 2.0, 3.0]}, "Servo: action_low must be a number or 2 numbers"),
        ({"action_low": 1.0, "action_high": 0.0}, "action_low must be at most action_high"),
        ({"action_low": 1.0, "zero_mean": True}, "no action between .* has mean zero"),
        ({"action_low": 0.0, "zero_mean": True}, "only one action between .* has mean zero"),
        (
            {"action_low": [0.0, 2.0], "action_high": 2.0},
            "of actuator 2 are both 2, so it has nothing",
        ),
        ({"action_weight": 0.0}, "action_weight must be positive"),
        (
            {"state_weight": 0.0},
            "state_weight is 0; with a terminal_weight give it a small positive",
        ),
    ],
)
def test_a_cost_that_does_not_fit_is_refused(changes: dict[str, Any], told: str) -> None:
    servo = Servo()
    vars(servo).update(changes)
    with pytest.raises(ValueError, match=told):
        DynamicsPlant(servo)


def test_a_target_of_the_actions_beyond_their_bounds_is_told() -> None:
    servo = Servo()
    servo.action_low, servo.action_high = 0.0, [0.4, 1.0]
    (told,) = remarks_on(pdeloop.problem(plant=servo).values)
    assert told.startswith(
        "no admissible action reaches the action_target of a1 and a2, 0.5, -0.5: "
    )
    assert "the nearest is 0.4, 0" in told
    with pytest.warns(
        pdeloop.TrainingWarning, match="no admissible action reaches the action_target"
    ):
        pdeloop.train(plant=servo, rollouts=6, **FEW)
    servo.action_low, servo.action_high = -1.0, 1.0
    assert not remarks_on(pdeloop.problem(plant=servo).values)


def test_a_law_that_cannot_follow_a_target_that_moves_is_told_at_the_start() -> None:
    servo = Servo()
    assert not remarks_on(pdeloop.problem(plant=servo).values)
    servo.target = np.sin(np.arange(servo.horizon + 1))[:, None] * np.ones(2)
    assert not remarks_on(pdeloop.problem(plant=servo).values)
    values = pdeloop.problem(plant=servo).values | {"law": "affine"}
    (told,) = remarks_on(values)
    assert told.startswith("the target moves, and the law 'affine' has one offset for all steps")


def test_what_a_plant_declares_is_read_back_or_refused_at_the_start() -> None:
    servo = Servo()
    servo.divergence_bound = 1e9  # of pascals
    run = pdeloop.train(plant=servo, rollouts=6, evaluation_fields=2, reduced_order=N_Z, **FEW_FITS)
    assert run.values["divergence_bound"] == 1e9
    servo.horizon, servo.target = 2_000_000, 0.0
    with pytest.raises(
        ParameterError, match=r"horizon of .* is 2000000; expected a whole number from 1"
    ):
        pdeloop.problem(plant=servo)


def test_actions_are_moved_to_the_nearest_ones_that_are_allowed_and_cost_what_acts() -> None:
    servo = Servo()
    vars(servo).update(action_low=[-0.5, -2.0], action_high=[1.0, 0.25])
    plant = DynamicsPlant(servo)
    asked, taken = np.array([[3.0, -1.0], [-3.0, 7.0]]), np.array([[1.0, -1.0], [-0.5, 0.25]])
    z = plant.reset([0, 1]).copy()
    expected, costs = DynamicsPlant(Servo()).evaluate(z, taken)
    np.testing.assert_array_equal(plant.step(asked), expected)
    np.testing.assert_array_equal(plant.totals, costs)
    np.testing.assert_array_equal(plant.actions, taken)


def test_no_bound_may_be_none() -> None:
    servo, asked = Servo(), np.array([[30.0, -10.0]])
    vars(servo).update(action_low=None, action_high=None, action_rate=None)
    plant, free = DynamicsPlant(servo), DynamicsPlant(Servo())
    assert plant.action_set == free.action_set and not plant.action_set.bounded
    assert np.array_equal(servo.actuated(asked[0]), asked[0])
    vars(servo).update(action_high=1.0)
    assert np.array_equal(servo.actuated(asked[0]), [1.0, -10.0])


def test_the_projection_to_mean_zero_and_bounds_is_the_nearest_point() -> None:
    rng = np.random.default_rng(4)
    low, high = -np.array([0.5, 1.0, 0.2, 3.0]), np.array([0.7, 0.1, 2.0, 1.0])
    allowed = ActionSet(4, low, high, True)
    for a in 3.0 * rng.standard_normal((20, 4)):
        nearest = allowed.project(a[None])[0]
        assert abs(nearest.sum()) < 1e-12
        assert (nearest >= low).all() and (nearest <= high).all()
        # The angle to every other point of a convex set is obtuse.
        for other in allowed.project(3.0 * rng.standard_normal((20, 4))):
            assert (a - nearest) @ (other - nearest) < 1e-9


class Halved(Servo):
    def actuated(self, a: np.ndarray) -> np.ndarray:
        return a / 2


def test_a_class_says_itself_what_its_actuators_take() -> None:
    plant, own = DynamicsPlant(Halved()), DynamicsPlant(Servo())
    for one in (plant, own):
        one.reset([3])
    np.testing.assert_array_equal(
        plant.step(np.array([[2.0, 4.0]])), own.step(np.array([[1.0, 2.0]]))
    )


class Limited(Servo):
    def actuated(self, a: np.ndarray) -> np.ndarray:
        return np.minimum(np.maximum(a, [0.0, -2.0]), [4.0, np.inf])


class Coupled(Servo):
    def actuated(self, a: np.ndarray) -> np.ndarray:
        return a / max(1.0, float(np.abs(a).sum()))


class Stepped(Servo):
    def actuated(self, a: np.ndarray) -> np.ndarray:
        return np.clip(np.round(a, 1), 0.0, 4.0)


def test_the_bounds_of_actuators_that_clip_are_those_of_the_actions() -> None:
    found = DynamicsPlant(Limited()).action_set
    assert found.low.tolist() == [0.0, -2.0] and found.high.tolist() == [4.0, np.inf]
    slow = Limited()
    slow.action_rate = 0.5
    found = DynamicsPlant(slow).action_set
    assert found.high.tolist() == [4.0, np.inf] and found.rate.tolist() == [0.5, 0.5]
    for other in (Halved(), Coupled(), Stepped(), Servo()):
        assert not DynamicsPlant(other).action_set.bounded


class Heated(Dynamics):
    """Two heaters of 0 to 4, of a state that has to be warm."""

    n_z, n_a, horizon, target, action_weight = 3, 2, 60, 5.0, 0.05
    action_low, action_high = 0.0, 4.0
    A, B = 0.9 * np.eye(3) + 0.05 * np.eye(3, k=1), 0.3 * np.eye(3, 2, k=0) + 0.1

    def initial_state(self, rng: np.random.Generator) -> np.ndarray:
        return 2.0 + 0.3 * rng.standard_normal(3)

    def step(self, z: np.ndarray, a: np.ndarray) -> np.ndarray:
        return self.A @ z + self.B @ a


def test_what_is_recorded_of_bounded_actuators_is_what_acts_from_mid_range_on() -> None:
    problem = pdeloop.problem(plant=Heated())
    assert problem.values["action_bounds"] == [0.0, 0.0, 4.0, 4.0, 0.0]
    states, actions = problem.explore(0)
    acted = states[:-1] @ Heated.A.T + actions @ Heated.B.T
    np.testing.assert_allclose(states[1:], acted, atol=1e-12)
    assert np.abs(actions.mean(axis=0) - 2.0).max() < 0.25
    assert np.abs(actions.std(axis=0) - 0.5).max() < 0.12


class Clipped(Heated):
    """The same with bounds that only the plant knows."""

    action_low, action_high = None, None

    def actuated(self, a: np.ndarray) -> np.ndarray:
        return np.clip(a, 0.0, 4.0)


def test_models_are_of_the_actions_that_actuators_apply() -> None:
    declared, own = (pdeloop.problem(plant=plant()) for plant in (Heated, Clipped))
    assert own.values["action_bounds"] == declared.values["action_bounds"]
    for a, b in zip(own.explore(0), declared.explore(0), strict=True):
        np.testing.assert_array_equal(a, b)


def test_a_law_of_bounded_actuators_asks_for_no_more_than_they_take() -> None:
    run = pdeloop.train(plant=Heated(), rollouts=8, evaluation_fields=3, **FEW_FITS)
    plant = pdeloop.problem(plant=Heated()).plant()
    asked: list[np.ndarray] = []
    law = run.law()
    pdeloop.rollout(plant, lambda k, z: asked.append(law(k, z)) or asked[-1], [1, 2, 3])
    actions = np.array(asked)
    assert actions.min() >= 0.0 and actions.max() <= 4.0
    assert run.costs["adapted"].mean() < run.costs["none"].mean()
