# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""`python -m benchmarks choices`: choices drawn from a table of costs follow the product's rules."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks import choices
from benchmarks.choices import Table, interval, judge
from pdeloop.messages.arrays import Array
from pdeloop.method.adapt.verdict import ADAPTED, FIRST

COUNT, FRACTIONS = 60, 5


def table(gain: Array, error: float = 0.0) -> Table:
    """The improved law costs `gain` (N,) less than the first, and `error` more than on the model."""
    rng = np.random.default_rng(1)
    size = rng.gamma(2.0, 1.0, COUNT) + 1.0
    share = np.linspace(0.0, 1.0, FRACTIONS)[:, None]
    ways = size - share * gain
    model = np.vstack([3.0 * size, size, ways])
    true = model + error * np.vstack([np.zeros((2, 1)), share > 0.0])
    return Table(true, model, np.stack([ways, ways]), true[-1], FIRST, ADAPTED, 16, 3, 4)


def test_a_law_that_is_better_everywhere_is_always_said_to_help() -> None:
    found = judge(table(np.full(COUNT, 0.2)), 50, 0)
    assert found["helped"] == 1.0 and found["wrong"] == found["missed"] == 0.0
    assert found["change"] == pytest.approx(found["possible"]) and found["possible"] < -0.05


def test_a_law_of_the_same_cost_helps_by_chance_alone_and_rarely() -> None:
    gain = np.random.default_rng(2).standard_normal(COUNT)
    gain -= gain.mean() + 1e-6  # in truth a little worse
    found = judge(table(gain), 400, 0)
    assert 0.0 < found["wrong"] == found["helped"] < 0.3


def test_rollouts_of_the_law_find_out_what_the_model_gets_wrong() -> None:
    found = judge(table(np.full(COUNT, 0.2), error=0.5), 50, 0)
    assert found["helped"] == 0.0 and found["change"] == 0.0
    assert found["wrong"] == found["missed"] == 0.0


def test_the_interval_of_no_errors_is_that_of_as_many_trainings() -> None:
    """Wilson's upper end for 0 of n is z^2 / (n + z^2)."""
    assert interval([0.0] * 24) == pytest.approx((0.0, 1.96**2 / (24 + 1.96**2)))
    low, high = interval([0.5] * 10)
    assert low + high == pytest.approx(1.0)


def test_tables_are_kept_and_trainings_without_a_model_are_named(tmp_path: Path) -> None:
    options: dict[str, Any] = {"rollouts": 20, "fields": 4, "evaluation": 1, "folder": tmp_path}
    made: list[tuple[object, ...]] = []

    def nothing(*task: object, **_: object) -> None:
        made.append(task)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(choices, "table_of", nothing)
        assert choices.measured(("kdv", 1), **options) is None
        assert choices.measured(("kdv", 1), **options) is None
    assert made == [("kdv", 1)]
    own = table(np.full(COUNT, 0.2))
    (path,) = tmp_path.iterdir()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(choices, "table_of", lambda *_, **__: own)
        path.unlink()
        choices.measured(("kdv", 1), **options)
    again = Table.of(json.loads(path.read_text()))
    assert judge(again, 20, 3) == judge(own, 20, 3)
    rows = [{"case": "kdv", "seed": 1, **judge(own, 20, 3)}]
    rows.append({"case": "wave", "seed": 2, "error": choices.NO_MODEL})
    shown = choices.text({"rows": rows})
    assert "| kdv | 1 | 100 % | 0.0 % (0 to 79)" in shown and "wave, seed 2" in shown


def test_an_unknown_case_is_refused() -> None:
    with pytest.raises(ValueError, match="no case 'heat'"):
        choices.run(["heat"])
