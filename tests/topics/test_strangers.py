# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Other plants, controllers and publishers in the namespace are refused by name, and change nothing."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path

import numpy as np
import pytest

from pde_sim_node.build import fingerprint
from tests.support.loop_harness import until
from tests.support.operator_harness import SLOW, full_speed, held_training, operator
from tests.support.small import parameters
from tests.support.small_loop import (
    LIMIT,
    PARAMETERS,
    adapted,
    assert_same_training,
    in_process,
    start_pair,
    start_tuner,
)

pytestmark = pytest.mark.topics


def test_a_second_plant_with_other_parameters_never_mixes_in(loop, tmp_path):
    start_pair(loop, real_time_factor=SLOW)
    out = tmp_path / "run"
    with operator(loop) as desk:
        tuner = start_tuner(loop, out, iterations=40)
        until(lambda: adapted(out) >= 1, LIMIT, "iteration 1")
        desk.call("/tuner_node/pause")
        other = ("-r", "__node:=other_plant", "-p", "physical.viscosity:=0.02")
        loop.node("pde_sim_node", *PARAMETERS, *other)
        until(lambda: "/other_plant" in desk.ask(nodes=None), LIMIT, "other plant")
        desk.call("/tuner_node/resume")
        until(lambda: "plant with other parameters" in loop.output(tuner), LIMIT, "refusal")
        full_speed(desk)
    loop.wait(tuner, LIMIT)
    assert_same_training(out, in_process(iterations=40))


def test_of_two_plants_there_from_the_start_the_one_that_was_asked_for_is_trained(loop, tmp_path):
    values = parameters(iterations=40)
    other = ("-r", "__node:=other_plant", "-p", "physical.viscosity:=0.02")
    loop.node("pde_sim_node", *PARAMETERS, *other)  # it ends every episode first
    start_pair(loop, real_time_factor=SLOW)
    out = tmp_path / "run"
    with operator(loop) as desk:
        plants = {"/pde_sim_node", "/other_plant"}
        until(lambda: plants <= set(desk.ask(nodes=None)), LIMIT, "two plants")
        tuner = start_tuner(loop, out, iterations=40, plant=fingerprint(values))
        until(lambda: "plant with other parameters" in loop.output(tuner), LIMIT, "refusal")
        full_speed(desk)
    loop.wait(tuner, LIMIT)
    assert_same_training(out, in_process(iterations=40))


def test_a_second_plant_with_the_same_parameters_is_harmless(loop, tmp_path):
    start_pair(loop, real_time_factor=SLOW)
    out = tmp_path / "run"
    with operator(loop) as desk:
        tuner = start_tuner(loop, out, iterations=40)
        until(lambda: adapted(out) >= 1, LIMIT, "iteration 1")
        with held_training(desk, "/pde_sim_node"):
            loop.node("pde_sim_node", *PARAMETERS)
    loop.wait(tuner, LIMIT)
    assert_same_training(out, in_process(iterations=40))


def garbage(rng: np.random.Generator, good: bytes) -> bytes:
    kind = rng.integers(4)
    if kind == 0:
        return rng.bytes(int(rng.integers(1, 400)))
    mutated = bytearray(good)
    if kind == 1:  # a huge layout
        mutated[20:24] = b"\xff\xff\xff\x7f"
    elif kind == 2:
        for position in rng.integers(0, len(mutated), size=8):
            mutated[position] = int(rng.integers(256))
    else:
        mutated = mutated[: int(rng.integers(4, len(mutated)))]
    return bytes(mutated)


