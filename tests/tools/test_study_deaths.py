# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Workers that die: whose fault it is, what is continued, and what a killed driver leaves."""

from __future__ import annotations

import json
import multiprocessing
import os
import signal
import subprocess
import sys
import threading
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pdeloop.study import Study, StudyError, results, run, training
from pdeloop.study.executors import Deaths, local_workers
from pdeloop.study.results import Ended, reading, writing
from pdeloop.study.table import status
from pdeloop.study.training import Place, listening, train_one
from tests.support import study_tasks
from tests.support.interpreter import ROOT
from tests.support.loop_harness import until
from tests.support.small_study import CONTENT, LIMIT, contents, here


def at(rollouts: float) -> list[dict[str, Any]]:
    return [{"phase": "adapt", "rollouts": rollouts, "memory_mb": 900.0}]


def test_three_deaths_at_the_same_place_are_a_trainings_own():
    deaths = Deaths()
    assert (
        not deaths.died("a", at(4)) and not deaths.died("b", at(2)) and not deaths.died("a", at(4))
    )
    reason = deaths.died("a", at(4))
    assert (
        "it kills its workers: 3 died in a row at the same place (adapt after 4 rollouts" in reason
    )
    assert "900 MB" in reason and deaths.total == 4


def test_a_training_that_comes_further_each_time_may_lose_as_many_as_the_limit():
    deaths = Deaths(most=6)
    reasons = [deaths.died("a", at(place)) for place in range(6)]
    assert reasons[:5] == [""] * 5 and "it has lost 6 workers, the most of a training" in reasons[5]


def test_retired_workers_are_nobodys_fault():
    deaths = Deaths()
    assert not any(deaths.died("a", at(4), announced=True) for _ in range(19))


def test_where_workers_die_by_themselves_three_deaths_prove_nothing():
    """Simulated: each attempt ends with a death with probability 0.3, wherever it is."""
    draw = np.random.default_rng(0)
    deaths, given_up = Deaths(most=1000), 0
    for number in range(20):  # before anything is known of the cluster, three are enough
        deaths.died(str(number), at(1))
        deaths.ended(str(number))
    for number in range(20, 2000):
        while draw.random() < 0.3:
            given_up += bool(deaths.died(str(number), at(1)))
        deaths.ended(str(number))
    assert given_up == 0 and deaths.total > 600
    killer = [bool(deaths.died("killer", at(1))) for _ in range(20)]
    assert killer.index(True) + 1 == 12  # 0.3^n < 1e-6


class InterruptedHereError(Exception):
    """As a process that is killed."""


