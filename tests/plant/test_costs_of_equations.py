# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Any quadratic cost of a compiled equation: episode, gradient, design, a run and its bag."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import pdeloop
from pde_sim_node.build import build_plant
from pdeloop.bags.verify import verify
from pdeloop.messages.cost import Cost
from pdeloop.messages.spec import ParameterError
from pdeloop.method.design.lqt import track_horizon
from tests.support.recorded_here import record_run
from tests.support.small import FEW_FITS, FEW_STEPS, SMALL, same_bits

N_Z, T = 32, 12
SHIPPED = {"burgers": 6, "allen-cahn": 6, "kdv": 12}
RNG = np.random.default_rng(0)
WAVES = np.array([np.cos(2 * np.pi * i * np.arange(N_Z) / N_Z) for i in (0, 1)]) / N_Z
ROOT = RNG.standard_normal((N_Z, N_Z)) / 8


def forms(n_a: int) -> dict[str, dict[str, Any]]:
    """Every form of a cost, as arguments."""
    whole = np.eye(n_a) + 0.2 * np.ones((n_a, n_a))
    return {
        "diagonals": {
            "state_weight": np.linspace(0, 2, N_Z),
            "action_weight": np.arange(n_a) + 1.0,
        },
        "matrices": {"state_weight": ROOT.T @ ROOT, "action_weight": whole},
        "output over time": {
            "output": WAVES,
            "target": np.sin(np.arange(2 * T + 2)).reshape(-1, 2),
        },
        "actions": {"action_target": 0.1 * np.arange(n_a), "terminal_weight": 3.0},
        "another target": {"target": 0.3},
    }


def problem(name: str, form: str) -> pdeloop.Problem:
    n_a = SHIPPED[name]
    return pdeloop.problem(name, n_z=N_Z, n_a=n_a, horizon=T, cost=forms(n_a)[form])


FORMS = [*forms(6)]
CASES = [(name, form) for name in SHIPPED for form in FORMS]


@pytest.mark.parametrize(("name", "form"), CASES)
def test_an_episode_costs_what_the_formula_says(name: str, form: str) -> None:
    plant = problem(name, form).plant(3)
    a = 0.1 * RNG.standard_normal((T, 3, plant.n_a))
    episode = pdeloop.rollout(plant, lambda k, z: a[k], [0, 1, 2])
    given = forms(plant.n_a)[form]
    C = given.get("output", np.eye(N_Z))
    square = lambda w, n: np.asarray(w) if np.ndim(w) == 2 else np.diag(np.broadcast_to(w, n))  # noqa: E731
    Q = square(given.get("state_weight", plain(name).state_weight), len(C))
    R = square(given.get("action_weight", plain(name).action_weight), plant.n_a)
    y_r = np.broadcast_to(given.get("target", plain(name).target), (T + 1, len(C)))
    e, d = episode.states @ C.T - y_r[:, None], a - given.get("action_target", 0.0)
    expected = np.einsum("kmi,ij,kmj->m", e[:T], Q, e[:T])
    expected += np.einsum("kmi,ij,kmj->m", d, R, d)
    expected += given.get("terminal_weight", 0.0) * (e[T] ** 2).sum(axis=1)
    np.testing.assert_allclose(episode.costs.total, expected, rtol=1e-9)
    alone = pdeloop.rollout(plant, lambda k, z: a[k, 1:2], [1])
    assert alone.costs.total[0] == episode.costs.total[1]


def plain(name: str) -> pdeloop.Plant:
    return pdeloop.problem(name, n_z=N_Z, n_a=SHIPPED[name], horizon=T).plant()


@pytest.mark.parametrize(("name", "form"), CASES)
def test_the_gradient_is_that_of_the_cost(name: str, form: str) -> None:
    plant = problem(name, form).plant()
    gradients, a = pdeloop.Gradients(plant), 0.1 * RNG.standard_normal((T, 1, plant.n_a))
    found, direction = gradients.of_actions(a, [4]), RNG.standard_normal(a.shape)

    def cost(step: float) -> float:
        moved = a + step * direction
        return float(pdeloop.rollout(plant, lambda k, z: moved[k], [4]).costs.mean[0])

    slope = (cost(1e-5) - cost(-1e-5)) / 2e-5
    assert np.sum(found.gradient * direction) == pytest.approx(slope, rel=1e-5, abs=1e-9)


