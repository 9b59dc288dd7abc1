# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""How often chance passes for a difference: rates that are known from the theory of small samples."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import ndtr, stdtr

from pdeloop.method.adapt.estimate import ZERO, Estimate, mean_change, mean_difference, mean_of
from pdeloop.method.adapt.verdict import (
    ADAPTED,
    ALL_AGREE,
    FIRST,
    NONE,
    Evidence,
    Verdict,
    choose,
    evidence_against_none,
    evidence_of_pairs,
)

DRAWS = 4000


FEWER = 1000


def upper(rate: float, draws: int = DRAWS) -> float:
    """What a share of as many draws of this rate exceeds in one case of 30,000."""
    return rate + 4.0 * float(np.sqrt(rate * (1.0 - rate) / draws))


@pytest.mark.parametrize("pairs", [2, 3, 5, 8])
@pytest.mark.parametrize("confidence", [1.0, 2.0])
def test_pairs_without_a_difference_are_taken_for_one_at_the_level_however_few(
    pairs: int, confidence: float
) -> None:
    """Student's t is exact for normal differences; a normal quantile would be wrong up to 0.25."""
    rng, wrong = np.random.default_rng(pairs), 0
    level = 1.0 - float(ndtr(confidence))
    for difference in rng.standard_normal((DRAWS, pairs)):
        costs = {FIRST: np.full(pairs, 9.0), ADAPTED: 9.0 + difference}
        verdict = choose(evidence_of_pairs(costs, FIRST), FIRST, confidence)
        wrong += verdict.chosen == ADAPTED
    assert 2.0 * level - upper(level) < wrong / DRAWS < upper(level)


def against_none(
    rng: np.random.Generator, together: float, spread: float, fields: int, others: int, more: float
) -> Verdict:
    """A law on some fields, where no control's costs have a correlation with its own and a spread.

    others: fields of no control alone; more: what the law costs more in the mean.
    """
    own, apart = rng.standard_normal((2, fields))
    none = spread * (together * own + np.sqrt(1.0 - together**2) * apart)
    costs = {ADAPTED: 100.0 + more + own, NONE: 100.0 + none}
    before = 100.0 + spread * rng.standard_normal(others)
    said = {ADAPTED: [Estimate(-1.0, np.inf)]}
    return choose(evidence_against_none(costs, before, said), NONE, 1.0)


@pytest.mark.parametrize("together", [-0.9, 0.0, 0.9])
@pytest.mark.parametrize("spread", [1.0, 5.0])
@pytest.mark.parametrize(("fields", "others"), [(2, 3), (3, 3)])
def test_a_law_as_good_as_no_control_is_better_beyond_chance_no_more_often_than_the_level(
    together: float, spread: float, fields: int, others: int
) -> None:
    """Whatever one law's costs say of the other's: not more than 2 % above the level."""
    rng, wrong = np.random.default_rng([fields, others]), 0
    for _ in range(FEWER):
        found = against_none(rng, together, spread, fields, others, 0.0)
        wrong += found.chosen == ADAPTED and ALL_AGREE not in found.reason
    assert wrong / FEWER < upper(1.0 - float(ndtr(1.0)), FEWER) + 0.02


@pytest.mark.parametrize("together", [0.0, 0.9])
@pytest.mark.parametrize("sizes", [0.0, 1.0, 2.0])
def test_a_law_that_costs_more_than_no_control_is_seldom_taken(
    together: float, sizes: float
) -> None:
    """Less often than all pairs together favour it, by however many standard errors it is worse."""
    rng = np.random.default_rng(7)
    pairs = float(np.sqrt((1.0 + 25.0 - 10.0 * together) / 3.0))
    taken = sum(
        against_none(rng, together, 5.0, 3, 3, sizes * pairs).chosen == ADAPTED
        for _ in range(FEWER)
    )
    assert taken / FEWER < upper(float(ndtr(-sizes)), FEWER)


def test_fields_that_cost_one_law_more_and_the_other_less_add_to_the_error() -> None:
    """By as much as in pairs, where there are no others."""
    own, before, none = np.array([3.0, 1.0, 2.0]), np.array([5.0, 9.0, 7.0]), np.zeros(0)
    assert mean_difference(own, before, none).error == pytest.approx(mean_of(own - before).error)
    alike = mean_difference(own, 14.0 - before, none)
    assert alike.error == pytest.approx((mean_of(own) - mean_of(before)).error)


def test_rollouts_without_control_count_from_whatever_field() -> None:
    """Three pairs leave doubt where no control's costs vary; its other rollouts settle it."""
    costs = {ADAPTED: np.array([55.0, 52.0, 48.0]), NONE: np.array([34.0, 47.0, 103.0])}
    pairs = choose(evidence_of_pairs(costs, NONE), NONE, 1.0)
    assert pairs.chosen == NONE
    before = np.array([47.0, 93.0, 113.0])
    found = choose(evidence_against_none(costs, before, {}), NONE, 1.0)
    assert found.chosen == ADAPTED and ALL_AGREE not in found.reason
    every = np.concatenate([costs[NONE], before])
    assert found.change == pytest.approx(costs[ADAPTED].mean() - every.mean())