def test_a_training_continues_from_its_checkpoint_to_the_same_bits(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(training, "CHECKPOINT_PERIOD", 0.0)
    values = Study.of(CONTENT).trainings()["small/two-point/0"]
    (tmp_path / "study").write_text("id")
    place = Place(str(tmp_path), "id", "small/two-point/0")
    batches: list[list[float]] = []

    def attempt(most: int) -> dict[str, bytes]:
        batches.append([])

        def hear(row: Mapping[str, Any]) -> None:
            batches[-1].append(row["rollouts"])
            if len(batches[-1]) > most:
                raise InterruptedHereError

        with listening(hear):
            return train_one(values, place)

    with pytest.raises(InterruptedHereError):
        attempt(2)
    with pytest.raises(InterruptedHereError):
        attempt(1)
    assert attempt(1000) == train_one(values)
    assert batches[0][0] < batches[1][0] < batches[2][0]  # each begins after what is kept
    elsewhere = Place(str(tmp_path), "another study's", place.name)
    assert elsewhere.run_folder() is None


@pytest.mark.usefixtures("forked_workers")
def test_a_process_that_is_killed_costs_only_its_training(reference: Path, tmp_path: Path):
    out, killed = tmp_path / "out", []
    before = {*multiprocessing.active_children()}

    def kill_one(done: int, total: int, status: str) -> None:
        if not killed and [*out.rglob("progress.jsonl")]:
            (worker,) = {*multiprocessing.active_children()} - before
            killed.append(worker.pid)
            os.kill(killed[0], signal.SIGKILL)

    assert run(Study.of(CONTENT), out, partial(local_workers, 1), tell=kill_one) == []
    assert killed and contents(out) == contents(reference)
    found = status(out)
    assert found["workers_lost"] == 1 and found["finished"] == 4 and not found["failed"]


@pytest.mark.usefixtures("forked_workers")
@pytest.mark.parametrize("name", ["unsendable", "exiting"])
def test_what_a_training_raises_costs_it_alone_also_in_a_process(tmp_path: Path, name: str):
    """Neither its process, which would have it repeated, nor the driver."""
    study, notes = Study.of({**CONTENT, "variants": {name: {}, "noted": {}}}), tmp_path / "notes"
    notes.mkdir()
    tasks: dict[str, Any] = {
        name: partial(vars(study_tasks)[name], str(notes)),
        "noted": study_tasks.result,
    }
    failures = run(study, tmp_path / "out", partial(local_workers, 1), tasks=tasks)
    assert [failure.training for failure in failures] == [f"small/{name}/{seed}" for seed in (0, 1)]
    reasons = ("UnsendableError: 7 MPa are too much", "SystemExit: no licence")
    assert {failure.reason for failure in failures} <= {*reasons}
    assert study_tasks.runs_in(notes) == [1, 1]
    found = status(tmp_path / "out")
    assert (found["finished"], found["failed"], found["workers_lost"]) == (2, 2, 0)


@pytest.mark.usefixtures("forked_workers")
def test_a_workers_full_disk_ends_the_study_and_fails_no_training(tmp_path: Path):
    study, out = Study.of({**CONTENT, "variants": {"noted": {}, "full": {}}}), tmp_path / "out"
    tasks = {"noted": study_tasks.result, "full": study_tasks.full}
    with pytest.raises(StudyError, match=r"small/full/0 cannot be carried out: .*No space left on"):
        run(study, out, partial(local_workers, 1), tasks=tasks)
    assert (status(out)["finished"], status(out)["failed"]) == (2, 0)
    assert run(study, out, here, tasks=dict.fromkeys(study.variants, study_tasks.result)) == []


def test_a_full_disk_of_the_driver_ends_the_study_which_continues(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    study, out = Study.of({**CONTENT, "seeds": 60, "variants": {"noted": {}}}), tmp_path / "out"
    tasks = {"noted": study_tasks.result}
    with monkeypatch.context() as patch:
        patch.setattr(results, "_TABLES", f"{results._TABLES} PRAGMA max_page_count = 12;")
        with pytest.raises(
            StudyError, match=r"cannot write to .*; free some space there, and cont"
        ):
            run(study, out, here, tasks=tasks)
    assert run(study, out, here, tasks=tasks) == [] and status(out)["finished"] == 60
    (out / results.RESULTS_FILE).write_bytes(b"damaged")
    with pytest.raises(StudyError, match="put back a copy of it, or begin in another folder"):
        status(out)


def test_processes_that_cannot_start_fail_no_training(tmp_path: Path):
    """As where there is not enough memory for what they import."""
    file, out = tmp_path / "study.yaml", tmp_path / "out"
    file.write_text(json.dumps({**CONTENT, "variants": {"two-point": {}}}))
    (tmp_path / "sitecustomize.py").write_text(
        "import os, sys\nif 'spawn_main' in ' '.join(sys.orig_argv):\n    os._exit(7)\n"
    )
    words = [sys.executable, "-m", "pdeloop.cli", "study", str(file), "--out", str(out)]
    done = subprocess.run(
        [*words, "--processes", "1"],
        env={**os.environ, "PYTHONPATH": f"{tmp_path}:{ROOT}"},
        capture_output=True,
        text=True,
        timeout=LIMIT,
    )
    assert done.returncode == 1 and "Traceback" not in done.stderr, done.stderr
    assert "the workers ended 3 times before their trainings (processes end when" in done.stderr
    assert (status(out)["failed"], status(out)["workers_lost"]) == (0, 0)


def test_what_workers_finish_while_there_is_no_driver_is_taken_once(
    reference: Path, tmp_path: Path
):
    out, study, seen = tmp_path / "out", Study.of(CONTENT), []

    def stop_after_one(done: int, total: int, status: str) -> None:
        if done == 1:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run(study, out, here, tell=stop_after_one)
    root, name = out / "unfinished", [*study.trainings()][-1]
    train_one(study.trainings()[name], Place(str(root), (root / "study").read_text(), name))
    run(study, out, here, tell=lambda done, total, status: seen.append(done))
    assert seen[0] >= 2 and contents(out) == contents(reference)
    assert {path.name for path in out.iterdir()} == {"study.json", "results.sqlite", "lock"}


def test_a_status_is_of_one_moment(tmp_path: Path):
    """A driver that has a result meanwhile waits for the reader."""
    study, added = Study.of(CONTENT), threading.Event()
    name, values = next(iter(study.trainings().items()))

    def add() -> None:
        with writing(tmp_path, study) as results:
            added.set()
            results.add([Ended.well(name, values, study_tasks.result(values))])

    with writing(tmp_path, study):
        pass
    with reading(tmp_path) as results:
        driver = threading.Thread(target=add)
        with results.unchanged():
            before = results.names()
            driver.start()
            assert added.wait(LIMIT)
            driver.join(0.3)
            assert driver.is_alive() and results.names() == before == set()
        driver.join(LIMIT)
        assert results.names() == {name}


def test_a_killed_driver_leaves_no_temporary_folder_and_is_continued(
    reference: Path, tmp_path: Path
):
    file, out, temporary = tmp_path / "study.yaml", tmp_path / "out", tmp_path / "temporary"
    file.write_text(json.dumps(CONTENT))
    temporary.mkdir()
    words = [sys.executable, "-m", "pdeloop.cli", "study", str(file), "--out", str(out)]
    environment = {**os.environ, "TMPDIR": str(temporary)}
    driver = subprocess.Popen([*words, "--processes", "1"], env=environment)
    try:
        until(lambda: [*out.rglob("progress.jsonl")], LIMIT, "training that has begun")
    finally:
        driver.kill()
        driver.wait(LIMIT)
    assert not [path for path in temporary.iterdir() if path.name.startswith("pdeloop")]
    assert run(Study.of(CONTENT), out, here) == []
    assert contents(out) == contents(reference)
    assert {path.name for path in out.iterdir()} == {"study.json", "results.sqlite", "lock"}
