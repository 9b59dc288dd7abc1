"""Pairs, cores and the fitted models: the pure parts of scaling out and of `python -m benchmarks`."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from benchmarks import batch as bench_batch
from benchmarks import train as bench_train
from benchmarks.__main__ import parser as benchmarks_parser
from loop_interfaces import affinity
from loop_interfaces.spec import ParameterError
from pdeloop import pairs
from pdeloop.cli import main
from pdeloop.supervisor import Child


def test_one_pair_has_no_namespace_and_several_share_one_clock() -> None:
    plant, controller = pairs.pair_nodes(1, pin=False)
    assert (plant.name, controller.name) == ("pde_sim_node", "controller_node")
    assert plant.namespace == controller.namespace == ""
    assert plant.ros_arguments(Path("f")) == ["--params-file", "f"]
    assert pairs.tuner_parameter(1) == ["pairs:=['']"]
    nodes = pairs.pair_nodes(3, pin=False)
    assert len({node.name for node in nodes}) == 6
    with_clock = [
        node.name
        for node in nodes
        if node.package == "pde_sim_node" and "publish_clock:=false" not in node.parameters
    ]
    assert with_clock == ["pde_sim_node-pair0"]
    assert pairs.tuner_parameter(3) == ["pairs:=[pair0, pair1, pair2]"]


def test_pinning_gives_every_pair_its_own_core_or_refuses(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: {3, 5, 6, 7})
    nodes = pairs.pair_nodes(2, pin=True)
    pins = [word for node in nodes for word in node.parameters if word.startswith("pin")]
    assert pins == [f"pin:={core}" for core in (3, 3, 5, 5)]
    helpers = [node.name for node in nodes if "solver_cores:='3,5,6,7'" in node.parameters]
    assert helpers == ["pde_sim_node-pair0", "pde_sim_node-pair1"]
    with pytest.raises(ParameterError, match="a core of its own, but there are 4"):
        pairs.pair_nodes(5, pin=True)
    with pytest.raises(ParameterError, match="--pairs is 0; expected a whole number from 1 to 64"):
        pairs.pair_nodes(0, pin=False)
    with pytest.raises(ValueError, match=r"'pin' is 4; expected -1 or one of the cores \[3, 5"):
        affinity.pin_process(4)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--directions", "4", "--optimizer", "two_point"], "--directions goes with"),
        (["--directions", "99"], "'directions' is 99; expected at most 40"),
        (["--in-process", "--pairs", "2"], "leave out --in-process"),
        (["--in-process", "--pin"], "leave out --in-process"),
        (["--in-process", "--spread"], "leave out --in-process"),
        (["--pin", "--spread"], "leave out one of them"),
        (["--pairs", "65"], "--pairs is 65"),
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
    for program in ("rtt", "batch", "train", "realtime", "pairs", "kernel"):
        assert program in said


def test_a_refusal_is_the_sentence_of_the_node_whatever_its_end_says(tmp_path) -> None:
    child = Child("tuner_node", [], tmp_path / "tuner_node.log")
    assert child.refusal() == ""
    child.log.write_text("Exception ignored in: <function f>\nInvalidHandle: it is gone\n")
    assert child.refusal() == "InvalidHandle: it is gone"
    child.log.write_text(f"[INFO] tuner_node: no\ntuner_node: 'a' is 9\n{child.log.read_text()}")
    assert child.refusal() == "tuner_node: 'a' is 9"
