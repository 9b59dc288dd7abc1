# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""How often chance passes for a difference: rates that are known from the theory of small samples."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest
from scipy.special import ndtr

from pdeloop.messages.arrays import Array
from pdeloop.method.adapt import Record
from pdeloop.method.adapt.verdict import (
    ADAPTED,
    ALL_AGREE,
    FIRST,
    NONE,
    ZERO,
    Estimate,
    Evidence,
    choose,
    evidence_of_rollouts,
    mean_change,
)

DRAWS = 2000


def upper(rate: float, draws: int = DRAWS) -> float:
    """What a share of as many draws of this rate exceeds in one case of 30,000."""
    return rate + 4.0 * float(np.sqrt(rate * (1.0 - rate) / draws))


def of_pairs(costs: Mapping[str, Array], base: str) -> dict[str, Evidence]:
    """The evidence of costs of laws, field by field."""
    laws = {name: np.full((1, 1), float(i)) for i, name in enumerate(costs)}
    none = np.empty((0, 0))
    seen = [
        Record(laws[name], cost, none, none, field_seed=i)
        for name, own in costs.items()
        for i, cost in enumerate(own.tolist())
    ]
    return evidence_of_rollouts(laws, base, seen)


@pytest.mark.parametrize(("pairs", "confidence"), [(2, 1.0), (3, 2.0), (8, 1.0)])
def test_pairs_without_a_difference_are_taken_for_one_at_the_level_however_few(
    pairs: int, confidence: float
) -> None:
    """Student's t is exact for normal differences; a normal quantile would be wrong up to 0.25."""
    rng, wrong = np.random.default_rng(pairs), 0
    level = 1.0 - float(ndtr(confidence))
    for difference in rng.standard_normal((DRAWS, pairs)):
        costs = {FIRST: np.full(pairs, 9.0), ADAPTED: 9.0 + difference}
        verdict = choose(of_pairs(costs, FIRST), FIRST, confidence)
        wrong += verdict.chosen == ADAPTED
    assert 2.0 * level - upper(level) < wrong / DRAWS < upper(level)


@pytest.mark.parametrize("said", [-3.0, 3.0])
@pytest.mark.parametrize("measured", [-3.0, 3.0])
def test_where_chance_explains_everything_no_control_is_kept_only_if_an_estimate_favours_it(
    said: float, measured: float
) -> None:
    """The first law, which was designed for the plant, is kept in any case."""
    costs = np.array([30.0, 60.0, 90.0])
    own = costs + measured + np.array([40.0, 0.0, -40.0])
    for base in (NONE, FIRST):
        known = of_pairs({base: costs, ADAPTED: own}, base)
        known[ADAPTED] = replace(known[ADAPTED], also=[Estimate(said, 9.0)])
        found = choose(known, base, 1.0)
        better = said < 0.0 and measured < 0.0 and base == NONE
        assert found.chosen == (ADAPTED if better else base)
        assert (ALL_AGREE in found.reason) == better


@pytest.mark.parametrize(
    ("own", "others", "ratio"), [(2, 2, 5.0), (3, 12, 0.2), (2, 40, 1.0), (8, 8, 1.0)]
)
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


def test_a_change_by_the_same_share_has_no_error() -> None:
    before = np.random.default_rng(3).gamma(1.0, 1.0, 6)
    change = mean_change(0.9 * before, before)
    assert change.error < 1e-15 < -change.value and change.is_negative(3.0)
    assert mean_change(before[:1], before[:1] + 1.0).error == 1.0, "of one, as large as itself"
