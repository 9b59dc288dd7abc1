# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""How far the way from the first law is taken, which law is returned, and with what reason."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from pdeloop.method.adapt import Record
from pdeloop.method.adapt.closed_loop import ClosedLoop
from pdeloop.method.adapt.improve import (
    FRACTIONS,
    ModelBasedSettings,
    choose_fraction,
    left_out_costs,
)
from pdeloop.method.adapt.verdict import (
    ADAPTED,
    FIRST,
    NONE,
    ZERO,
    Estimate,
    Evidence,
    choose,
    evidence_of,
    evidence_of_rollouts,
    mean_of,
)


class Costs:
    """A loop whose costs from field i under the law theta are given by a function."""

    readings = None
    predicted: Any = ClosedLoop.predicted

    def __init__(self, cost: Callable[[float, int], float]) -> None:
        self._cost = cost

    def theta(self, policy: np.ndarray) -> np.ndarray:
        return policy

    def beginnings(self, records: list[Record]) -> np.ndarray:
        return np.stack([record.states[0] for record in records])

    def costs(self, theta: np.ndarray, fields: np.ndarray) -> np.ndarray:
        return np.array([self._cost(float(theta[0, 0]), int(field[0])) for field in fields])


@pytest.mark.parametrize(
    ("cost", "fraction"),
    [
        (lambda x, i: (x - 1.0) ** 2 + i, 1.0),  # all agree on all of it
        (lambda x, i: (x - 0.5) ** 2 + i, 0.5),  # on half of the way
        (lambda x, i: x + i, 0.0),  # on none
        (lambda x, i: 5.0 - x if i == 3 else 5.0 + 0.01 * x, 0.0),  # only one gains: chance
        (lambda x, i: np.inf if x > 0.6 and i == 2 else 5.0 - x, 0.5),  # one is lost
    ],
)
def test_the_way_from_the_first_law_is_what_fields_that_were_left_out_agree_on(
    cost: Callable[[float, int], float], fraction: float
) -> None:
    fields = np.arange(8.0)[:, None]
    loop: Any = Costs(cost)
    costs = left_out_costs(loop, np.zeros((1, 1)), [np.ones((1, 1))] * 2, fields)
    found, change = choose_fraction(costs, ModelBasedSettings().confidence)
    assert found == fraction * FRACTIONS
    differences = np.array([cost(fraction, i) - cost(0.0, i) for i in range(8)])
    assert change.value == pytest.approx(differences.mean()) and change.error >= 0.0


def test_fields_that_cost_more_do_not_hide_a_gain_that_is_the_same_share_of_all() -> None:
    """Of a gain that is a share of each cost, up to noise, all of the chance is in the noise."""
    rng = np.random.default_rng(5)
    before = rng.gamma(0.5, 1.0, 16)
    noise = 1e-3 * rng.standard_normal(16)
    costs = np.stack([before, 0.99 * before, 0.98 * before + noise, 0.9 * before + before**2])
    assert mean_of(costs[2] - before).error > 3.0 * mean_of(noise).error
    chosen, change = choose_fraction(costs, 1.0)
    assert chosen == 2 and change.value == pytest.approx((costs[2] - before).mean())
    assert change.error < 2.0 * mean_of(noise).error


def test_laws_that_are_no_better_are_taken_no_more_often_than_the_confidence_says() -> None:
    """Four fractions that in truth cost as much as the first law: chance alone, of one kind each."""
    rng, wrong = np.random.default_rng(12), 0
    for _ in range(1000):
        size, change = rng.gamma(2.0, 1.0, 17), rng.standard_normal(17)
        costs = np.stack([size * (10.0 + share * change) for share in np.linspace(0.0, 1.0, 5)])
        wrong += choose_fraction(costs, 1.0)[0] > 0
    assert wrong / 1000 < 0.2


def evidence(change: float, deviation: float, *excess: float) -> Evidence:
    return Evidence(Estimate(change, deviation, 20.0), np.array(excess))


