# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A model without stabilising gains ends no training: it explores again, or begins from no control."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest

from loop_method.design import lqt
from pdeloop.in_process import LocalPair, train
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
    assert told.endswith("it has no stabilising gains, so that no control is the first law")
    assert "gains" not in Narration(0, 1).lines(rows[2])[0]


def test_a_training_without_any_gains_begins_from_no_control(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    unsolvable(100, monkeypatch)
    *_, last = (row for row in trained(identification_attempts=1) if row["event"] == "evaluated")
    assert last["lqt"] == last["none"]
