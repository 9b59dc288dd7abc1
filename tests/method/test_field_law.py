# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A law from a model of the whole field is optimal on the linearised plant."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from controller_node.identification import Designed, DesignSettings, design_each, designed
from pdeloop.field_report import summary, text
from pdeloop.messages.action_set import ActionSet
from pdeloop.messages.cost import Cost
from pdeloop.messages.model_rows import ModelRows, unpack
from pdeloop.method.design import lqt
from pdeloop.method.design.field_law import (
    FieldLaw,
    field_law,
    linearisation_point,
    states_under,
)
from pdeloop.method.design.lqt import DesignError, regulator
from pdeloop.method.models import Measured, affine_law
from pdeloop.method.models.finite_difference import features_of, of_features
from pdeloop.method.models.selection import Accuracy, FittedModel, Selection
from pdeloop.method.models.spectral import SpectralModel
from pdeloop.method.reduce.reduced_model import IdentificationSettings, ReducedModel
from tests.support.small import FEW_FITS

Array = np.ndarray
N_Z, N_A, STEPS = 24, 3, 64
Q, R = 1.0, 2.0


def cost_to(target: Array) -> Cost:
    return Cost(N_Z, N_A, STEPS, state_weight=Q, action_weight=R, target=target)


def plant() -> SpectralModel:
    """Waves up to the third grow until a cubic holds them; the actuators are blocks of the domain."""
    waves = np.arange(N_Z // 2 + 1)
    linear = (0.1 - 0.02 * waves**2).astype(complex)
    B = 0.1 * np.kron(np.eye(N_A), np.ones((N_Z // N_A, 1))) * (np.arange(N_Z) % 3 > 0)[:, None]
    one = np.ones((1, len(waves)), complex)
    return SpectralModel("true", linear, one, np.array([[0.0, -0.1]]), B, np.zeros(N_Z), 2)


def episode(model: SpectralModel, noise: float = 0.0) -> tuple[Array, Array]:
    rng = np.random.default_rng(3)
    states = [0.01 * rng.standard_normal(N_Z)]
    actions = 0.1 * rng.standard_normal((STEPS, N_A))
    for a in actions:
        states.append(model.step(states[-1][None], a[None])[0])
    return np.array(states) + noise * rng.standard_normal((STEPS + 1, N_Z)), actions


def settings(identification: str, **constants: int) -> DesignSettings:
    return DesignSettings(N_A, 6, Q, R, identification=identification, constants=constants)


def law(true: SpectralModel, target: Array) -> ModelRows:
    """The field law, compared with no control."""
    trajectories = [episode(true)]
    other = designed(trajectories, target, settings("regression")).rows
    none = replace(other, K_a=0.0 * other.K_a, K_b=0.0 * other.K_b)
    found = field_law(trajectories, target, none, cost_to(target))
    assert found.better and found.rows is not None
    return found.rows


@pytest.mark.parametrize("size", [0.0, 0.3])
def test_is_the_law_of_the_true_plant_linearised_at_the_target(size: float) -> None:
    true = plant()
    target = size * np.cos(2.0 * np.pi * np.arange(N_Z) / N_Z)
    about, rows = regulator(true, cost_to(target)), law(true, target)
    assert about is not None
    A, K, b = about.A, about.K, about.b + about.K @ target
    np.testing.assert_allclose(rows.U.T @ rows.U, np.eye(6), atol=1e-12)
    assert np.linalg.norm(rows.K_a @ rows.U.T - K) < 0.01 * np.linalg.norm(K)
    constant = K @ target + rows.K_b @ rows.s_r
    np.testing.assert_allclose(constant, b if size else 0.0 * b, atol=0.01)
    np.testing.assert_allclose(rows.A, rows.U.T @ A @ rows.U, atol=0.01)


def test_gives_way_to_a_law_that_costs_no_more() -> None:
    true, target = plant(), np.zeros(N_Z)
    best = law(true, target)
    again = field_law([episode(true)], target, best, cost_to(target))
    assert again.rows is not None and not again.better


def test_actions_that_saturate_are_known_as_such() -> None:
    """Explored beyond the limit, the plant answers to less than what was asked for."""
    true, target, limit = plant(), np.zeros(N_Z), 0.05
    _, asked = episode(true)
    states = [episode(true)[0][0]]
    for a in np.clip(asked, -limit, limit):
        states.append(true.step(states[-1][None], a[None])[0])
    other = designed([(np.array(states), asked)], target, settings("regression")).rows
    given = [(np.array(states), asked)], target, other, cost_to(target)
    found = field_law(*given, action_set=ActionSet(limit=limit))
    without = field_law(*given)
    assert found.fitted is not None and found.fitted.error < 1e-4
    assert without.fitted is None or without.fitted.error > 100 * found.fitted.error
    np.testing.assert_allclose(found.fitted.model.B, true.B, atol=0.02 * np.abs(true.B).max())


def test_takes_the_regression_where_no_model_reproduces_the_episode() -> None:
    target = np.zeros(N_Z)
    noisy = [episode(plant(), noise=1.0)]
    field = settings("field", **FEW_FITS)
    found = designed(noisy, target, field).field
    assert found is not None and found.fitted is not None and found.rows is None
    assert (
        found.fitted.error > IdentificationSettings().field_error
        and "not accurate enough" in text(found)[-1]
    )
    rows, plain = (designed(noisy, target, how).rows for how in (field, settings("regression")))
    assert np.array_equal(rows.U, plain.U) and np.array_equal(rows.policy, plain.policy)


@pytest.mark.parametrize(("strength", "error"), [(1.0, 0.2), (0.001, 0.2), (1.0, 1.0)])
def test_a_saving_within_the_error_of_a_model_is_none(
    strength: float, error: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The saving of a model that is not accepted, the more accurate of two that nothing else judges."""
    true, target = plant(), np.zeros(N_Z)
    model, noisy = replace(true, B=strength * true.B), [episode(true, noise=0.1)]
    fitted = FittedModel(
        model,
        error,
        [],
        Accuracy(0.5, 0.5),
        [Measured(*noisy[0])],
        IdentificationSettings().field_error,
    )
    monkeypatch.setattr(Selection, "select", lambda *_: fitted)
    field = settings("field", **FEW_FITS)
    begun, plain = (designed(noisy, target, field, or_no_control=own) for own in (True, False))
    assert begun.field is not None and begun.field.judges == (model.kind,)
    doubtful = (strength, error) != (1.0, 0.2)
    assert begun.field.doubtful is summary(begun.field)["doubtful"] is doubtful
    assert ("begins from no control" in text(begun.field)[-1]) is doubtful
    assert begun.rows.policy.any() is not doubtful and plain.rows.policy.any()


@pytest.mark.parametrize("noise", [0.0, 1.0])
def test_stands_alone_where_the_regression_has_no_stabilising_gains(
    noise: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A regression may have unstable modes that no input reaches, if an episode ran away."""
    true, target = plant(), np.zeros(N_Z)
    expected = law(true, target)

    def unsolved(*_: object, **__: object) -> None:
        raise DesignError("not stabilisable")

    monkeypatch.setattr("pdeloop.method.design.lqt.track", unsolved)
    if noise:  # no model of the whole field either
        with pytest.raises(DesignError, match="not stabilisable"):
            designed([episode(true, noise)], target, settings("field", **FEW_FITS))
        return
    found = designed([episode(true)], target, settings("field"))
    assert np.array_equal(found.rows.policy, expected.policy)
    assert found.field is not None and "its law is used" in text(found.field)[-1]
    with pytest.raises(DesignError, match="not stabilisable"):
        designed([episode(true)], target, settings("regression"))


def test_two_explorations_give_one_law_for_the_fields_of_both() -> None:
    """Each begins with a wave that the other does not have; the law of both senses both."""
    true, target = plant(), np.zeros(N_Z)
    x = 2.0 * np.pi * np.arange(N_Z) / N_Z
    trajectories = []
    for wave in (1, 2):
        states = [0.5 * np.cos(wave * x)]
        actions = 0.02 * np.random.default_rng(wave).standard_normal((STEPS, N_A))
        for a in actions:
            states.append(true.step(states[-1][None], a[None])[0])
        trajectories.append((np.array(states), actions))
    states, actions = (np.stack(parts, axis=1) for parts in zip(*trajectories, strict=True))
    one, same = design_each(states, actions, [4, 4], target, settings("field"))
    assert np.array_equal(one, same)
    rows = unpack(one, N_A)
    ours = affine_law(rows.K_a @ rows.U.T, rows.K_b @ rows.s_r)
    single = unpack(design_each(states, actions, [4, 5], target, settings("regression"))[0], N_A)
    other = affine_law(single.K_a @ single.U.T, single.K_b @ single.s_r)
    for z, _ in trajectories:
        ends = [states_under(true, own, [z[0]], STEPS)[0][-1] for own in (ours, other)]
        assert np.linalg.norm(ends[0]) < 0.5 * np.linalg.norm(z[-1])
    assert np.linalg.norm(ends[0]) < np.linalg.norm(ends[1])


def test_predicts_what_the_laws_cost_and_tells_of_the_choice() -> None:
    true, target = plant(), np.zeros(N_Z)
    regression = designed([episode(true)], target, settings("regression")).rows
    found = field_law([episode(true)], target, regression, cost_to(target))
    assert found.rows is not None and found.fitted is not None
    for rows, predicted in ((found.rows, found.cost), (regression, found.other_cost)):
        z, total = episode(true)[0][:1], 0.0
        for _ in range(STEPS):
            a = z @ rows.U @ rows.K_a.T
            total += Q * np.sum(z**2) + R * np.sum(a**2)
            z = true.step(z, a)
        assert predicted == pytest.approx(total / STEPS, rel=1e-2)
    told, known = "\n".join(text(found)), summary(found)
    assert all(kind in told for kind, _ in found.fitted.candidates)
    assert ("its law is used" in told) is found.better is (known["law"] == "field")
    nothing = FieldLaw(None)
    assert "regression" in text(nothing)[0] and summary(nothing)["predicted_cost"] is None


ROD = np.array([[0.9, 0.05, 0, 0], [0.05, 0.85, 0.05, 0], [0, 0.05, 0.85, 0.05], [0, 0, 0.05, 0.9]])
HEATERS = np.array([[0.1, 0], [0.02, 0], [0, 0.03], [0, 0.12]])
FAR = np.array([8.0, 5.0, 5.0, 8.0])


def rod_log(seed: int, units: float | Array = 1.0) -> list[tuple[Array, Array]]:
    """Two logs without noise of a rod with two heaters, and its states in these units."""
    rng, found = np.random.default_rng(seed), []
    for _ in range(2):
        states, actions = [rng.standard_normal(4)], 3.0 * rng.standard_normal((120, 2))
        for a in actions:
            states.append(ROD @ states[-1] + HEATERS @ a)
        found.append((np.array(states) * units, actions))
    return found


def rod_cost(rows: ModelRows) -> float:
    z, total = np.zeros(4), 0.0
    for _ in range(120):
        a = rows.K_a @ rows.U.T @ z + rows.K_b @ rows.s_r
        total += np.sum((z - FAR) ** 2) + 0.001 * np.sum(a**2)
        z = ROD @ z + HEATERS @ a
    return float(total)


@pytest.mark.parametrize("seed", [1, 2])
def test_a_model_that_is_exact_wins_however_far_the_target_is(seed: int) -> None:
    """Relative to a far target every model has a small error, also one that is no better than none."""
    best = lqt.track(ReducedModel(ROD, HEATERS, np.eye(4)), state_weight=1.0, action_weight=0.001)
    exact = ModelRows(ROD, HEATERS, np.eye(4), best.K_a, best.K_b, FAR)
    how = DesignSettings(2, 4, 1.0, 0.001, identification="field")
    found = designed(rod_log(seed), FAR, how)
    assert rod_cost(found.rows) < 1.02 * rod_cost(exact)
    assert found.field is not None and found.field.regression.simulated < 1e-20
    assert "regression" in found.field.judges


def test_the_units_of_the_states_change_nothing() -> None:
    """What is a hundredth of another unit is weighted ten thousand times, and the law is the same."""
    units = np.array([1.0, 0.1, 500.0, 10.0])
    weights = Cost(4, 2, 120, state_weight=units**-2, action_weight=0.001, target=FAR * units)
    laws = []
    for scale, texts in ((np.ones(4), []), (units, weights.texts)):
        how = DesignSettings(2, 4, 1.0, 0.001, identification="field", cost=texts)
        rows = designed(rod_log(1, scale), FAR * scale, how).rows
        laws.append(np.column_stack([rows.K_a @ rows.U.T * scale, rows.K_b @ rows.s_r]))
    np.testing.assert_allclose(laws[1], laws[0], rtol=1e-5, atol=1e-6)


def test_a_law_of_the_suggested_order_senses_what_all_actuators_need() -> None:
    """POD modes are those of the largest numbers: here of a pressure that costs nothing."""
    rng, logs = np.random.default_rng(7), []
    for z, a in rod_log(4):
        pressure = 1e4 + np.cumsum(50.0 * rng.standard_normal(len(z)))
        logs.append((np.column_stack([z + 0.02 * rng.standard_normal(z.shape), pressure]), a))
    target = np.append(FAR / 8.0, 0.0)
    cost = Cost(5, 2, 120, state_weight=[1, 1, 1, 1, 0], action_weight=0.001, target=target)
    how = DesignSettings(2, 0, 1.0, 0.001, identification="field", cost=cost.texts)
    rows = designed(logs[:1], target, how, further=logs[1:]).rows
    assert rows.U.shape[1] >= 4
    z = np.append(np.zeros(4), 1e4)
    for _ in range(200):
        a = rows.K_a @ rows.U.T @ z + rows.K_b @ rows.s_r
        z[:4] = ROD @ z[:4] + HEATERS @ a
    best = lqt.track(ReducedModel(ROD, HEATERS, np.eye(4)), state_weight=1.0, action_weight=0.001)
    rest = np.zeros(4)
    for _ in range(200):
        rest = ROD @ rest + HEATERS @ (best.K_a @ rest + best.K_b @ target[:4])
    np.testing.assert_allclose(z[:4], rest, atol=0.15)


@pytest.mark.parametrize(
    ("judges", "whole", "reduced", "gains_of"),
    [((), 0.83, 0.74, 2), ((), 0.81, 0.94, 3), (("linear",), 0.83, 0.74, 3)],
)
def test_the_law_of_few_modes_is_taken_where_no_model_is_accepted_and_they_predict_better(
    judges: tuple[str, ...],
    whole: float,
    reduced: float,
    gains_of: int,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def made(_: object, target: Array, known: DesignSettings, **__: object) -> Designed:
        n_s, own = (3, whole) if known.reduced_order else (2, reduced)
        basis, gains = np.eye(3)[:, :n_s], np.ones((1, n_s))
        rows = ModelRows(np.eye(n_s), gains.T, basis, gains, gains, gains[0])
        return Designed(rows, FieldLaw(None, regression=Accuracy(own, own), judges=judges))

    monkeypatch.setattr("controller_node.identification.designed", made)
    known = replace(settings("field"), n_a=1, reduced_order=0)
    (rows,) = design_each(np.zeros((5, 1, 3)), np.zeros((4, 1, 1)), [0], np.zeros(3), known)
    law = unpack(rows, n_a=1)
    assert law.U.shape == (3, 3)  # which an adaptation may need all of
    assert np.array_equal(law.K_a[0], np.arange(3) < gains_of)
    assert np.array_equal(law.K_b, law.K_a)


def test_every_accepted_model_judges_every_law() -> None:
    """With noise both models are as good, and the law is not worse than the other by either."""
    rng = np.random.default_rng(5)
    log = [(z + 0.01 * rng.standard_normal(z.shape), a) for z, a in rod_log(3)]
    how = DesignSettings(2, 4, 1.0, 0.001, identification="field")
    other = designed(log, FAR, replace(how, identification="regression")).rows
    found = field_law(log, FAR, other, Cost(4, 2, 120, action_weight=0.001, target=FAR))
    assert found.fitted is not None and found.rows is not None
    assert found.judges == (found.fitted.model.kind, "regression")
    assert np.isfinite([found.cost, found.other_cost]).all()
    assert rod_cost(designed(log, FAR, how).rows) < 1.1 * rod_cost(other)


@pytest.mark.parametrize(
    ("error", "distance", "there"),
    [(0.01, 1.0, True), (0.01, 40.0, False), (1e-4, 40.0, True)],
)
def test_where_nothing_was_measured_only_an_exact_model_is_linearised(
    error: float, distance: float, there: bool
) -> None:
    rng = np.random.default_rng(0)
    states, actions = rng.uniform(-1.0, 1.0, (50, 6)), rng.standard_normal((49, 1))
    features = features_of(1)
    model = of_features(
        "x", features, np.zeros((len(features), 1, 6)), np.zeros((6, 1)), np.zeros(6), 1
    )
    target = np.full(6, distance)
    point, told = linearisation_point(
        [(states, actions)], target, FittedModel(model, 0.0, [], Accuracy(error, 0.1)), 2e-3
    )
    nearest = states[np.argmin(np.linalg.norm((states - target) / states.std(axis=0), axis=1))]
    assert np.array_equal(point, target if there else nearest)
    assert ("measured" in told) is (distance > 3.0)


def test_a_model_is_linearised_at_actions_that_were_applied() -> None:
    """z+ = 0.9 z + 0.001 a^2 of a valve between 10 and 60: no effect at 0, and 0.07 at its mean."""
    rng = np.random.default_rng(0)
    a, z = rng.uniform(10.0, 60.0, (200, 1)), np.full((201, 1), 15.0)
    for k in range(200):
        z[k + 1] = 0.9 * z[k] + 0.001 * a[k] ** 2
    for sign in (1.0, -1.0):
        own = DesignSettings(1, 1, 1.0, 1e-6, identification="field")
        found = designed([(z, sign * a)], np.array([16.0]), own).field
        assert found is not None and found.rows is not None and found.fitted is not None
        assert found.fitted.model.kind == "polynomial"
        assert (found.rows.U @ found.rows.B).item() == pytest.approx(
            0.002 * sign * a.mean(), abs=1e-4
        )
