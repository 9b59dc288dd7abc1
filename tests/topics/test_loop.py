"""The loop over real topics, in real processes: the same training as in one process, to the bit."""

from __future__ import annotations

import itertools
import json
import os
import resource
import signal
import time
from collections.abc import Iterable
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from loop_interfaces.protocol import NO_CONTROLLER
from loop_interfaces.topics import MAX_GAIN
from tests.loop_harness import Processes, until
from tests.small import SMALL, parameters, same_bits, train_here
from tuner_node.training import Training

pytestmark = pytest.mark.topics
LIMIT = 240.0
"""Seconds after which a small training has failed, however busy the machine; an idle one needs 5."""
NODES = ("pde_sim_node", "controller_node", "tuner_node")


@cache
def in_process(seed: int = 0, iterations: int = 20, seeds: int = 1) -> Training:
    return train_here(parameters(seed=seed, iterations=iterations, seeds=seeds))


def assert_same_training(folder: Path, expected: Training) -> None:
    """The run in `folder` has the policy, the model and the costs of `expected`, bit for bit."""
    with np.load(folder / "policy.npz") as arrays:
        assert same_bits(arrays["model"], expected.models)
        assert same_bits(arrays["policy"], expected.policies())
    result = json.loads((folder / "result.json").read_text())
    costs = np.array([result["costs_by_field"][name] for name in ("none", "lqt", "adapted")])
    assert same_bits(costs.transpose(1, 0, 2).copy(), expected.evaluation)


def tuner_arguments(out: Path, **options: object) -> list[str]:
    budget = {} if "rollouts" in options else {"iterations": 20}
    values = {**budget, "out": out, **options}
    return [word for name, value in values.items() for word in ("-p", f"{name}:={value}")]


@pytest.mark.parametrize("order", list(itertools.permutations(NODES))[::2], ids="-".join)
def test_nodes_started_in_any_order_find_each_other_and_train(loop: Processes, tmp_path, order):
    started = {}
    for name in order:
        own = tuner_arguments(tmp_path / "run") if name == "tuner_node" else []
        started[name] = loop.node(name, "--params-file", str(SMALL), *own)
        time.sleep(0.3)
    loop.wait(started["tuner_node"], LIMIT)
    assert_same_training(tmp_path / "run", in_process())
    for name in ("pde_sim_node", "controller_node"):
        started[name].send_signal(signal.SIGTERM)
        loop.wait(started[name], LIMIT)


def test_python_trains_over_topics_as_in_one_process(loop: Processes, tmp_path):
    program = (
        f"import pdeloop; pdeloop.train({str(SMALL)!r}, iterations=6, seeds=2, seed=3,"
        f"over_topics=True, out={str(tmp_path / 'run')!r})"
    )
    loop.wait(loop.start("-c", program, name="python"), LIMIT)
    assert_same_training(tmp_path / "run", in_process(seed=3, iterations=6, seeds=2))


def test_two_loops_in_two_namespaces_do_not_meet(loop: Processes, tmp_path):
    tuners = []
    for seed, namespace in enumerate(("/left", "/right/inner")):
        where = ("-r", f"__ns:={namespace}", "--params-file", str(SMALL))
        loop.node("pde_sim_node", *where, "-p", "publish_clock:=false")
        loop.node("controller_node", *where)
        out = tuner_arguments(tmp_path / str(seed), seed=seed)
        tuners.append(loop.node("tuner_node", *where, *out))
    for seed, tuner in enumerate(tuners):
        loop.wait(tuner, LIMIT)
        assert_same_training(tmp_path / str(seed), in_process(seed=seed))


def test_one_tuner_is_served_by_several_pairs_with_the_same_result(loop: Processes, tmp_path):
    for pair in ("a", "b"):
        where = ("-r", f"__ns:=/{pair}", "--params-file", str(SMALL))
        loop.node("pde_sim_node", *where, "-p", "publish_clock:=false")
        loop.node("controller_node", *where)
    tuner = loop.node(
        "tuner_node",
        "--params-file",
        str(SMALL),
        *tuner_arguments(tmp_path / "run", seeds=2, max_batch=3, pairs="['a','b']"),
    )
    loop.wait(tuner, LIMIT)
    assert_same_training(tmp_path / "run", in_process(seeds=2))


def iterations_done(folder: Path) -> int:
    path = folder / "progress.jsonl"
    return path.read_text().count('"iteration":') if path.exists() else 0


