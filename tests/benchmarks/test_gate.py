# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""`python -m benchmarks gate`: costs stand beside those of the same trainings, losses first."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from benchmarks import gate


def row(name: str, seed: int, adapted: float) -> dict[str, object]:
    return {"row": name, "seed": seed, "none": 4.0, "lqt": 2.0, "adapted": adapted}


def test_costs_before_are_of_seeds_that_are_trained() -> None:
    rows = gate.gated()
    before = json.loads(gate.BEFORE.read_text())
    assert len(rows) == 46 + 18 + 2
    for name, costs in before.items():
        assert {int(seed) for seed in costs} >= set(rows[name].seeds)


def test_losses_come_first_with_what_is_above_its_range(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "gate.json"
    monkeypatch.setattr(gate, "BEFORE", path)
    path.write_text(
        json.dumps({"a": {"200": 1.0, "201": 2.0}, "b": {"200": 1.0}, "c": {"200": 1.0}})
    )
    rows = [row("c", 200, 0.5), row("a", 200, 1.5), row("b", 200, 1.1), row("new", 200, 9.0)]
    head, _, *lines = gate.text([*rows, {"row": "c", "seed": 201, "error": "no"}]).splitlines()
    assert head.count("|") == lines[0].count("|")
    assert lines[0].startswith("| a | 4 | 2 | 1 | 1.5 | +50.0 % |")
    assert lines[1].startswith("| b | 4 | 2 | 1 | 1.1 | +10.0 %, above its range |")
    assert lines[-1] == "c, seed 201: no"


def test_a_finished_training_is_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "kdv-200.json").write_text(json.dumps(row("kdv", 200, 1.0)))
    assert gate.train(("kdv", 200), folder=tmp_path)["adapted"] == 1.0
    with pytest.raises(ValueError, match="no row begins with heat; known: burgers"):
        gate.run(("heat",), folder=tmp_path)
