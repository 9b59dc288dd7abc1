# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The curves of a run as event files of TensorBoard, read by their own definition."""

from __future__ import annotations

import importlib.util
import struct
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from pdeloop.cli import FAILED, main
from pdeloop.finished_run import load_run
from tests.support.small import SMALL

INSTALLED = importlib.util.find_spec("tensorboardX") is not None
needs_it = pytest.mark.skipif(
    not INSTALLED, reason="tensorboardX is not installed: extra tensorboard"
)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("events") / "run"
    words = ["--in-process", "--iterations", "3", "--seeds", "2", "--seed", "5"]
    assert main(["train", str(SMALL), *words, "--out", str(folder)]) == 0
    return folder


def records(path: Path) -> Iterator[bytes]:
    """The records of a TFRecord file: length (8 bytes), its checksum (4), content, its checksum (4)."""
    content = path.read_bytes()
    while content:
        (length,) = struct.unpack("<Q", content[:8])
        yield content[12 : 12 + length]
        content = content[16 + length :]


def read(folder: Path) -> dict[str, list[tuple[int, float]]]:
    """(step, value) of each scalar in the one event file of a folder."""
    from tensorboardX.proto.event_pb2 import Event

    (file,) = folder.iterdir()
    found: dict[str, list[tuple[int, float]]] = {}
    for record in records(file):
        event = Event.FromString(record)
        for value in event.summary.value:
            found.setdefault(value.tag, []).append((event.step, value.simple_value))
    return found


@needs_it
def test_the_events_are_the_history_and_the_closing_evaluation(run: Path, tmp_path: Path) -> None:
    out = tmp_path / "events"
    assert main(["export", str(run), "--tensorboard", str(out)]) == 0
    known = load_run(run)
    assert sorted(path.name for path in out.iterdir()) == ["seed5", "seed6"]
    for m, seed in enumerate(known.seeds):
        found = read(out / f"seed{seed}")
        steps = [
            row
            for row in known.result["history"]
            if row["event"] == "adapted" and row["seed"] == seed and row.get("cost") is not None
        ]
        assert len(steps) == 3
        assert [step for step, _ in found["adapt/cost"]] == [row["rollouts"] for row in steps]
        costs = [value for _, value in found["adapt/cost"]]
        assert costs == pytest.approx([row["cost"] for row in steps], rel=1e-6)
        for name, closing in known.costs.items():
            ((_, value),) = found[f"evaluate/{name}"]
            assert value == pytest.approx(closing[m].mean(), rel=1e-6)


@needs_it
def test_a_folder_that_is_there_is_not_written_into(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "events").mkdir()
    for where, told in (
        ("events", "exists; expected a new folder"),
        ("none/events", "cannot write"),
    ):
        assert main(["export", str(run), "--tensorboard", str(tmp_path / where)]) == FAILED
        assert told in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["events"]


def test_without_the_extra_it_is_named(
    run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.delitem(sys.modules, "pdeloop.tensorboard", raising=False)
    monkeypatch.setitem(sys.modules, "tensorboardX", None)
    assert main(["export", str(run), "--tensorboard", str(tmp_path / "events")]) == FAILED
    assert "pip install 'pdeloop[tensorboard]'" in capsys.readouterr().err
