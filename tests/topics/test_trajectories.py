"""Gauss-Newton over topics: its trajectories are the ordinary states and actions, to the bit."""

from __future__ import annotations

import signal

import pytest

from tests.loop_harness import Processes, until
from tests.small import SMALL, parameters, train_here
from tests.topics.test_loop import LIMIT, adapted, assert_same_training, tuner_arguments

pytestmark = pytest.mark.topics
ROLLOUTS = 33


@pytest.mark.parametrize("faults", [False, True], ids=["quiet", "faults"])
def test_gauss_newton_ends_with_the_policy_of_one_process(loop: Processes, tmp_path, faults):
    out = tmp_path / "run"
    start = ("--params-file", str(SMALL))
    lines = ("state", "action") if faults else ()
    running = {
        name: loop.node(name, *start, *remaps)
        for name, remaps in (
            ("pde_sim_node", ("-r", "state:=state_sent") if lines else ()),
            ("controller_node", ("-r", "action:=action_sent") if lines else ()),
        )
    }
    if faults:
        relay = ("--ros-args", "-p", "loss:=0.002", "-p", "delay:=0.002")
        loop.start("-m", "pdeloop.relay.node", *relay, name="relay")
    options = {"rollouts": ROLLOUTS, "optimizer": "gauss_newton", "seeds": 2}
    tuner = loop.node("tuner_node", *start, *tuner_arguments(out, **options, max_attempts=50))
    if faults:
        until(lambda: adapted(out) >= 6, LIMIT, "batch 6")
        running["controller_node"].send_signal(signal.SIGKILL)
        running["controller_node"].wait()
        loop.node("controller_node", *start, "-r", "action:=action_sent")
        until(lambda: adapted(out) >= 12, LIMIT, "batch 12")
        tuner.send_signal(signal.SIGKILL)
        tuner.wait()
        arguments = tuner_arguments(out, **options, max_attempts=50, resume="true")
        tuner = loop.node("tuner_node", *start, *arguments)
    loop.wait(tuner, LIMIT)
    assert_same_training(out, train_here(parameters(**options)))
