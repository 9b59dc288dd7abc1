# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The optimiser model_based: a known optimum, what it asks and returns, its checkpoints."""

from __future__ import annotations

import io
import json
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest

from pdeloop.method.adapt import (
    Context,
    ModelBased,
    Rollout,
    RolloutResult,
    Trajectory,
    improve,
)
from pdeloop.method.adapt.improve import ModelBasedSettings
from pdeloop.method.adapt.verdict import ADAPTED, FIRST
from pdeloop.method.design.lqt import track
from pdeloop.method.models.base import FieldModelSettings
from pdeloop.method.reduce.reduced_model import ReducedModel
from tests.support.small import same_bits

N_Z, N_S, N_A, T = 7, 4, 2, 30
Q, R = 1.0, 0.2
Bend = Callable[[np.ndarray, np.random.Generator], np.ndarray]
Training = list[tuple[dict[str, Any], dict[str, np.ndarray], np.ndarray]]
"""After each tell, its row, the state of the optimiser and its policy."""


class Plant:
    """s' = A s + B a, lifted to N_Z dimensions, and what `bend` adds to it."""

    def __init__(self, bend: Bend | None = None, radius: float = 1.02) -> None:
        rng = np.random.default_rng(0)
        A = rng.standard_normal((N_S, N_S))
        self.A = radius * A / np.abs(np.linalg.eigvals(A)).max()
        self.B = rng.standard_normal((N_S, N_A))
        self.U = np.linalg.qr(rng.standard_normal((N_Z, N_S)))[0]
        self.target = self.U @ np.array([0.5, -0.2, 0.3, 0.1])
        self.bend = bend or (lambda s, rng: np.zeros(N_S))
        model = ReducedModel(A=self.A, B=self.B, U=self.U)
        self.best = track(model, state_weight=Q, action_weight=R).policy

    def run(self, policy: np.ndarray, seed: int, noise: np.ndarray | None = None) -> RolloutResult:
        rng = np.random.default_rng(seed)
        s = rng.standard_normal(N_S)
        b = policy[:, N_S:] @ self.U.T @ self.target
        states, actions, cost = [self.U @ s], [], 0.0
        for k in range(T):
            a = policy[:, :N_S] @ s + b if noise is None else noise[k]
            cost += Q * float(np.sum((states[-1] - self.target) ** 2)) + R * float(a @ a)
            s = self.A @ s + self.B @ a + self.bend(s, rng)
            actions.append(a)
            if not np.abs(s).max() < 1e3:
                done = Trajectory(np.array(states), np.array(actions)[:-1])
                return RolloutResult(1e9, True, done)
            states.append(self.U @ s)
        return RolloutResult(cost / T, False, Trajectory(np.array(states), np.array(actions)))

    def context(self) -> Context:
        explored = []
        for seed in (77, 78):
            noise = 0.3 * np.random.default_rng(seed).standard_normal((T, N_A))
            trajectory = self.run(np.zeros((N_A, 2 * N_S)), seed, noise).trajectory
            assert trajectory is not None
            explored.append(trajectory)
        # Few kinds of models: most of the time would be spent on those that predict nothing.
        few = FieldModelSettings(folds=2, largest_degree=2)
        return Context(
            self.U, self.target, Q, R, T, explored[0], further=explored[1:], field_models=few
        )

    def cost(self, policy: np.ndarray) -> float:
        return float(np.mean([self.run(policy, 10**6 + i).cost for i in range(40)]))


def make(plant: Plant, share: float = 0.6, **changes: Any) -> ModelBased:
    settings: dict[str, Any] = {"seed": 5, "rollouts": 18, "context": plant.context()}
    return ModelBased(share * plant.best, **(settings | changes))


def measured(plant: Plant, optimizer: ModelBased) -> list[RolloutResult]:
    return [plant.run(rollout.policy, rollout.field_seed) for rollout in optimizer.ask()]


def finished(plant: Plant, optimizer: ModelBased) -> list[dict[str, Any]]:
    rows = []
    while not optimizer.done:
        rows.append(optimizer.tell(measured(plant, optimizer)))
        assert rows[-1] == json.loads(json.dumps(rows[-1], allow_nan=False))
    return rows