def adapted(folder: Path) -> int:
    """Batches that the optimisers of the run in `folder` have been told."""
    path = folder / "progress.jsonl"
    return path.read_text().count('"event": "adapted"') if path.exists() else 0


def test_nodes_restarted_between_and_within_episodes_change_nothing(loop: Processes, tmp_path):
    iterations = 150
    running = {
        name: loop.node(name, "--params-file", str(SMALL))
        for name in ("pde_sim_node", "controller_node")
    }
    out = tmp_path / "run"
    tuner = loop.node(
        "tuner_node", "--params-file", str(SMALL), *tuner_arguments(out, iterations=iterations)
    )
    for count, name in ((15, "controller_node"), (45, "pde_sim_node"), (75, "controller_node")):
        until(lambda n=count: iterations_done(out) >= n, LIMIT, f"iteration {count}")
        running[name].send_signal(signal.SIGKILL)
        running[name].wait()
        running[name] = loop.node(name, "--params-file", str(SMALL))
    until(lambda: iterations_done(out) >= 105, LIMIT, "iteration 105")
    tuner.send_signal(signal.SIGKILL)
    tuner.wait()
    tuner = loop.node(
        "tuner_node",
        "--params-file",
        str(SMALL),
        *tuner_arguments(out, iterations=iterations, resume="true"),
    )
    loop.wait(tuner, LIMIT)
    assert_same_training(out, in_process(iterations=iterations))


def processor_seconds(pids: Iterable[int]) -> float:
    """Processor time of these processes and of those that they have waited for, in s (Linux)."""
    total = 0
    for pid in pids:
        fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
        total += sum(map(int, fields[11:15]))
    return total / os.sysconf("SC_CLK_TCK")


def children_seconds() -> float:
    """Processor time of this process's children that have ended, and of theirs, in s."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def test_ctrl_c_ends_everything_and_says_how_to_go_on(loop: Processes, tmp_path):
    out = tmp_path / "run"
    children = children_seconds()
    run = loop.pdeloop("train", str(SMALL), "--iterations", "100000", "--out", str(out))
    until(lambda: iterations_done(out) >= 10, LIMIT, "iteration 10")
    before = processor_seconds(loop.left_behind())
    run.send_signal(signal.SIGINT)
    text = loop.wait(run, LIMIT, code=130)
    # Not by the clock: on an idle machine it takes as long as this, on a busy one longer.
    assert children_seconds() - children - before < 2.0
    until(lambda: loop.left_behind() == [], LIMIT, "end of all nodes")
    assert f"continue with: pdeloop train --resume {out}" in text


def test_gains_beyond_what_the_topics_take_end_the_same_as_in_one_process(loop, tmp_path):
    loop.node("pde_sim_node", "--params-file", str(SMALL))
    loop.node("controller_node", "--params-file", str(SMALL))
    arguments = tuner_arguments(tmp_path / "run", iterations=3, learning_rate=1e13)
    tuner = loop.node("tuner_node", "--params-file", str(SMALL), *arguments)
    loop.wait(tuner, LIMIT, code=NO_CONTROLLER)  # no law with such gains is stable
    training = train_here(parameters(iterations=3, learning_rate=1e13))
    assert np.abs(training.policies()).max() > MAX_GAIN
    assert_same_training(tmp_path / "run", training)


@pytest.mark.parametrize(
    ("node", "parameter", "words"),
    [
        ("pde_sim_node", "n_z:=many", "'n_z' is 'many'; expected an even whole number"),
        (
            "controller_node",
            "reduced_order:=-1",
            "'reduced_order' is -1; expected a whole number from 0",
        ),
        ("tuner_node", "rollouts:=3", "'rollouts' is 3; expected at least 9: 1 for"),
    ],
)
def test_a_node_refuses_a_bad_parameter_in_one_line(loop: Processes, node, parameter, words):
    text = loop.wait(loop.node(node, "-p", parameter), LIMIT, code=1)
    (line,) = text.strip().splitlines()
    assert line.startswith(f"{node}: ")
    assert words in line


def test_a_model_that_cannot_be_designed_stops_the_run_with_the_reason(loop: Processes, tmp_path):
    path = tmp_path / "rank.yaml"
    path.write_text(SMALL.read_text().replace("reduced_order: 4", "reduced_order: 400"))
    run = loop.pdeloop("train", str(path), "--out", str(tmp_path / "run"))
    text = loop.wait(run, LIMIT, code=1)
    assert "no reduced model: a model of n_s = 400 modes" in text.splitlines()[-1]
    assert "Traceback" not in text
