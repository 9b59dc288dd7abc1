# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Optimisers that want trajectories, over topics; a stranger on the topic of their actions."""

from __future__ import annotations

import pytest

from pdeloop.finished_run import load_run
from tests.support.loop_harness import Processes, until
from tests.support.operator_harness import operator
from tests.support.small import FEW_FITS, parameters, train_here
from tests.support.small_loop import LIMIT, assert_same_training, start_pair, start_tuner
from tuner_node.run_folder import RunFolderError

pytestmark = pytest.mark.topics
ROLLOUTS = 15


def test_actions_of_a_wrong_shape_with_the_right_ids_change_nothing(loop: Processes, tmp_path):
    """Somebody who listens to the loop answers each state before, at and after its step."""
    out = tmp_path / "run"
    plant = start_pair(loop, real_time_factor=1.0)["plant"]  # until the stranger had its say
    stranger = loop.start("-c", WRONG_SHAPES, name="stranger")
    until(lambda: "listening" in loop.output(stranger), LIMIT, "the stranger")
    options = {"rollouts": ROLLOUTS, "optimizer": "model_based", "seeds": 2, **FEW_FITS}
    with operator(loop) as desk:
        tuner = start_tuner(loop, out, **options, max_attempts=50)
        until(lambda: "expected an action of shape" in loop.output(plant), LIMIT, "refusal")
        until(lambda: int(loop.output(stranger).split()[-1]) > 100, LIMIT, "actions")
        assert tuner.poll() is None
        assert desk.ask(set=["/pde_sim_node", "real_time_factor", 0.0])[0]
        loop.wait(tuner, LIMIT)
    assert_same_training(out, train_here(parameters(**options)))
    stranger.kill()


@pytest.mark.parametrize("max_batch", [1, 2])
def test_a_law_from_two_explorations_and_fresh_fields_is_that_of_one_process(
    loop: Processes, tmp_path, max_batch
):
    out = tmp_path / "run"
    start_pair(loop)
    options = {"rollouts": 10, "optimizer": "model_based", **FEW_FITS}
    loop.wait(start_tuner(loop, out, **options, max_batch=max_batch), LIMIT)
    assert_same_training(out, train_here(parameters(**options), max_batch=max_batch))


def test_an_exploration_that_diverges_is_repeated_as_in_one_process(loop: Processes, tmp_path):
    """One of two seeds diverges, in an episode of its own; here and there it is as strong."""
    options = {"iterations": 2, "optimizer": "two_point", "seeds": 2, "exploration_variance": 100.0}
    out = tmp_path / "run"
    start_pair(loop, divergence_bound=3.2)
    loop.wait(start_tuner(loop, out, **options, max_batch=1, divergence_bound=3.2), LIMIT)
    there = train_here(parameters(**options, divergence_bound=3.2))
    assert [row["seed"] for row in there.history if row["event"] == "diverged"] == [0]
    assert_same_training(out, there)


def test_a_training_without_a_model_leaves_the_reason_in_its_folder(loop: Processes, tmp_path):
    out = tmp_path / "run"
    start_pair(loop, divergence_bound=0.1)
    tuner = start_tuner(loop, out, optimizer="two_point", iterations=1, divergence_bound=0.1)
    assert "no reduced model: the plant diverged" in loop.wait(tuner, LIMIT, code=1)
    with pytest.raises(RunFolderError, match=r"would fail again .*the plant diverged"):
        load_run(out)


WRONG_SHAPES = """
from dataclasses import replace
import time
import numpy as np, rclpy
from std_msgs.msg import Float64MultiArray
from pdeloop.messages.frames import ArrayCodec
from pdeloop.ros.endpoints import reader_qos, writer_qos
from pdeloop.messages.topics import ACTION, STATE
rclpy.init()
node = rclpy.create_node("stranger")
publisher = node.create_publisher(Float64MultiArray, "action", writer_qos(ACTION))
states, actions = ArrayCodec(STATE.labels), ArrayCodec(ACTION.labels)
count = 0
def answer(message):
    global count
    state = states.decode(message)
    rows = len(state.values)
    for step in (state.step - 1, state.step, state.step + 1):
        for shape in ((rows, 3), (rows + 1, 4), (rows, 5), (0, 4)):
            wrong = replace(state, step=max(step, 0), values=np.full(shape, 0.5))
            publisher.publish(actions.encode(wrong))
            count += 1
    print(count, flush=True)
qos = reader_qos(STATE)
subscription = node.create_subscription(Float64MultiArray, "state", answer, qos, raw=True)
while not (publisher.get_subscription_count() and subscription.get_publisher_count()):
    time.sleep(0.01)
print("listening", flush=True)
rclpy.spin(node)
"""