FLOOD = """
import sys, time
import numpy as np, rclpy
from std_msgs.msg import Float64MultiArray
from pdeloop.messages.frames import ArrayCodec, Frame
from pdeloop.ros.endpoints import writer_qos
from pdeloop.messages.topics import ARRAYS
from tests.topics.test_strangers import garbage
rclpy.init()
node = rclpy.create_node("flood")
rng = np.random.default_rng(0)
lines = []
for topic in ARRAYS:
    shape = (2, 4, 8)[: len(topic.labels)]
    good = ArrayCodec(topic.labels).encode(Frame(1, 2, 3, 0.5, np.ones(shape)))
    lines.append((node.create_publisher(Float64MultiArray, topic.name, writer_qos(topic)), good))
sent, end = 0, time.monotonic() + 3.0
while time.monotonic() < end:
    for publisher, good in lines:
        publisher.publish(garbage(rng, good) if rng.random() < 0.9 else good)
        sent += 1
    time.sleep(0.001)
print(sent, flush=True)
"""


def test_a_strange_publisher_is_reported_by_name_and_changes_nothing(loop, tmp_path):
    running = start_pair(loop, real_time_factor=SLOW)
    out = tmp_path / "run"
    with operator(loop) as desk:
        tuner = start_tuner(loop, out, iterations=40)
        until(lambda: adapted(out) >= 1, LIMIT, "iteration 1")
        with held_training(desk, "/stranger"):
            stranger = loop.start("-c", STRANGER, name="stranger")
            # Strangers are looked for from time to time, whether the training is paused or not.
            for node in (*running.values(), tuner):
                until(
                    lambda node=node: "/stranger" in loop.output(node),
                    LIMIT,
                    "report of the stranger",
                )
    loop.wait(tuner, LIMIT)
    assert_same_training(out, in_process(iterations=40))
    assert "several nodes publish /action: /controller_node, /stranger" in loop.output(
        running["plant"]
    )
    assert "/stranger publishes /policy, but its messages cannot arrive" in loop.output(
        running["controller"]
    )
    told = json.loads((out / "result.json").read_text())["several_publishers"]
    assert told == {
        "/action": ["/controller_node", "/stranger"],
        "/policy": ["/stranger", "/tuner_node"],
        "/samples": ["/pde_sim_node", "/stranger"],
    }
    stranger.kill()


STRANGER = """
import time
import numpy as np, rclpy
from std_msgs.msg import Float64MultiArray, UInt8MultiArray
from pdeloop.messages.frames import ArrayCodec, Frame
from pdeloop.ros.endpoints import samples_qos, writer_qos
from pdeloop.messages.topics import ACTION
from rclpy.qos import QoSProfile
rclpy.init()
node = rclpy.create_node("stranger")
volatile = node.create_publisher(Float64MultiArray, "policy", QoSProfile(depth=1))
samples = node.create_publisher(UInt8MultiArray, "samples", samples_qos(1))
publisher = node.create_publisher(Float64MultiArray, "action", writer_qos(ACTION))
codec = ArrayCodec(ACTION.labels)
k = 0
while True:
    k += 1
    said = codec.encode(Frame(1, 2 + k % 50, k % 31, 0.5, np.full((2, 4), 1e3)))
    publisher.publish(said)
    volatile.publish(said)
    time.sleep(0.001)
"""


def test_a_second_controller_that_answers_otherwise_never_mixes_in(loop, tmp_path):
    """It listens to the loop and so has all the right ids; what it does not have is the signature.

    A step takes 5 ms, so that its answers, of ordinary speed, come while their episode lasts.
    """
    running = start_pair(loop, real_time_factor=10.0)
    out = tmp_path / "run"
    with operator(loop) as desk:
        tuner = start_tuner(loop, out, iterations=40)
        until(lambda: adapted(out) >= 1, LIMIT, "iteration 1")
        desk.call("/tuner_node/pause")
        second = loop.start("-c", SECOND_CONTROLLER, name="second")
        until(lambda: "/second_controller" in desk.ask(nodes=None), LIMIT, "second controller")
        desk.call("/tuner_node/resume")
        refused = "was not computed from the policy, model and target of its episode"
        until(lambda: refused in loop.output(running["plant"]), LIMIT, "refusal")
        full_speed(desk)
    loop.wait(tuner, LIMIT)
    second.kill()
    assert_same_training(out, in_process(iterations=40))