def chaotic(s: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """What no model of the state predicts, and less than a law can do."""
    return 0.4 * rng.standard_normal(N_S)


def test_the_known_optimum_of_a_linear_quadratic_plant_is_reached() -> None:
    plant = Plant()
    optimizer, rows, seeds = make(plant), list[dict[str, Any]](), list[int]()
    start, best = plant.cost(optimizer.policy), plant.cost(plant.best)
    while not optimizer.done:  # each rollout of a law is on a field of its own, and asking is pure
        first, second = optimizer.ask(), optimizer.ask()
        for one, other in zip(first, second, strict=True):
            assert same_bits(one.policy, other.policy) and one.field_seed == other.field_seed
            one.policy[:] = np.nan
        seeds += [rollout.field_seed for rollout in second]
        rows.append(optimizer.tell(measured(plant, optimizer)))
    assert len(set(seeds)) == len(seeds) == 18 and optimizer.ask() == []
    assert start > 1.05 * best
    # Over the horizon the law of the algebraic equation is optimal but for its last steps.
    assert plant.cost(optimizer.policy) <= 1.005 * best
    assert rows[-1]["chosen"] == ADAPTED and rows[-1]["predicted_change"] < 0.0
    # Of a law that a model made three rollouts show whether it costs what that says, before the rest.
    assert [row["rollouts"] for row in rows] == [4, 7, 15, 18]
    assert all(row["mismatch"] < 1e-6 for row in (rows[0], rows[2]))
    for row in rows[1:]:  # said before the rollouts were fitted
        assert row["predicted"] == pytest.approx(row["cost"], rel=1e-3)


@pytest.mark.parametrize(
    ("costs", "missed"), [((1.0, 1.0, 1.0), 0.0), ((0.8, 0.8, 0.8), 0.25), ((0.7, 1.3, 1.0), 0.25)]
)
def test_a_law_is_renewed_at_once_where_its_costs_were_mispredicted(
    costs: tuple[float, ...], missed: float
) -> None:
    """Whether they are lower, or only their mean is as predicted."""
    plant = Plant()
    optimizer = make(plant)
    optimizer.tell(measured(plant, optimizer))
    mean = np.mean([result.cost for result in measured(plant, optimizer)])
    row = optimizer.tell(
        [
            replace(result, cost=result.cost + (share - 1.0) * mean)
            for result, share in zip(measured(plant, optimizer), costs, strict=True)
        ]
    )
    assert row["missed"] / row["cost"] == pytest.approx(missed, abs=0.01)
    assert ("fraction" in row) is bool(missed)


def test_the_best_law_is_kept() -> None:
    plant = Plant()
    optimizer = make(plant, share=1.0)
    rows = finished(plant, optimizer)
    assert plant.cost(optimizer.policy) <= 1.001 * plant.cost(plant.best)
    assert rows[-1]["reason"]


@cache
def whole(bend: Bend | None) -> tuple[Training, list[list[Rollout]]]:
    """A training that nothing interrupts, and what it asked for."""
    plant = Plant(bend)
    optimizer = make(plant, rollouts=14)
    asked: list[list[Rollout]] = []
    training: Training = []
    while not optimizer.done:
        asked.append(optimizer.ask())
        row = optimizer.tell(measured(plant, optimizer))
        training.append((row, optimizer.state(), optimizer.policy))
    return training, asked


@pytest.mark.parametrize("bend", [None, chaotic])
def test_an_optimiser_restored_before_any_tell_goes_on_with_the_same_bits(
    bend: Bend | None,
) -> None:
    plant = Plant(bend)
    state = make(plant, rollouts=14).state()
    training, _ = whole(bend)
    for row, expected, policy in training:
        file = io.BytesIO()
        np.savez(file, **state)  # type: ignore[arg-type]
        file.seek(0)
        again = make(plant, rollouts=14)
        with np.load(file, allow_pickle=False) as arrays:
            again.restore(dict(arrays))
        assert again.tell(measured(plant, again)) == row
        state = again.state()
        assert state.keys() == expected.keys()
        assert all(state[name].tobytes() == expected[name].tobytes() for name in state)
        assert same_bits(again.policy, policy)
    assert again.done and again.tells == len(training)


def test_steps_along_rollouts_where_no_model_predicts_them() -> None:
    plant = Plant(chaotic)
    training, _ = whole(chaotic)
    rows, policy = [row for row, *_ in training], training[-1][-1]
    assert "no model" in rows[0]["reason"] and "steps along measured ones" in rows[0]["reason"]
    assert {row["role"] for row in rows} == {"renewing", "judging"}
    assert rows[-1]["rollouts"] == 14 and "early" not in rows[-1]
    assert rows[-1]["chosen"] == ADAPTED
    # What acts on a linear plant is repeated exactly, so that steps lead to the best law for it.
    start, best = plant.cost(0.6 * plant.best), plant.cost(plant.best)
    assert plant.cost(policy) <= best + 0.35 * (start - best)


def test_steps_are_compared_on_the_fields_of_the_first_law_and_with_no_control() -> None:
    _, (first, asked, after, *_) = whole(chaotic)
    known = [rollout.field_seed for rollout in first]
    own = [r.field_seed for r in asked if r.policy.any()]
    none = [r.field_seed for r in asked if not r.policy.any()]
    assert own == known[: len(own)] and len(own) == 3 and none == known[:2]
    assert all(rollout.policy.any() for rollout in after)


def test_where_no_law_stays_finite_on_the_model_steps_follow_measured_rollouts(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(improve, "renew", lambda *_, **__: None)
    plant = Plant()
    optimizer = make(plant)
    rows = finished(plant, optimizer)
    told = "no improved law stays finite on the model: steps along measured ones"
    assert rows[0]["reason"] == told and rows[0]["steps"] > 0
    start, best = plant.cost(0.6 * plant.best), plant.cost(plant.best)
    assert plant.cost(optimizer.policy) <= best + 0.35 * (start - best)


def test_no_rollout_is_unused_where_there_are_few() -> None:
    plant = Plant(chaotic)
    optimizer = make(plant, rollouts=8)
    rows = finished(plant, optimizer)
    assert rows[-1]["rollouts"] == 8 and "early" not in rows[-1]
    assert plant.cost(optimizer.policy) <= 1.02 * plant.cost(0.6 * plant.best)


def test_a_first_law_that_is_worse_than_no_control_is_not_returned() -> None:
    plant = Plant(radius=0.9)
    optimizer = make(plant, share=-0.3)
    rows = finished(plant, optimizer)
    none = np.zeros_like(plant.best)
    assert plant.cost(-0.3 * plant.best) > 1.2 * plant.cost(none)
    assert plant.cost(optimizer.policy) < plant.cost(none)
    assert rows[-1]["chosen"] != FIRST


def test_a_first_law_under_which_the_plant_diverges_is_improved_on_the_model() -> None:
    plant = Plant()
    optimizer = make(plant, share=-2.0)
    assert plant.run(optimizer.policy, 1).diverged
    rows = finished(plant, optimizer)
    assert rows[0]["diverged"] == 4 and "cost" not in rows[0]
    assert rows[-1]["chosen"] == ADAPTED
    assert plant.cost(optimizer.policy) <= 1.01 * plant.cost(plant.best)


def test_a_first_law_that_leads_to_where_no_model_follows_is_no_obstacle() -> None:
    """The plant is linear up to three times the states of its explorations, and random beyond."""
    plant = Plant()
    explored = plant.context().every_exploration
    far = 3.0 * max(np.abs(known.states).max() for known in explored)
    growing = plant.A - plant.B @ plant.best[:, :N_S]  # under the law below

    def beyond(s: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        random = far * rng.standard_normal(N_S) - growing @ s
        return random if np.abs(plant.U @ s).max() > far else np.zeros(N_S)

    wild = Plant(beyond)
    optimizer = make(wild, share=-1.0)
    rows = finished(wild, optimizer)
    assert rows[0]["diverged"] == 0 and rows[0]["cost"] > 10.0 * wild.cost(wild.best)
    assert rows[0]["mismatch"] < 1e-6
    assert rows[-1]["chosen"] == ADAPTED
    assert wild.cost(optimizer.policy) <= 1.05 * wild.cost(wild.best)


def test_a_large_budget_ends_once_the_fields_are_known() -> None:
    plant = Plant()
    settings = ModelBasedSettings(enough_fields=12)
    optimizer = make(plant, rollouts=100, settings=settings)
    rows = finished(plant, optimizer)
    assert [row["rollouts"] for row in rows] == [4, 7, 10, 13]
    assert "fields would not change" in rows[-1]["early"]
    assert not any("early" in row for row in rows[:-1])


def test_a_checkpoint_of_something_else_is_refused() -> None:
    plant = Plant()
    optimizer = make(plant)
    state = optimizer.state()
    with pytest.raises(ValueError, match="stage"):
        optimizer.restore({**state, "stage": np.array("dreaming")})
    with pytest.raises(ValueError, match="policy"):
        optimizer.restore({**state, "policy": np.zeros((1, 1))})
    with pytest.raises(ValueError, match="rollouts"):
        make(plant, rollouts=0)
    with pytest.raises(ValueError, match="trajector"):
        optimizer.tell([replace(result, trajectory=None) for result in measured(plant, optimizer)])