@pytest.mark.parametrize(
    ("known", "chosen"),
    [
        ({ADAPTED: evidence(-1.0, 0.1, 0.0, 0.1)}, ADAPTED),
        ({ADAPTED: evidence(-1.0, 1.1, 0.0, 0.1)}, FIRST),  # may be chance
        ({ADAPTED: evidence(-1.0, 0.1, 1.5, 1.4)}, FIRST),  # the model was wrong about it
        ({ADAPTED: evidence(-1.0, 0.1, 0.0, np.inf)}, FIRST),  # it diverged
        ({NONE: evidence(-0.5, 0.1, 0.0)}, NONE),
        ({ADAPTED: evidence(-1.0, 0.1, 0.0), NONE: evidence(-2.0, 0.1, 0.0)}, NONE),
        ({ADAPTED: evidence(-3.0, 0.1, 0.0), NONE: evidence(-2.0, 0.1, 0.0)}, ADAPTED),
        ({NONE: evidence(np.inf, 0.0, 0.0)}, FIRST),
        ({FIRST: evidence(0.0, 0.0, np.inf), ADAPTED: evidence(0.1, 0.0, 0.0)}, ADAPTED),
        ({FIRST: evidence(0.0, 0.0, np.inf), ADAPTED: evidence(-1.0, 0.0, np.inf)}, FIRST),
        ({FIRST: evidence(0.0, 0.0, 0.7, 0.5), ADAPTED: evidence(0.1, 0.01, 0.0)}, ADAPTED),
    ],
)
def test_the_first_law_is_preferred_unless_the_evidence_says_otherwise(
    known: dict[str, Evidence], chosen: str
) -> None:
    verdict = choose({FIRST: evidence(0.0, 0.0, 0.0, 0.0)} | known, FIRST, 1.0)
    assert verdict.chosen == chosen and verdict.reason
    assert np.isfinite([verdict.change, verdict.deviation]).all()


def test_where_the_first_law_diverges_others_are_compared_on_the_same_fields() -> None:
    laws = {name: np.full((1, 1), float(i)) for i, name in enumerate((FIRST, ADAPTED, NONE))}
    costs = {
        FIRST: {0: np.inf, 1: np.inf},
        ADAPTED: {0: 3.0, 1: 2.0, 2: 9.0, 3: 8.0},  # 2 and 3 are dear with any law
        NONE: {0: 5.0, 1: 4.2},
    }
    seen = [
        Record(laws[name], cost, np.ones((1, 1)), np.ones((0, 1)), field_seed=field)
        for name, own in costs.items()
        for field, cost in own.items()
    ]
    loop: Any = Costs(lambda x, i: 1.0)  # no model tells what a law costs that always diverges
    assert evidence_of(loop, laws, FIRST, seen, np.ones((2, 1)), ZERO) is None
    found = evidence_of_rollouts(laws, FIRST, seen)
    assert found[ADAPTED].change.value == pytest.approx(-2.1) and found[NONE].change == ZERO
    assert choose(found, FIRST, 1.0).chosen == ADAPTED


def test_fields_from_which_both_laws_diverge_are_left_out_of_their_difference() -> None:
    laws = {FIRST: np.zeros((1, 1)), ADAPTED: np.ones((1, 1))}
    seen = [
        Record(laws[name], cost, np.ones((1, 1)), np.ones((0, 1)), field_seed=i)
        for name, own in ((FIRST, (np.inf, 3.0, 4.0)), (ADAPTED, (np.inf, 2.0, 2.0)))
        for i, cost in enumerate(own)
    ]
    found = evidence_of_rollouts(laws, FIRST, seen)[ADAPTED]
    assert found.change.value == -1.5 and np.array_equal(found.excess, [np.inf])


def test_the_reason_says_by_how_much() -> None:
    known = {FIRST: evidence(0.0, 0.0, 0.0, 0.0)}
    better = choose(known | {ADAPTED: evidence(-1.0, 0.1, 0.0, 0.0)}, FIRST, 1.0)
    assert better.reason == "the adapted law costs 1 (standard error 0.1) less than the first law"
    chance = choose(known | {ADAPTED: evidence(-1.0, 2.0, 0.0, 0.0)}, FIRST, 1.0)
    assert chance.chosen == FIRST
    # "Adapted" is what the outcome calls the law that is returned, which is not this one.
    told = ": the last law costs 1 (standard error 2) less than the first law"
    assert chance.reason.endswith(told)
