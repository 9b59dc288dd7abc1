# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""An exploration in which the plant diverges is paid for, and repeated with weaker inputs."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

import pdeloop
from pdeloop.finished_run import load_run
from pdeloop.in_process import LocalPair, train
from pdeloop.messages.topics import CostColumn, StartColumn
from pdeloop.report import data
from tests.support.small import SMALL, parameters, same_bits, train_here
from tuner_node import training_state
from tuner_node.build import build_training
from tuner_node.narration import Narration
from tuner_node.rollouts import MOST_VOID, no_model
from tuner_node.training import Training

STRONG = {"exploration_variance": 100.0, "divergence_bound": 3.2}
"""Of the seeds 0, 1 and 2 the first and the last diverge; a quarter is not too strong for any."""


def strong(optimizer: str, **options: Any) -> dict[str, Any]:
    budget = {"iterations": 3} if optimizer == "two_point" else {"rollouts": 12}
    return parameters(optimizer=optimizer, **budget, **STRONG, **options)


@pytest.mark.parametrize("optimizer", ["two_point", "model_based"])
def test_only_seeds_whose_plant_diverged_pay_and_get_a_quarter_of_the_variance(optimizer):
    values = strong(optimizer, seeds=3)
    training, pair = build_training(values), LocalPair(values)
    first = training.next_batch()
    each = training.settings.explorations
    rows = training.finish(pair.run(first))
    assert [(row["event"], row["seed"]) for row in rows] == [("diverged", 0), ("diverged", 2)]
    assert all(row["variance"] == 100.0 and row["next_variance"] == 25.0 for row in rows)
    assert training.budget.paid.tolist() == [each, 0, each]
    assert training.history == rows
    again = training.next_batch().rows
    model = again[:, StartColumn.MODEL]
    assert same_bits(again[model == 1], first.rows[model == 1])
    others = np.flatnonzero(model != 1)
    assert (again[others, StartColumn.VARIANCE] == 25.0).all()
    drawn = [StartColumn.SEED, StartColumn.EXCITATION]
    assert not np.isin(again[others][:, drawn], first.rows[:, drawn]).any()
    assert training.finish(pair.run(training.next_batch()))[0]["event"] == "designed"
    assert training.budget.paid.tolist() == [2 * each, each, 2 * each]


def test_the_policies_do_not_depend_on_other_seeds_on_episodes_or_on_interruptions():
    values, states = strong("two_point", seeds=3), []
    whole, pair = build_training(values), LocalPair(values)
    train(
        whole,
        pair,
        lambda row: None,
        after_batch=lambda: states.append(training_state.arrays_of(whole)),
    )
    for seed in (0, 1):
        alone = train_here(strong("two_point", seed=seed))
        assert same_bits(alone.policies()[0], whole.policies()[seed])
    cut = train_here(values, max_batch=1)
    assert same_bits(cut.policies(), whole.policies()) and cut.history == whole.history
    assert training_state.arrays_of(cut).keys() == states[-1].keys()
    again = build_training(values)
    training_state.restore(again, states[0])
    assert again.void == [1, 0, 1]
    train(again, LocalPair(values), lambda row: None)
    assert same_bits(again.policies(), whole.policies()) and again.history == whole.history


def test_a_checkpoint_from_before_there_were_void_explorations_is_refused():
    training = build_training(parameters(iterations=1))
    arrays = training_state.arrays_of(training)
    del arrays["void"]
    with pytest.raises(ValueError, match="it has no array 'void'"):
        training_state.restore(training, arrays)


def explore_until_the_end(training: Training, pair: LocalPair) -> list[float]:
    """The variances of the explorations of a plant that always diverges."""
    variances = []
    while True:
        batch = training.next_batch()
        assert batch.exploratory
        variances.append(float(batch.rows[0, StartColumn.VARIANCE]))
        training.finish(pair.run(batch))


