# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The law that plans on a model: what its theta holds, its memory, and the training that makes it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import pdeloop
from controller_node.law_batch import LawBatch
from pdeloop.evaluation import evaluate
from pdeloop.export import law_of
from pdeloop.finished_run import merged
from pdeloop.messages.action_set import ActionSet
from pdeloop.messages.cost import Cost
from pdeloop.messages.model_rows import ModelRows
from pdeloop.messages.spec import ParameterError
from pdeloop.method.adapt.base import Context, Rollout, RolloutResult, Trajectory
from pdeloop.method.adapt.improve import ModelBasedSettings
from pdeloop.method.adapt.model_based import ModelBased
from pdeloop.method.adapt.model_based_predictive import (
    DRAWN,
    MEASURED,
    ModelBasedPredictive,
)
from pdeloop.method.laws import Law, Predictive
from pdeloop.method.laws.plans import Planner
from pdeloop.method.laws.predictive import Auto
from pdeloop.method.laws.registry import action, updated
from pdeloop.method.models.base import FieldModelSettings
from pdeloop.method.settings import Settings
from tests.method.test_plans import N_A, N_Z, T, general_cost, spectral
from tests.support.planned import FEW_STARTS, PROBLEM, trained
from tests.support.small import FEW_FITS
from tuner_node.narration import closing_lines

RNG = np.random.default_rng(1)
U = np.linalg.qr(RNG.standard_normal((N_Z, 3)))[0]
GAINS = 0.02 * RNG.standard_normal((N_A, 6))
ROWS = ModelRows(np.eye(3), np.ones((3, N_A)), U, GAINS[:, :3], GAINS[:, 3:], U.T @ np.ones(N_Z))
STATES = RNG.standard_normal((6, N_Z))


def law(cost: Cost | None = None) -> Predictive:
    made = Predictive(ROWS, T)
    made.cost = cost
    return made


def theta(own: Predictive, **changed: object) -> np.ndarray:
    model = spectral()
    K = np.ascontiguousarray(ROWS.K_a @ U.T)
    cost = own.cost or Cost(N_Z, N_A, T, action_weight=0.5, target=np.full(N_Z, 0.3))
    made = Planner(
        model,
        cost,
        ActionSet(N_A, -0.5, [0.4, np.inf]),
        K,
        ROWS.K_b @ ROWS.s_r,
        around=True,
        steps=10,
        terminal=True,
    )
    return own.theta_of(own.without.theta_start, replace(made, **changed))  # type: ignore[arg-type]


def actions_of(own: Law, theta: np.ndarray, states: np.ndarray = STATES) -> np.ndarray:
    batch = LawBatch([own], np.ones(N_Z))
    batch.set(theta[None])
    return np.stack([batch.actions(k, z[None])[0] for k, z in enumerate(states)])


def test_in_a_batch_with_plans_the_affine_law_acts_as_alone() -> None:
    own, batch = law(), LawBatch([law()], np.ones(N_Z))
    planned = theta(own)
    affine = np.zeros_like(planned)
    affine[: own.size] = own.theta_start
    batch.set(np.stack([affine, planned, affine]))
    together = np.stack([batch.actions(k, np.tile(z, (3, 1))) for k, z in enumerate(STATES)])
    for m, one in enumerate((affine, planned, affine)):
        assert np.array_equal(together[:, m], actions_of(own, one))


@pytest.mark.parametrize("cost", [None, general_cost()], ids=["plain", "general"])
def test_what_theta_holds_is_the_planner_and_zeros_at_its_end_mean_nothing(
    cost: Cost | None,
) -> None:
    own = law(cost)
    whole = theta(own)
    assert own.is_extended(whole) and not own.is_extended(own.theta_start)
    found = own.planner(own.parts(whole))
    z, v = STATES[:2], RNG.standard_normal((2, 10, N_A))
    expected = replace(found, model=spectral()).costs(v, z, 0)
    assert np.array_equal(found.costs(v, z, 0), expected)
    acted = actions_of(own, whole)
    assert np.array_equal(actions_of(law(cost), np.append(whole, np.zeros(9))), acted)
    assert (acted >= -0.5).all() and (acted[:, 0] <= 0.4).all()


