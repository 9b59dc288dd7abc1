# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The loop over real topics, in real processes: the same training as in one process, to the bit."""

from __future__ import annotations

import itertools
import os
import resource
import signal
import time
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pytest

from pdeloop.messages.protocol import NO_CONTROLLER
from pdeloop.messages.topics import MAX_GAIN
from tests.support.loop_harness import Processes, until
from tests.support.small import SMALL, parameters, train_here
from tests.support.small_loop import (
    LIMIT,
    PARAMETERS,
    adapted,
    assert_same_training,
    in_process,
    start_pair,
    start_tuner,
    tuner_arguments,
)

pytestmark = pytest.mark.topics
NODES = ("pde_sim_node", "controller_node", "tuner_node")


@pytest.mark.parametrize("order", list(itertools.permutations(NODES))[::2], ids="-".join)
def test_nodes_started_in_any_order_find_each_other_and_train(loop: Processes, tmp_path, order):
    started = {}
    for name in order:
        own = tuner_arguments(tmp_path / "run") if name == "tuner_node" else []
        started[name] = loop.node(name, *PARAMETERS, *own)
        time.sleep(0.3)
    loop.wait(started["tuner_node"], LIMIT)
    assert_same_training(tmp_path / "run", in_process())
    for name in ("pde_sim_node", "controller_node"):
        started[name].send_signal(signal.SIGTERM)
        loop.wait(started[name], LIMIT)


def test_python_trains_over_topics_as_in_one_process(loop: Processes, tmp_path):
    program = (
        "from pathlib import Path\n"
        "from tests.support.forked_nodes import fork_nodes\n"
        "fork_nodes(Path.cwd())\n"
        f"import pdeloop; pdeloop.train({str(SMALL)!r}, iterations=6, seeds=2, seed=3,"
        f"over_topics=True, out={str(tmp_path / 'run')!r})"
    )
    loop.wait(loop.start("-c", program, name="python"), LIMIT)
    assert_same_training(tmp_path / "run", in_process(seed=3, iterations=6, seeds=2))


def test_two_loops_in_two_namespaces_do_not_meet(loop: Processes, tmp_path):
    tuners = []
    for seed, namespace in enumerate(("/left", "/right/inner")):
        where = ("-r", f"__ns:={namespace}", *PARAMETERS)
        loop.node("pde_sim_node", *where, "-p", "publish_clock:=false")
        loop.node("controller_node", *where)
        tuners.append(start_tuner(loop, tmp_path / str(seed), *where, seed=seed))
    for seed, tuner in enumerate(tuners):
        loop.wait(tuner, LIMIT)
        assert_same_training(tmp_path / str(seed), in_process(seed=seed))


def test_one_tuner_is_served_by_several_pairs_with_the_same_result(loop: Processes, tmp_path):
    for pair in ("a", "b"):
        where = ("-r", f"__ns:=/{pair}", *PARAMETERS)
        loop.node("pde_sim_node", *where, "-p", "publish_clock:=false")
        loop.node("controller_node", *where)
    loop.wait(start_tuner(loop, tmp_path / "run", seeds=2, max_batch=3, pairs="['a','b']"), LIMIT)
    assert_same_training(tmp_path / "run", in_process(seeds=2))


def test_nodes_restarted_between_and_within_episodes_change_nothing(loop: Processes, tmp_path):
    iterations = 90
    running = {name: loop.node(name, *PARAMETERS) for name in ("pde_sim_node", "controller_node")}
    out = tmp_path / "run"
    tuner = start_tuner(loop, out, iterations=iterations)
    for count, name in ((6, "controller_node"), (18, "pde_sim_node"), (30, "controller_node")):
        until(lambda n=count: adapted(out) >= n, LIMIT, f"iteration {count}")
        running[name].send_signal(signal.SIGKILL)
        running[name].wait()
        running[name] = loop.node(name, *PARAMETERS)
    until(lambda: adapted(out) >= 42, LIMIT, "iteration 42")
    tuner.send_signal(signal.SIGKILL)
    tuner.wait()
    loop.wait(start_tuner(loop, out, iterations=iterations, resume="true"), LIMIT)
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
    until(lambda: adapted(out) >= 10, LIMIT, "iteration 10")
    before = processor_seconds(loop.left_behind())
    run.send_signal(signal.SIGINT)
    text = loop.wait(run, LIMIT, code=130)
    # Not by the clock: on an idle machine it takes as long as this, on a busy one longer.
    assert children_seconds() - children - before < 2.0
    until(lambda: loop.left_behind() == [], LIMIT, "end of all nodes")
    assert f"continue with: pdeloop train --resume {out}" in text


def test_gains_beyond_what_the_topics_take_end_the_same_as_in_one_process(loop, tmp_path):
    start_pair(loop)
    tuner = start_tuner(loop, tmp_path / "run", iterations=3, learning_rate=1e13)
    loop.wait(tuner, LIMIT, code=NO_CONTROLLER)  # no law with such gains is stable
    training = train_here(parameters(iterations=3, learning_rate=1e13))
    assert np.abs(training.policies()).max() > MAX_GAIN
    assert_same_training(tmp_path / "run", training)


@pytest.mark.parametrize(
    ("node", "parameter", "words"),
    [
        ("pde_sim_node", "n_z:=many", "'n_z' is 'many'; expected a whole number"),
        (
            "controller_node",
            "reduced_order:=-1",
            "'reduced_order' is -1; expected a whole number from 0",
        ),
        ("tuner_node", "rollouts:=3", "'rollouts' is 3; expected at least 6: 2 for"),
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
    assert "a model of n_s = 32 modes and n_a = 4 inputs needs at least 36" in text.splitlines()[-1]
    assert "Traceback" not in text
