# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A training finds measurement noise that nobody declared, accounts for it, and says so."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import pdeloop
from pde_sim_node.build import build_plant
from pdeloop.in_process import LocalPair, train
from tests.support.small import same_bits
from tuner_node.build import build_training
from tuner_node.narration import misjudged_noise, warnings
from tuner_node.results import check_result, seeming_noise, summarise
from tuner_node.training_state import arrays_of, restore

QUICK = {
    **{"n_z": 96, "n_a": 6, "horizon": 20, "reduced_order": 8},
    **{"rollouts": 6, "evaluation_fields": 1},
    **{"field_model_settings.folds": 2},
    **{"exploration_variance": 1.0, "identification": "regression"},
    **{"field_model_settings.largest_degree": 3},
}


def with_noise(sigma: float, **given: Any) -> tuple[dict[str, Any], LocalPair]:
    """The parameters of a training that is not told of noise, and a pair whose plant has it."""
    problem = pdeloop.problem("allen-cahn-modes", **{**QUICK, "measurement_noise": sigma, **given})
    values = {**problem.values, "measurement_noise": 0.0}
    return values, LocalPair(values, build_plant(problem.values))


def test_a_training_accounts_for_noise_that_was_not_declared_and_says_so() -> None:
    """So does one that continues from a checkpoint after the find, to the same bits."""
    sigma = 0.05
    values, pair = with_noise(sigma)
    training, states = build_training(values), []

    def keep() -> None:
        if training.history and training.phase == "adapt":
            states.append({name: array.copy() for name, array in arrays_of(training).items()})

    train(training, pair, lambda row: None, after_batch=keep)
    summary = summarise(training)
    (found,) = summary["noise"]["found"]
    assert summary["noise"]["declared"] == 0.0 and found == pytest.approx(sigma, rel=0.1)
    assert summary["noise"]["seeming"] == [0.0]  # as it was found
    (said,) = (text for text in warnings(summary) if "noise" in text)
    assert f"noise of about {found:.2g} was found" in said and "none was declared" in said
    check_result(summary, 0, 1)
    for wrong in (
        {"declared": 0.0, "found": ["0.05"]},
        {"declared": None, "found": []},
        {"declared": 0.0, "found": [], "seeming": [None]},
        [0.05],
    ):
        with pytest.raises(ValueError, match="noise"):
            check_result({**summary, "noise": wrong}, 0, 1)
    later = build_training(values)
    restore(later, states[0])
    train(later, LocalPair(values, pair.plant), lambda row: None)
    assert later.history == training.history and "noise" in training.history[0]
    assert same_bits(later.policies(), training.policies())
    assert same_bits(later.evaluation, training.evaluation)
    for each in (training, later):
        (made,) = each.optimizers
        assert made.state()["noise"] == found
        with pytest.raises(ValueError, match="noise"):
            made.restore({**made.state(), "noise": np.array(-found)})


def test_without_a_find_the_first_readings_tell_that_they_seem_noisy() -> None:
    sigma = 0.05
    values, pair = with_noise(sigma)
    training = build_training(values)
    batch = training.next_batch()
    assert batch is not None
    training.finish(pair.run(batch))
    seeming = seeming_noise(training, 0)
    assert seeming == pytest.approx(sigma, rel=0.1)
    noise = {"declared": 0.0, "found": [0.0], "seeming": [seeming]}
    (said,) = misjudged_noise({"seeds": 1, "noise": noise})
    assert "seem to have" in said and "none was declared" in said