def test_steps_at_which_the_law_that_it_began_as_has_the_better_plan_are_counted() -> None:
    """A plan of large numbers in the memory is worse than none."""
    own, batch = law(), LawBatch([law()], np.ones(N_Z))
    batch.set(theta(law())[None])
    parts, memory = own.parts(theta(own)), own.memory_start()
    for k in range(3):
        a = action(own, parts, STATES[k], memory, k)
        assert np.array_equal(batch.actions(k, STATES[k : k + 1])[0], a)
        memory = updated(own, parts, STATES[k], memory, a, k)
    before, memory[:10] = own.fallbacks, 1e3
    assert batch.fallbacks == before
    action(own, parts, STATES[3], memory, 3)
    action(own, parts, STATES[3], memory, 3)  # once for one state
    assert own.fallbacks == before + 1


def test_theta_holds_which_law_a_plan_deviates_from() -> None:
    own = law()
    found = own.planner(own.parts(theta(own, regulated=True)))
    assert found.regulated and not own.planner(own.parts(theta(own))).regulated
    assert own.is_extended(theta(own, regulated=True)) and found.regulator is not None


def test_its_memory_is_a_function_of_the_states_of_the_episode() -> None:
    """Another controller that is given the same states answers with the same bits."""
    own = law()
    whole = theta(own)
    parts, memory = own.parts(whole), own.memory_start()
    for k, (z, expected) in enumerate(zip(STATES, actions_of(law(), whole), strict=True)):
        for asked in (own, law()):
            assert np.array_equal(action(asked, parts, z, memory, k), expected)
        memory = updated(own, parts, z, memory, expected, k)
        assert memory.shape == (own.memory_size,)


def test_it_plans_within_rate_limits_from_the_action_before() -> None:
    """As the planner does by itself; what the loop clips is within the limits already."""
    own, allowed = law(), ActionSet(N_A, -0.5, 0.4, rate=[0.1, np.inf])
    whole = theta(own, action_set=allowed)
    planner = own.planner(own.parts(whole))
    assert planner.action_set == allowed
    plan, last, expected = np.zeros((1, 10, N_A)), None, []
    for k, z in enumerate(STATES):
        last, plan, _ = planner.step(plan, planner.after(z[None], last), k)
        plan = planner.shifted(plan)
        expected.append(last[0])
    acted = actions_of(own, whole)
    np.testing.assert_array_equal(acted, expected)
    batch = LawBatch([law()], np.ones(N_Z), allowed)
    batch.set(whole[None])
    again = [batch.actions(k, z[None])[0] for k, z in enumerate(STATES)]
    np.testing.assert_array_equal(again, expected)
    moved = np.abs(np.diff(expected, axis=0, prepend=[allowed.start]))
    assert moved[:, 0].max() == pytest.approx(0.1) and moved[:, 1].max() > 0.1


@pytest.mark.parametrize("wrong", [{"steps": T + 60}, {"model": spectral().__class__}])
def test_numbers_that_are_no_planner_are_refused(wrong: dict[str, object]) -> None:
    own = law()
    if "steps" in wrong:
        whole = theta(own, **wrong)
    else:
        whole = theta(own)
        whole[own.size + 40] += 40.0  # in the first array
    with pytest.raises(ValueError):
        own.planner(own.parts(whole))


LINEAR = {
    "n_z": 16,
    "horizon": 40,
    "reduced_order": 6,
    "rollouts": 15,
    "evaluation_fields": 2,
    **FEW_FITS,
}


def test_auto_is_the_affine_law_to_the_bit_where_the_model_has_no_more_to_give(
    tmp_path: Path,
) -> None:
    """Of a linear plant whose horizon is long: only at its end inputs gain on the best affine law."""
    problem, out = "convection-diffusion-reaction", tmp_path / "auto"
    affine = pdeloop.train(problem, **LINEAR)
    auto = pdeloop.train(problem, **LINEAR, law="auto", law_settings=FEW_STARTS, out=out)
    shares = [row["could_save"] for row in auto.result["history"] if "could_save" in row]
    assert shares and all(0.0 <= share <= Auto.worth for share in shares)
    assert np.array_equal(auto.policies[0].ravel(), affine.policies[0].ravel())
    assert all(np.array_equal(auto.costs[name], affine.costs[name]) for name in affine.costs)
    assert auto.affine and law_of(auto).c() == law_of(affine).c()
    assert [own["law"] for own in auto.result["acting"]] == ["affine"]
    closing = "\n".join(closing_lines(problem, auto.result, out))
    assert "the law that acts is affine" in closing and "% more" in closing
    costs = evaluate(pdeloop.load_run(out), fields=2, seed=auto.values["evaluation_seed"])
    assert np.array_equal(costs["adapted"], auto.costs["adapted"])