@pytest.mark.parametrize("said", [-3.0, 3.0])
@pytest.mark.parametrize("measured", [-3.0, 3.0])
def test_where_chance_explains_everything_no_control_is_kept_only_if_an_estimate_favours_it(
    said: float, measured: float
) -> None:
    """The first law, which was designed for the plant, is kept in any case."""
    costs = np.array([30.0, 60.0, 90.0])
    own = costs + measured + np.array([40.0, 0.0, -40.0])
    known = {ADAPTED: [Estimate(said, 9.0)]}
    evidence = evidence_against_none({ADAPTED: own, NONE: costs}, costs, known)
    found = choose(evidence, NONE, 1.0)
    better = said < 0.0 and measured < 0.0
    assert found.chosen == (ADAPTED if better else NONE)
    assert (ALL_AGREE in found.reason) == better
    first = {FIRST: evidence[NONE], ADAPTED: evidence[ADAPTED]}
    assert choose(first, FIRST, 1.0).chosen == FIRST


def test_no_control_that_diverged_loses_and_so_does_a_law() -> None:
    own, none = np.array([3.0, 4.0]), np.array([5.0, 6.0])
    lost = evidence_against_none({ADAPTED: own, NONE: none}, np.array([7.0, np.inf]), {})
    assert choose(lost, NONE, 1.0).reason == "a rollout of no control diverged"
    bad = np.array([3.0, np.inf])
    kept = choose(evidence_against_none({ADAPTED: bad, NONE: none}, none, {}), NONE, 1.0)
    assert kept.chosen == NONE and kept.reason == "a rollout of the last law diverged"


@pytest.mark.parametrize(("own", "others"), [(2, 2), (3, 12), (2, 40), (8, 8)])
@pytest.mark.parametrize("ratio", [0.2, 1.0, 5.0])
def test_laws_of_one_cost_on_different_fields_are_told_apart_no_more_often_than_the_level(
    own: int, others: int, ratio: float
) -> None:
    """By the approximation of Welch and Satterthwaite: not more than 1 % above it."""
    rng, wrong = np.random.default_rng([own, others]), 0
    level = 1.0 - float(ndtr(1.0))
    for _ in range(DRAWS):
        first = Evidence(ZERO, ratio * rng.standard_normal(others))
        other = Evidence(ZERO, rng.standard_normal(own))
        wrong += choose({FIRST: first, ADAPTED: other}, FIRST, 1.0).chosen == ADAPTED
    assert wrong / DRAWS < upper(level) + 0.01


def test_the_degrees_of_two_means_are_those_of_welch() -> None:
    # Not at the top: every worker imports all files of tests.
    from scipy.stats import ttest_ind

    rng = np.random.default_rng(4)
    a, b = rng.standard_normal(3), 4.0 * rng.standard_normal(7)
    found, expected = mean_of(a) - mean_of(b), ttest_ind(a, b, equal_var=False)
    assert found.degrees == pytest.approx(expected.df)
    assert found.value / found.error == pytest.approx(expected.statistic)
    assert (mean_of(a) + ZERO) == mean_of(a) == (ZERO + mean_of(a))


def test_an_error_that_is_known_from_many_fields_is_hardly_enlarged() -> None:
    """A small error of three rollouts, next to a larger one of a control variate on forty fields."""
    both = Estimate(-1.0, 0.9, 39.0) + Estimate(0.0, 0.1, 2.0)
    assert both.degrees > 39.0 and both.is_negative(1.0)
    few = Estimate(-1.0, both.error, 2.0)
    assert not few.is_negative(1.0)
    assert few.is_negative(float(ndtr(0.0))) and stdtr(2.0, -1.0 / few.error) > 1.0 - ndtr(1.0)


def test_errors_without_bound_stay_so() -> None:
    huge = Estimate(-1.0, 1e200, 2.0) + Estimate(0.0, 1e200, 2.0)
    assert huge.degrees == pytest.approx(4.0) and np.isfinite(huge.error)
    assert not (Estimate(-1.0, np.inf) + huge).is_negative(1.0)


def test_a_change_by_the_same_share_has_no_error() -> None:
    before = np.random.default_rng(3).gamma(1.0, 1.0, 6)
    change = mean_change(0.9 * before, before)
    assert change.error < 1e-15 < -change.value and change.is_negative(3.0)
    assert mean_change(before[:1], before[:1] + 1.0).error == 1.0, "of one, as large as itself"
