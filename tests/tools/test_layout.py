# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Pairs, cores and the fitted models: the pure parts of scaling out and of `python -m benchmarks`."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

import numpy as np
import pytest

from benchmarks import batch as bench_batch
from benchmarks import train as bench_train
from benchmarks.__main__ import parser as benchmarks_parser
from pdeloop import pairs
from pdeloop.cli import main
from pdeloop.messages.spec import ParameterError
from pdeloop.process import affinity
from pdeloop.supervisor import Child, keep_on
from pdeloop.training_run import resolve
from tests.support.small import SMALL
from tuner_node.run_folder import RunFolder


def test_one_pair_has_no_namespace_and_several_share_one_clock() -> None:
    plant, controller = pairs.pair_nodes([None])
    assert (plant.name, controller.name) == ("pde_sim_node", "controller_node")
    assert plant.namespace == controller.namespace == ""
    assert plant.ros_arguments(Path("f")) == ["--params-file", "f"]
    assert pairs.ros_value(pairs.namespaces(1)) == "['']"
    nodes = pairs.pair_nodes([None] * 3)
    assert len({node.name for node in nodes}) == 6
    with_clock = [
        node.name
        for node in nodes
        if node.package == "pde_sim_node" and "publish_clock:=false" not in node.assignments
    ]
    assert with_clock == ["pde_sim_node-pair0"]
    assert pairs.ros_value(pairs.namespaces(3)) == "['pair0', 'pair1', 'pair2']"


def test_pairs_get_the_least_busy_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: {3, 5, 6, 7})
    busy = iter([{}, {3: 10, 5: 4, 6: 0, 7: 9}])
    monkeypatch.setattr(affinity, "_busy_ticks", lambda: next(busy))
    cores = pairs.pair_cores(3)
    assert cores == [6, 5, 7]
    nodes = pairs.pair_nodes(cores)
    assert [node.parameters["pin"] for node in nodes] == [6, 6, 5, 5, 7, 7]
    with pytest.raises(ParameterError, match="'pairs' is 0; expected a whole number from 1 to 64"):
        pairs.Transport(pairs=0)
    with pytest.raises(ValueError, match=r"'pin' is 4; expected -1 or one of the cores \[3, 5"):
        affinity.pin_process(4)


def test_pairs_are_anywhere_where_there_is_one_core(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: {3})
    assert pairs.pair_cores(2) == [None, None]


def test_the_busy_time_of_a_core_is_what_it_neither_idled_nor_waited(tmp_path: Path) -> None:
    stat = tmp_path / "stat"
    stat.write_text("cpu 9 9 9 9 9 9 9 9 0 0\ncpu0 1 2 4 800 16 32 64 128 256 512\nintr 5\n")
    assert affinity._busy_ticks(stat) == {0: 1 + 2 + 4 + 32 + 64 + 128}
    assert affinity._busy_ticks(tmp_path / "none") == {}


@pytest.mark.parametrize(("asked", "then"), [("start", "none"), ("required", "required")])
def test_a_tuner_started_again_after_its_recorder_ended_waits_only_if_it_requires_one(
    asked: str, then: str, tmp_path: Path
) -> None:
    folder = tmp_path / "run"
    RunFolder(folder).create(resolve(str(SMALL), {}))
    tuner = pairs.Transport(recorder=asked).nodes(folder)[-1]
    assert tuner.parameters["recorder"] == asked
    assert f"recorder:='{then}'" in tuner.without_recorder().assignments


@pytest.mark.skipif(len(os.sched_getaffinity(0)) < 2, reason="needs two cores")
def test_recorder_and_viewer_leave_the_core_of_the_pair_to_it(tmp_path: Path) -> None:
    folder, values = tmp_path / "run", resolve(str(SMALL), {})
    RunFolder(folder).create(values)
    started = pairs.Transport(recorder="start", view=True).nodes(folder)
    nodes = {node.package: node for node in started}
    others = os.sched_getaffinity(0) - {nodes["controller_node"].parameters["pin"]}
    assert set(nodes["recorder_node"].cores) == set(nodes["viewer_node"].cores) == others
    assert nodes["tuner_node"].cores == ()
    process = subprocess.Popen(["sleep", "60"])
    try:
        keep_on(process.pid, sorted(others))
        assert os.sched_getaffinity(process.pid) == others
    finally:
        process.kill()
        process.wait()
    keep_on(process.pid, sorted(others))  # one that has ended is nothing to move


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--sensor-delays", "3"], "--sensor-delays needs --sensors N"),
        (["--in-process", "--pairs", "2"], "leave out --in-process"),
        (["--in-process", "--view"], "leave out --in-process"),
        (["--pairs", "65"], "'pairs' is 65"),
    ],
)
def test_flags_that_do_not_fit_together_are_refused(words, said, capsys, tmp_path) -> None:
    assert main(["train", "burgers", "--out", str(tmp_path / "run"), *words]) == 1
    assert said in capsys.readouterr().err


def test_the_fitted_batch_model_is_the_one_that_made_the_rows() -> None:
    batches = np.array([1, 2, 8, 64, 512])
    rows = [
        {
            "batch": int(m),
            "overhead_us": 180 + 3.0 * m,
            "solver_us": 4.0 * m,
            "round_us": 180 + 7.0 * m,
        }
        for m in batches
    ]
    model = bench_batch.fit(rows)
    assert model["message_us"] == pytest.approx(180)
    assert model["environment_us"] == pytest.approx(3)
    assert model["solver_us"] == pytest.approx(4)
    assert model["knee"] == pytest.approx(180 / 7)


def test_the_memory_of_children_that_are_no_nodes_is_not_counted() -> None:
    assert bench_train._memory(os.getpid()) == {}


def test_bench_lists_its_programs(capsys) -> None:
    with pytest.raises(SystemExit) as left:
        benchmarks_parser().parse_args(["--help"])
    assert left.value.code == 0
    said = capsys.readouterr().out
    for program in ("rtt", "batch", "train", "realtime", "general", "kernel"):
        assert program in said


def test_bench_explains_the_options_of_a_program(capsys) -> None:
    with pytest.raises(SystemExit) as left:
        benchmarks_parser().parse_args(["optimum", "--help"])
    assert left.value.code == 0
    said = capsys.readouterr().out
    assert "--seeds SEEDS" in said and "Number of trainings whose basis U is used. [6]" in said
    assert "-----" not in said


def test_a_refusal_is_the_sentence_of_the_node_whatever_its_end_says(tmp_path) -> None:
    child = Child("tuner_node", list, tmp_path / "tuner_node.log")
    assert child.refusal() == ""
    child.log.write_text("Exception ignored in: <function f>\nInvalidHandle: it is gone\n")
    assert child.refusal() == "InvalidHandle: it is gone"
    child.log.write_text(f"[INFO] tuner_node: no\ntuner_node: 'a' is 9\n{child.log.read_text()}")
    assert child.refusal() == "tuner_node: 'a' is 9"