class Ramp(pdeloop.Dynamics):
    """Two states whose target moves."""

    n_z, n_a, horizon = 2, 1, 8
    target = np.outer(np.arange(9) / 4.0, [1.0, 0.5])

    def initial_state(self, rng: np.random.Generator) -> np.ndarray:
        return rng.standard_normal(2)

    def step(self, z: np.ndarray, a: np.ndarray) -> np.ndarray:
        return np.array([0.9 * z[0] + 0.3 * z[1], 0.8 * z[1] + a[0]])


def test_auto_is_the_default_law_where_it_does_not_plan(tmp_path: Path) -> None:
    few = {"rollouts": 8, "reduced_order": 2, "evaluation_fields": 2}
    plain = pdeloop.train(plant=Ramp(), **few)
    auto = pdeloop.train(plant=Ramp(), **few, law="auto", out=tmp_path / "auto")
    assert plain.values["law"] == "feedforward" and not auto.affine
    assert np.array_equal(auto.policies[0], plain.policies[0].ravel())
    assert np.array_equal(auto.costs["adapted"], plain.costs["adapted"])
    assert law_of(auto).c() == law_of(plain).c()
    closing = closing_lines("ramp", auto.result, tmp_path / "auto")
    assert any("the law that acts is feedforward" in line for line in closing)


def test_auto_plans_on_a_chaotic_plant(tmp_path_factory: pytest.TempPathFactory) -> None:
    out = trained(tmp_path_factory, "auto")
    auto = pdeloop.load_run(out)
    *_, last = auto.result["history"]
    assert last["rollouts"] == 15 and last["chosen"] == "predictive" and not auto.affine
    shares = [row["could_save"] for row in auto.result["history"] if "could_save" in row]
    assert len(shares) == 1 and shares[0] > Auto.worth
    both = merged([replace(auto, policies=auto.warm), auto])  # one plans, the other does not
    assert not both.affine and np.array_equal(both.policies[1], auto.policies[0])
    assert np.array_equal(both.laws[0].parts(both.policies[0])["K_a"], auto.models[0].K_a)
    assert not both.policies[0, auto.warm.shape[1] :].any()
    line = next(
        line for line in closing_lines(PROBLEM, auto.result, out) if "the law that acts" in line
    )
    assert "predictive (the law that plans costs" in line and "ms" in line
    costs = evaluate(auto, fields=2, seed=auto.values["evaluation_seed"])
    assert np.array_equal(costs["adapted"], auto.costs["adapted"])


def optimizer(
    rollouts: int = 10, kind: type[Law] = Predictive, constants: Settings | None = None
) -> ModelBasedPredictive:
    """Of a plant that is the spectral model, judged by rollouts of it."""
    explored = [explored_trajectory(seed) for seed in range(2)]
    context = Context(
        U=U,
        target=np.full(N_Z, 0.3),
        state_weight=1.0,
        action_weight=0.5,
        horizon=T,
        exploration=explored[0],
        further=explored[1:],
        field_models=FieldModelSettings(folds=2, largest_degree=2),
        law=type("Short", (kind,), {"settings": constants or SHORT, "name": kind.name})(ROWS, T),
    )
    own = ModelBased.for_context(context)
    settings = ModelBasedSettings(judging=2, iterations=10, mixtures=2)
    made = own(GAINS.ravel(), seed=3, rollouts=rollouts, settings=settings, context=context)
    assert isinstance(made, ModelBasedPredictive)
    return made


SHORT = replace(Predictive.settings, steps=6, first_iterations=10, starts=1)


def explored_trajectory(seed: int) -> Trajectory:
    rng = np.random.default_rng(seed)
    actions, z = 0.3 * rng.standard_normal((T, N_A)), start(seed)
    states = [z]
    for a in actions:
        states.append(spectral_step(states[-1], a))
    return Trajectory(np.array(states), actions)