def test_lq_tracking_of_the_exact_linear_plant_cannot_be_improved() -> None:
    """The plant is linear, so that the design, the cost of an episode and its gradient must agree."""
    plant = pdeloop.problem(
        "convection-diffusion-reaction",
        n_z=N_Z,
        horizon=T,
        cost=forms(6)["output over time"],
        n_a=6,
    ).plant()
    zero = np.zeros((N_Z, 6))
    A = plant.evaluate(np.eye(N_Z), zero)[0].T
    B = plant.evaluate(np.zeros((6, N_Z)), np.eye(6))[0].T
    K, b = track_horizon(A, B, plant.cost, np.eye(N_Z))
    episode = pdeloop.rollout(plant, lambda k, z: z @ K[k].T + b[k], [2])
    found = pdeloop.Gradients(plant).of_actions(episode.actions, [2])
    start = pdeloop.Gradients(plant).of_actions(0.0 * episode.actions, [2])
    assert np.abs(found.gradient).max() < 1e-8 * np.abs(start.gradient).max()


def test_a_training_uses_it_and_its_bag_is_verified(tmp_path: Any) -> None:
    cost = pdeloop.problem(SMALL, cost={"terminal_weight": 5.0, "action_weight": 0.5 * np.ones(4)})
    texts = cost.values["cost"]
    values = record_run(
        tmp_path / "run",
        cost=texts,
        optimizer="two_point",
        seeds=1,
        iterations=1,
        evaluation_fields=1,
    )
    assert values["cost"] == texts
    report = verify(tmp_path / "run")
    assert report.good and not report.notes, report.text()


def test_a_run_keeps_it_and_evaluates_with_it(tmp_path: Any) -> None:
    given = {"state_weight": np.linspace(0.5, 1.5, 32), "terminal_weight": 2.0}
    small = pdeloop.problem("burgers", n_z=32, horizon=20, cost=given)
    run = pdeloop.train(
        small, rollouts=8, evaluation_fields=2, out=tmp_path / "run", reduced_order=4, **FEW_FITS
    )
    assert run.costs["lqt"].mean() < run.costs["none"].mean()
    again = build_plant(pdeloop.load_run(tmp_path / "run").values)
    assert again.cost.texts == small.plant().cost.texts
    assert (
        again.definition.fingerprint
        != pdeloop.problem("burgers", n_z=32, horizon=20).plant().definition.fingerprint
    )


@pytest.mark.parametrize(
    ("name", "small"),
    [
        ("allen-cahn", {"n_a": 4, "horizon": 30, "reduced_order": 6}),
        ("kdv", {"n_a": 6, "horizon": 40, "reduced_order": 8, "length": 10.0}),
    ],
)
def test_a_law_that_is_trained_for_it_costs_less_than_one_for_the_plain_cost(
    name: str, small: dict[str, Any]
) -> None:
    """Weights of an output, a target of it, and a terminal weight, on fields of neither training."""
    waves = np.array([np.cos(2 * np.pi * i * np.arange(N_Z) / N_Z) for i in range(3)]) / N_Z
    cost = {
        "output": waves,
        "target": [0.2, 0.1, 0.0],
        "state_weight": np.array([100.0, 50.0, 20.0]),
        "action_weight": np.full(small["n_a"], 0.01),
        "terminal_weight": np.full(3, 10.0),
    }
    general, plain = (
        pdeloop.problem(name, n_z=N_Z, **small, **given) for given in ({"cost": cost}, {})
    )
    plant = general.plant(4)
    found = {}
    for which, own in (("general", general), ("plain", plain)):
        run = pdeloop.train(own, rollouts=8, evaluation_fields=2, **FEW_STEPS)
        law = pdeloop.projected_law(plant, run.models[0].U, run.policies[0])
        found[which] = pdeloop.rollout(plant, law, [100, 101, 102, 103]).costs.mean.mean()
    none = pdeloop.rollout(plant, lambda k, z: np.zeros((4, plant.n_a)), [100, 101, 102, 103])
    assert found["general"] < min(0.98 * found["plain"], 0.9 * none.costs.mean.mean())


def test_states_that_run_away_cost_what_a_divergence_costs() -> None:
    plant = pdeloop.problem("burgers", n_z=N_Z, horizon=T, cost={"terminal_weight": 1.0}).plant(2)
    wild = np.array([np.zeros(6), np.full(6, 1e200)])
    plant.step(wild)
    assert plant.episode_costs().diverged_step.tolist() == [-1, 0]
    assert np.isfinite(plant.states).all()
    still = plant.states[1].copy()
    plant.step(np.zeros((2, 6)))
    assert same_bits(plant.states[1], still)


def test_a_cost_of_other_sizes_is_refused_in_a_sentence() -> None:
    texts = Cost(N_Z, 6, T, terminal_weight=1.0).texts
    with pytest.raises(
        ValueError, match="the cost is for horizon 12, but this plant has horizon 13"
    ):
        pdeloop.problem("burgers", n_z=N_Z, horizon=13, cost=texts)
    with pytest.raises(ValueError, match="a cost has no 'weights'; it has state_weight"):
        pdeloop.problem("burgers", cost={"weights": 1.0})
    with pytest.raises(ParameterError, match="parameter 'cost': 'nonsense' is not a cost"):
        pdeloop.problem("burgers", cost=["nonsense"])