@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_a_plant_that_always_diverges_ends_the_training_with_the_reason(noise):
    values = parameters(iterations=3, divergence_bound=0.1, measurement_noise=noise)
    training = build_training(values)
    with pytest.raises(ValueError, match="no reduced model: the plant diverged under") as ended:
        explore_until_the_end(training, LocalPair(values))
    told = str(ended.value)
    assert f"{MOST_VOID + 1} times, last at step 0" in told
    weakest = training.settings.exploration_variance / 4**MOST_VOID
    assert f"inputs of variance {weakest:.3g}; weaker inputs did not delay it" in told
    assert (
        told.endswith("otherwise lower exploration_variance further") and "a horizon of" not in told
    )
    assert [row["step"] for row in training.history] == [0] * MOST_VOID


@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_inputs_that_delay_the_divergence_are_to_be_weaker_still(noise):
    settings = build_training(parameters(measurement_noise=noise)).settings
    told = no_model(settings, [3, 5], paid_up=False)
    assert "lower exploration_variance" in told and ("measurement_noise" in told) == bool(noise)
    assert "lower exploration_variance" in no_model(settings, [7], paid_up=True)
    assert "finite" not in no_model(settings, [5, 0], paid_up=True)
    assert "see that step returns finite numbers" in no_model(settings, [0, 0], paid_up=True)
    told = no_model(settings, [7, 5, 6], paid_up=False)
    assert "if the plant diverges without control" in told
    assert (
        "set a horizon of 5 steps or fewer" in told
        and "otherwise lower exploration_variance" in told
    )


def test_a_budget_without_room_for_another_exploration_ends_the_training():
    values = parameters(optimizer="model_based", rollouts=8, divergence_bound=0.1)
    training = build_training(values)
    with pytest.raises(ValueError, match="no rollouts are left for another exploration"):
        explore_until_the_end(training, LocalPair(values))
    assert training.budget.paid.tolist() == [4]  # 4 more are left, of 2 and 1 + 3


@pytest.mark.parametrize("seeds", [1, 2])
def test_a_seed_with_a_model_goes_on_with_it_where_the_plant_diverges_later(seeds):
    values = parameters(optimizer="two_point", rollouts=20, seeds=seeds)
    training, pair = build_training(values), LocalPair(values)
    training.finish(pair.run(training.next_batch()))
    pair.follow(training)
    models = training.models.copy()
    check = pair.run(training.next_batch())
    worse = np.flatnonzero(np.arange(len(check.costs)) % 2 == 1)[:1]  # the first law of seed 0
    costs = check.costs.copy()
    costs[worse, CostColumn.MEAN] = 1e6
    training.finish(replace(check, costs=costs))
    assert training.phase == "identify" and training.pending == [0]
    rows = []
    while training.phase == "identify":
        explored = pair.run(training.next_batch())
        costs = explored.costs.copy()
        costs[:, CostColumn.ENDED] = 3.0
        rows += training.finish(replace(explored, costs=costs, models=None))
    assert training.phase == "adapt" and same_bits(training.models, models)
    assert training.worse == [True] + [False] * (seeds - 1)
    assert not training.starts()[0].any() and training.void[0] == len(rows)
    assert "continuing with the previous model" in Narration(0, 1).lines(rows[-1])[0]
    pair.follow(training)
    train(training, pair, lambda row: None)
    assert training.phase == "done" and training.budget.paid.max() <= 20


def test_one_sentence_says_so():
    row = {"event": "diverged", "seed": 4, "step": 58, "variance": 0.1, "next_variance": 0.025}
    assert Narration(4, 1).lines(row) == [
        "  seed 4: the plant diverged under exploration at step 58; exploring again with variance "
        "0.025 instead of 0.1"
    ]


def test_a_report_shows_the_exploration_that_gave_the_model(tmp_path):
    values = strong("two_point")
    pdeloop.train(str(SMALL), out=tmp_path / "run", optimizer="two_point", iterations=3, **STRONG)
    training, pair = build_training(values), LocalPair(values)
    training.finish(pair.run(training.next_batch()))
    explored = pair.roll_out(training.next_batch())
    shown = data.of_run(load_run(tmp_path / "run"))
    assert shown.orders is not None
    singular = np.linalg.svd(explored.states[1:, 0].T, compute_uv=False)
    assert np.allclose(shown.orders.singular_values, singular, atol=1e-9 * singular[0])
    assert [row["event"] for row in shown.history("adapted")] == ["adapted"] * 3
    assert shown.curves[0].rollouts.tolist() == [2, 4, 6]