def start(seed: int) -> np.ndarray:
    rng, x = np.random.default_rng([9, seed]), 2 * np.pi * np.arange(N_Z) / N_Z
    waves = [rng.normal() * np.cos(j * x) + rng.normal() * np.sin(j * x) for j in (1, 2)]
    return 0.5 * np.sum(waves, axis=0)


PLANT = spectral()


def spectral_step(z: np.ndarray, a: np.ndarray) -> np.ndarray:
    return PLANT.step(z[None], a[None])[0]


def measured(law: Law, rollout: Rollout) -> RolloutResult:
    parts, memory = law.parts(rollout.policy.ravel()), law.memory_start()
    cost, z = Cost(N_Z, N_A, T, action_weight=0.5, target=0.3), start(rollout.field_seed)
    states, actions, total = [z], [], np.zeros(1)
    for k in range(T):
        a = action(law, parts, z, memory, k)
        memory = updated(law, parts, z, memory, a, k)
        cost.add(total, z[None], a[None], k)
        z = spectral_step(z, a)
        states.append(z)
        actions.append(a)
    return RolloutResult(total[0] / T, False, Trajectory(np.array(states), np.array(actions)))


class Eager(Predictive):
    """Keeps rollouts for plans as soon as a model promises any gain."""

    worth = 1e-9


@pytest.mark.parametrize(("rollouts", "kind"), [(6, Predictive), (12, Eager)])
def test_an_optimiser_continues_from_its_state_to_the_bit(
    rollouts: int, kind: type[Predictive]
) -> None:
    own, other = optimizer(rollouts, kind), None
    rows = []
    while not own.done:
        asked = own.ask()
        if other is not None:
            assert all(
                np.array_equal(a.policy, b.policy) for a, b in zip(asked, other.ask(), strict=True)
            )
        results = [measured(own._law, rollout) for rollout in asked]
        rows.append(own.tell(results))
        other = optimizer(rollouts, kind)
        other.restore(own.state())
        assert np.array_equal(other.policy, own.policy) and other.done == own.done
    assert sum("could_save" in row for row in rows) == (kind is Eager)
    assert rows[-1]["rollouts"] == rollouts and rows[-1]["role"] == "judging"
    assert 0.0 <= rows[-2]["plan_fallbacks"] < 1.0 and rows[-2]["plan_saves"] > 0.0
    assert rows[-1]["cost"] == pytest.approx(rows[-1]["predicted"], rel=0.05)


def test_what_is_to_be_had_is_measured_on_fields_that_no_law_was_trained_on() -> None:
    own = optimizer()
    while own._affine.belief is None:
        own.tell([measured(own._law, rollout) for rollout in own.ask()])
    fields, costs = own._simulated(own._affine.belief, own._affine.policy)
    trained = {field.tobytes() for field in own._affine.fields}
    known = [field.tobytes() in trained for field in fields]
    assert known == [True] * MEASURED + [False] * DRAWN and np.isfinite(costs).all()
    again, _ = own._simulated(own._affine.belief, own._affine.policy)
    assert np.array_equal(again, fields)


@pytest.mark.parametrize("name", ["judged", "plans"])
def test_a_checkpoint_that_has_judged_plans_without_having_any_is_refused(name: str) -> None:
    own = optimizer(kind=Predictive)
    with pytest.raises(ValueError, match="it has no law that plans"):
        own.restore({**own.state(), name: np.array(True)})


def test_without_a_model_the_affine_law_stays_and_says_why() -> None:
    own = optimizer(rollouts=6)
    rng, row = np.random.default_rng(0), {}
    while not own.done:
        results = [
            RolloutResult(
                float(rng.uniform(1, 2)),
                False,
                Trajectory(rng.standard_normal((T + 1, N_Z)), rng.standard_normal((T, N_A))),
            )
            for _ in own.ask()
        ]
        row = own.tell(results)
    assert "the affine law stays: no model of the whole field was accepted" in str(row["reason"])
    assert own.policy.size == own._law.size


def test_what_it_does_not_support_is_refused_in_a_sentence() -> None:
    with pytest.raises(ParameterError, match=r"'law_settings.steps' is 60; expected at most .* 50"):
        pdeloop.train("burgers", law="predictive", law_settings={"steps": 60}, horizon=50)
    with pytest.raises(ParameterError, match="choose model_based, or another law"):
        pdeloop.train("burgers", law="predictive", optimizer="two_point")
