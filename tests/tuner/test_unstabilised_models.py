# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A model without stabilising gains ends no training: it explores again, or begins from no control."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from pdeloop.in_process import LocalPair, train
from pdeloop.messages.cost import Cost
from pdeloop.method.design import lqg, lqt
from pdeloop.method.reduce.subspace import InnovationModel
from pdeloop.problem_check import check
from tests.support.small import parameters
from tuner_node.build import build_training
from tuner_node.narration import Narration


def unsolvable(times: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """The first designs have no solution."""
    solve, lost = lqt.track, iter(range(times))

    def track(*given: Any, **weights: Any) -> lqt.Gains:
        if next(lost, None) is not None:
            raise lqt.DesignError("not stabilisable")
        return solve(*given, **weights)

    monkeypatch.setattr(lqt, "track", track)


def trained(**options: Any) -> Iterator[dict[str, Any]]:
    """The events of a training, whose last one has costs."""
    values, rows = parameters(optimizer="two_point", rollouts=16, **options), []
    train(build_training(values), LocalPair(values), lambda row: rows.append(dict(row)))
    return iter(rows)


def test_it_is_checked_as_no_control_and_explored_again(monkeypatch: pytest.MonkeyPatch) -> None:
    unsolvable(1, monkeypatch)
    rows = [row for row in trained() if row["event"] in ("designed", "checked")]
    assert [row.get("stabilised") for row in rows] == [False, None, True, None]
    assert rows[1]["none"] == rows[1]["lqt"] and rows[1]["again"]
    (told,) = Narration(0, 1).lines(rows[0])
    assert told.endswith("surely save anything, so the training begins from no control")
    assert "gains" not in Narration(0, 1).lines(rows[2])[0]


def test_a_training_without_any_gains_begins_from_no_control(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    unsolvable(100, monkeypatch)
    *_, last = (row for row in trained(identification_attempts=1) if row["event"] == "evaluated")
    assert last["lqt"] == last["none"]


@pytest.mark.parametrize("optimizer", ["model_based", "two_point"])
def test_a_check_says_so_and_whether_a_training_can_do_without(
    optimizer: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    unsolvable(100, monkeypatch)
    values = parameters(optimizer=optimizer, identification="regression", rollouts=20)
    found = next(own for own in check(values) if own.name == "first law")
    assert found.good == found.note == (optimizer == "model_based")
    assert "no stabilising gains" in found.text and "begins from no control" in found.text


def test_a_model_of_few_readings_keeps_its_filter(monkeypatch: pytest.MonkeyPatch) -> None:
    def track_outputs(*given: Any) -> lqt.Gains:
        raise lqt.DesignError("not stabilisable")

    monkeypatch.setattr(lqt, "track_outputs", track_outputs)
    rows = trained(identification_attempts=1, sensors=8, law="observer", identification="subspace")
    *_, last = (row for row in rows if row["event"] == "evaluated")
    assert last["lqt"] == last["none"]


def test_an_innovation_model_whose_inputs_do_nothing_has_a_filter_alone() -> None:
    one = np.ones((1, 1))
    model = InnovationModel(1.1 * one, 0 * one, one, 0.5 * one, one, innovations=one, past=1)
    cost = Cost(1, 1, 1, target=1.0)
    with pytest.raises(lqt.DesignError):
        lqg.law_of_innovations(model, np.ones(1), cost)
    rows = lqg.law_of_innovations(model, np.ones(1), cost, or_no_control=True)
    assert not rows.K_a.any() and not rows.K_b.any()
    # The estimate after a measurement has the gain M of A M = G.
    assert np.allclose(rows.L, 0.5 / 1.1)