SECOND_CONTROLLER = """
from dataclasses import replace
import numpy as np, rclpy
from std_msgs.msg import Float64MultiArray
from pdeloop.messages.frames import ArrayCodec
from pdeloop.ros.endpoints import reader_qos, writer_qos
from pdeloop.messages.topics import ACTION, STATE
rclpy.init()
node = rclpy.create_node("second_controller")
publisher = node.create_publisher(Float64MultiArray, "action", writer_qos(ACTION))
states, actions = ArrayCodec(STATE.labels), ArrayCodec(ACTION.labels)
def answer(message):
    state = states.decode(message)
    publisher.publish(actions.encode(replace(state, values=np.full((len(state.values), 4), 0.5))))
node.create_subscription(Float64MultiArray, "state", answer, reader_qos(STATE), raw=True)
rclpy.spin(node)
"""


def test_an_error_for_which_a_stranger_may_be_the_reason_names_the_stranger(loop, tmp_path):
    start_pair(loop)
    with operator(loop) as desk:
        loop.start("-c", SECOND_PLANT, name="second")
        until(lambda: "/second_plant" in desk.ask(nodes=None), LIMIT, "second plant")
        out, options = tmp_path / "run", {"iterations": 100_000}
        (line,) = loop.wait(start_tuner(loop, out, **options), LIMIT, code=1).splitlines()[-1:]
        # What it has used is in its checkpoint.
        again = loop.wait(start_tuner(loop, out, **options, resume=True), LIMIT, code=1)
    assert (
        "cannot be continued, because it used results that were contradicted later (two different"
        in again
    )
    assert not (out / "result.json").exists()
    assert "expected one plant and one controller in this namespace" in line
    assert (
        "; several nodes published /episode/cost: /pde_sim_node, /second_plant; expected one"
        in line
    )


SECOND_PLANT = """
from dataclasses import replace
import rclpy
from std_msgs.msg import Float64MultiArray
from pdeloop.messages.frames import ArrayCodec
from pdeloop.ros.endpoints import reader_qos, writer_qos
from pdeloop.messages.topics import COST
rclpy.init()
node = rclpy.create_node("second_plant")
publisher = node.create_publisher(Float64MultiArray, "episode/cost", writer_qos(COST))
costs, known = ArrayCodec(COST.labels), set()
def cost_otherwise(message):
    cost = costs.decode(message)
    if (cost.run, cost.episode) not in known:
        known.add((cost.run, cost.episode))
        publisher.publish(costs.encode(replace(cost, values=cost.values * [2.0, 2.0, 1.0])))
node.create_subscription(Float64MultiArray, "episode/cost", cost_otherwise, reader_qos(COST), raw=True)
rclpy.spin(node)
"""


def resident(process: subprocess.Popen[bytes]) -> int:
    """Resident memory in kB."""
    for line in Path(f"/proc/{process.pid}/status").read_text().splitlines():
        if line.startswith("VmRSS"):
            return int(line.split()[1])
    raise AssertionError("no VmRSS")


def test_a_flood_of_garbage_on_every_topic_changes_nothing(loop, tmp_path):
    running = start_pair(loop, real_time_factor=SLOW)
    out = tmp_path / "run"
    with operator(loop) as desk:
        running["tuner"] = start_tuner(loop, out, iterations=40)
        until(lambda: adapted(out) >= 1, LIMIT, "iteration 1")
        before = {name: resident(process) for name, process in running.items()}
        flood = loop.start("-c", FLOOD, name="flood")
        sent = int(loop.wait(flood, LIMIT).strip().splitlines()[-1])
        assert sent > 2000
        after = {name: resident(process) for name, process in running.items()}
        full_speed(desk)
    loop.wait(running["tuner"], LIMIT)
    assert_same_training(out, in_process(iterations=40))
    for name in running:
        assert after[name] - before[name] < 20_000, f"{name} grew from {before} to {after} kB"
    reports = loop.output(running["plant"]).count("refused")
    assert 1 <= reports <= 12  # at most one a second
    assert json.loads((out / "result.json").read_text())["rollouts"][0]["adaptation"] == 80
