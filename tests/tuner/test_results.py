# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""What a result says of a training: the gain of the adaptation, and rollouts that were left over."""

from __future__ import annotations

import numpy as np

from pdeloop.in_process import LocalPair, train
from tests.support.small import parameters
from tuner_node.build import build_training
from tuner_node.results import difference, summarise
from tuner_node.rollouts import EVALUATED


def test_a_rollout_that_diverged_is_compared_with_nothing() -> None:
    """Its cost is a penalty, and so would the difference and its interval be."""
    values = parameters(rollouts=8, optimizer="two_point")
    training = build_training(values)
    train(training, LocalPair(values), lambda row: None)
    assert training.ended is not None and training.evaluation is not None
    pairs = {"against_lqt": ("lqt", "adapted"), "lqt_against_none": ("none", "lqt")}
    own = summarise(training)["outcome"][0]
    none, lqt = (training.evaluation[0, EVALUATED.index(name)] for name in ("none", "lqt"))
    assert own["lqt_against_none"] == difference(none, lqt) and own["against_lqt"] is not None
    for i, name in enumerate(EVALUATED):
        before = training.ended[0, i, 0]
        training.ended[0, i, 0] = 7  # the step at which it did
        own = summarise(training)["outcome"][0]
        assert {of: own[of] is None for of in pairs} == {of: name in pairs[of] for of in pairs}
        training.ended[0, i, 0] = before


def test_every_optimiser_that_leaves_rollouts_over_says_so_in_the_results() -> None:
    """One explores and two check: the paper's method steps with pairs of the five that are left."""
    values = parameters(rollouts=8, optimizer="two_point")
    training = build_training(values)
    train(training, LocalPair(values), lambda row: None)
    (own,) = summarise(training)["outcome"]
    total, spent = training.budget.total[0], training.budget.paid[0]
    assert spent == total - 1
    assert own["early"] == (
        f"1 of {total} rollouts was not used: the optimiser asked for no more, as its step takes 2"
    )


def test_the_interval_of_a_difference_has_the_mean_as_often_as_it_says() -> None:
    rng, inside = np.random.default_rng(5), 0
    for _ in range(1000):
        before = rng.standard_normal(10)  # common to both laws, so that it does not count
        found = difference(before, before - 0.3 + 0.1 * rng.standard_normal(10))
        assert found is not None
        inside += found["low"] <= -0.3 <= found["high"]
    assert 0.95 - 3 * 0.007 < inside / 1000 < 0.95 + 3 * 0.007
    assert difference([1.0], [2.0]) is None
