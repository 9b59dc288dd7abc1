# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A training on a plant whose actions act late: its first law is the optimum of the delayed plant.

With an ambient temperature as well, about which the plant is linear.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable
from io import StringIO
from pathlib import Path

import numpy as np
import pytest

import pdeloop
from pdeloop.method.adapt import Trajectory
from pdeloop.method.laws import Observer
from pdeloop.problem_check import Finding, check
from tests.method.test_input_delay import A, B
from tuner_node.result_checks import check_excitation

DELAY, HORIZON, R = 3, 60, 0.01
TARGET = np.array([2.0, 1.5, 1.5, 2.0])


class Late(pdeloop.Dynamics):
    n_z, n_a, horizon, sample_time = 4, 2, HORIZON, 0.1
    action_weight, stateful = R, True

    def __init__(self, ambient: float = 0.0) -> None:
        self.ambient, self.target = ambient, ambient + TARGET

    def initial_state(self, rng: np.random.Generator) -> np.ndarray:
        self.waiting = [np.zeros(2)] * DELAY
        return self.ambient + rng.normal(size=4)

    def step(self, z: np.ndarray, a: np.ndarray) -> np.ndarray:
        self.waiting = [*self.waiting, a.copy()]
        return self.ambient + A @ (z - self.ambient) + B @ self.waiting.pop(0)


def optimum(ambient: float) -> Callable[[int, np.ndarray], np.ndarray]:
    """The optimal controller of the delayed plant over the horizon, by dynamic programming."""
    n = 4 + 2 * DELAY + 1  # z, the waiting actions, 1
    F, G, E = np.zeros((n, n)), np.zeros((n, 2)), np.zeros((4, n))
    F[:4, :4], F[:4, 4:6], F[-1, -1] = A, B, 1.0
    for i in range(DELAY - 1):
        F[4 + 2 * i : 6 + 2 * i, 6 + 2 * i : 8 + 2 * i] = np.eye(2)
    G[n - 3 : n - 1] = np.eye(2)
    E[:, :4], E[:, -1] = np.eye(4), -TARGET
    P, gains = np.zeros((n, n)), []
    for _ in range(HORIZON):
        K = -np.linalg.solve(R * np.eye(2) + G.T @ P @ G, G.T @ P @ F)
        P = E.T @ E + F.T @ P @ (F + G @ K)
        gains.insert(0, K)
    waiting: list[np.ndarray] = []

    def law(k: int, z: np.ndarray) -> np.ndarray:
        if k == 0:
            waiting[:] = [np.zeros((len(z), 2))] * DELAY
        x = np.hstack([z - ambient, *waiting[-DELAY:], np.ones((len(z), 1))])
        waiting.append(x @ gains[min(k, HORIZON - 1)].T)
        return waiting[-1]

    return law


def test_the_default_law_knows_of_the_dead_time(tmp_path: Path) -> None:
    ambient = 20.0
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", pdeloop.TrainingWarning)  # no law is better, maybe
        run = pdeloop.train(
            plant=Late(ambient),
            reduced_order=4,
            rollouts=6,
            evaluation_fields=4,
            out=tmp_path / "run",
            progress=(told := StringIO()),
        )
    late = "the actions act 3 steps late, so the law 'observer' has the last ones in its state"
    assert run.values["law"] == "observer" and late in told.getvalue()
    fits = [row for row in run.result["history"] if "mismatch" in row]
    assert {row["model"] for row in fits} == {"innovations"}
    assert max(row["mismatch"] for row in fits) < 1e-3
    best = pdeloop.rollout(Late(ambient), optimum(ambient), *run.evaluation)
    least = float(np.mean(best.costs.mean))
    # The law of the infinite horizon knows no end, where actions no longer pay.
    assert least * (1 - 1e-9) < float(np.mean(run.costs["lqt"])) < 1.02 * least
    assert float(np.mean(run.costs["adapted"])) < 1.02 * least


class Prompt(Late):
    def step(self, z: np.ndarray, a: np.ndarray) -> np.ndarray:
        self.waiting.clear()
        return super().step(z, a)


class PartlyLate(Late):
    """The first input acts at once."""

    def step(self, z: np.ndarray, a: np.ndarray) -> np.ndarray:
        late = super().step(z, a * [0.0, 1.0])
        return late + B @ (a * [1.0, 0.0])


@pytest.mark.parametrize(
    ("plant", "given", "law"),
    [
        (Late, {}, "observer"),
        (PartlyLate, {}, "observer"),
        (Prompt, {}, "affine"),
        (Late, {"law": "affine"}, "affine"),
        (Late, {"optimizer": "two_point"}, "affine"),
        (Late, {"sensors": 2}, "extended_kalman"),
        (Late, {"model": "model.npz"}, "affine"),
    ],
)
def test_the_default_law_remembers_actions_where_they_act_late(
    plant: type[Late], given: dict[str, str | int], law: str
) -> None:
    assert pdeloop.problem(plant=plant(), **given).values["law"] == law


def test_the_affine_law_is_told_of_the_dead_time() -> None:
    told = StringIO()
    late = "seed 0: the actions act 3 steps late"
    with pytest.warns(pdeloop.TrainingWarning, match=late):  # also where nobody reads the progress
        pdeloop.train(
            plant=Late(),
            law="affine",
            reduced_order=4,
            rollouts=6,
            evaluation_fields=2,
            progress=told,
        )
    assert "the actions act 3 steps late" in told.getvalue()
    assert "train with --law observer" in told.getvalue()


def test_each_action_is_told_by_its_own_dead_time() -> None:
    actions = np.random.default_rng(1).normal(size=(HORIZON, 2))
    found = pdeloop.rollout(PartlyLate(), lambda k, z: actions[None, k], [0])
    explored = Trajectory(found.states[:, 0], found.actions[:, 0])
    (row,) = check_excitation(explored, 0, law=Observer)
    assert row["remark"].startswith("the actions act 0 and 3 steps late")


def test_the_check_of_a_problem_tells_what_a_training_would() -> None:
    found = {}
    for law in ("affine", "observer"):
        values = pdeloop.problem(plant=Late(), law=law, reduced_order=4).values
        found[law] = [*check(values)]
    late = [f.text for f in found["affine"] if "act 3 steps late" in f.text]
    assert late and "--law observer" in late[0]
    assert any("so the law 'observer' has the last" in f.text for f in found["observer"])
    costs = {law: first_law(findings) for law, findings in found.items()}
    fields = pdeloop.rollout(Late(), optimum(0.0), range(5))
    assert costs["observer"] < 1.02 * float(np.mean(fields.costs.mean)) < 0.9 * costs["affine"]


def first_law(findings: list[Finding]) -> float:
    text = next(f.text for f in findings if f.name == "first law")
    cost = text.partition("no control, ")[2].split()[0]
    return np.inf if cost == "diverges" else float(cost)
