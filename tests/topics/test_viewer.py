# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The viewer beside a running loop: what it shows is the loop's, and the loop does not notice it."""

from __future__ import annotations

import json
import os
import signal

import pytest

from pdeloop.messages.topics import VIEW_NUMBERS
from tests.support.loop_harness import Processes, until
from tests.support.operator_harness import operator
from tests.support.small import paced
from tests.support.small_loop import (
    LIMIT,
    PARAMETERS,
    adapted,
    assert_same_training,
    in_process,
    start_pair,
    start_tuner,
)
from tests.viewer.test_layouts import named_topics

pytestmark = pytest.mark.topics
ITERATIONS = 120

WATCH = """
import json, sys, time
import numpy as np, rclpy
from sensor_msgs.msg import Image
from std_msgs.msg import Float64
from visualization_msgs.msg import Marker
rclpy.init()
node = rclpy.create_node("watch")
names, wanted, limit = json.loads(sys.argv[1]), int(sys.argv[2]), float(sys.argv[3])
counts, last, curves = {}, {}, {"field": [], "target": []}
def scalar(name, message):
    counts[name] = counts.get(name, 0) + 1
    last[name] = message.data
def marker(name, message):
    counts[name] = counts.get(name, 0) + 1
    points = [(p.x, p.y, p.z) for p in message.points]
    curves[name].append([y for _, y, _ in points])
    last[name] = [message.header.frame_id, message.ns, message.type, message.action, points]
def image(message):
    counts["spacetime"] = counts.get("spacetime", 0) + 1
    pixels = np.frombuffer(bytes(message.data), dtype=np.uint8)
    pixels = pixels.reshape(message.height, message.step // 3, 3)
    gray = (pixels == 128).all(axis=(1, 2))
    last["spacetime"] = [message.encoding, message.height, message.width, int((~gray).sum())]
keep = [node.create_subscription(Float64, f"view/{n}", lambda m, n=n: scalar(n, m), 10) for n in names]
keep += [node.create_subscription(Marker, f"view/{n}", lambda m, n=n: marker(n, m), 10) for n in curves]
keep += [node.create_subscription(Image, "view/spacetime", image, 10)]
everything = set(names) | set(curves) | {"spacetime"}
began = time.monotonic()
while time.monotonic() < began + limit:
    rclpy.spin_once(node, timeout_sec=0.2)
    if set(counts) == everything and min(counts.values()) >= wanted:
        break
moving = len({tuple(curve) for curve in curves["field"]})
print(json.dumps([counts, last, moving]))
rclpy.shutdown()
"""


def watched(loop: Processes, count: int, *without: str) -> list:
    """Start a reader of all other views, which ends once each has come `count` times."""
    names = [name for name in VIEW_NUMBERS if name not in without]
    return loop.start("-c", WATCH, json.dumps(names), str(count), str(LIMIT), name="watch")


def test_the_views_are_those_of_the_loop_and_the_policy_is_the_same(loop: Processes, tmp_path):
    start_pair(loop, real_time_factor=4.0)  # until all views were seen
    viewer = loop.node("viewer_node", *PARAMETERS)
    watch = watched(loop, 12, "reduction")  # which needs costs of the same fields: the evaluation
    out = tmp_path / "run"
    with operator(loop) as desk:
        until(
            lambda: int(desk.values("viewer_node").get("subscribers", 0)) >= len(VIEW_NUMBERS) + 2,
            LIMIT,
            "subscribers",
        )
        tuner = start_tuner(loop, out, iterations=ITERATIONS)
        until(lambda: "view/field" in str(desk.ask(topics=None)), LIMIT, "views")
        types = desk.ask(topics=None)
        for topic, kind in named_topics().items():
            assert types[topic] == [kind]
        counts, last, moving = json.loads(loop.wait(watch, LIMIT).strip().splitlines()[-1])
        assert tuner.poll() is None
        assert desk.ask(set=["/pde_sim_node", "real_time_factor", 0.0])[0]
        loop.wait(tuner, LIMIT)
        assert_same_training(out, in_process(iterations=ITERATIONS))
        assert min(counts.values()) >= 12
        frame, namespace, kind, action, points = last["field"]
        assert (frame, namespace, kind, action) == ("field", "field", 4, 0)  # a LINE_STRIP, added
        assert len(points) == len(last["target"][4]) == 32
        assert points[1][0] - points[0][0] == pytest.approx(1.0 / 32)
        assert all(z == 0.0 for _, _, z in points)
        assert moving > 3
        encoding, height, width, seen = last["spacetime"]
        assert (encoding, height, width) == ("rgb8", 31, 32)
        assert seen > 1
        costs = json.loads((out / "result.json").read_text())["mean_cost"]
        # After the evaluation the last costs are its own.
        assert last["cost_no_control"] > 0
        final = watched(loop, 2)
        _, told, _ = json.loads(loop.wait(final, LIMIT).strip().splitlines()[-1])
        assert told["cost_no_control"] == pytest.approx(costs["none"], rel=1e-12)
        assert told["cost_lqt"] == pytest.approx(costs["lqt"], rel=1e-12)
        assert told["cost"] == pytest.approx(costs["adapted"], rel=1e-12)
        reduction = 100 * (1 - costs["adapted"] / costs["lqt"])
        assert told["reduction"] == pytest.approx(reduction, abs=1e-9)
        assert told["step"] == 30.0
        until(lambda: desk.status("viewer_node")[1] == 3, LIMIT, "stale viewer")
    viewer.send_signal(signal.SIGINT)
    loop.wait(viewer, LIMIT)


def test_a_viewer_is_throttled_and_shows_another_environment_when_told_to(
    loop: Processes, tmp_path
):
    start_pair(loop, real_time_factor=20.0)  # 400 steps a second
    loop.node("viewer_node", *PARAMETERS, "-p", "view_rate:=5.0")
    with operator(loop) as desk:
        tuner = start_tuner(loop, tmp_path / "run", iterations=100_000)
        until(lambda: adapted(tmp_path / "run") >= 5, LIMIT, "iteration 5")
        assert desk.ask(set=["/viewer_node", "view_environment", 1])[0]
        until(lambda: desk.values("viewer_node").get("environment") == "1", LIMIT, "environment")
        watch = loop.start("-c", COUNT, name="count")
        first, last, count = json.loads(loop.wait(watch, LIMIT).strip().splitlines()[-1])
        assert count <= 5.0 * (last - first) + 3
        assert not desk.ask(set=["/viewer_node", "view_rate", 0.0])[0]
        assert not desk.ask(set=["/viewer_node", "length", 2.0])[0]
        assert tuner.poll() is None


COUNT = """
import json, time
import rclpy
from std_msgs.msg import Float64
rclpy.init()
node = rclpy.create_node("count")
times = []
node.create_subscription(Float64, "view/step", lambda m: times.append(time.monotonic()), 100)
end = time.monotonic() + 200.0
while len(times) < 25 and time.monotonic() < end:
    rclpy.spin_once(node, timeout_sec=0.2)
assert len(times) >= 25, len(times)
print(json.dumps([times[0], times[-1], len(times)]))
rclpy.shutdown()
"""


def test_the_command_line_starts_a_viewer_and_goes_on_when_it_dies(loop: Processes, tmp_path):
    out = tmp_path / "run"
    options = ("--iterations", "100000", "--optimizer", "two_point", "--out", str(out))
    problem = str(paced(tmp_path, 20.0))
    run = loop.pdeloop("train", problem, *options, "--view", "--pairs", "2")
    with operator(loop) as desk:
        until(lambda: desk.values("pair0/viewer_node").get("samples", "0") != "0", LIMIT, "samples")
        (pid,) = loop.pids("viewer_node")
        os.kill(pid, signal.SIGKILL)
        news = "viewer_node was killed by SIGKILL; starting it again"
        until(lambda: news in loop.output(run), LIMIT, "news of it")
        until(lambda: loop.pids("viewer_node"), LIMIT, "another viewer")
        assert pid not in loop.pids("viewer_node")
        done = adapted(out)
        until(lambda: adapted(out) >= done + 20, LIMIT, "further iterations")
    assert loop.output(run).count(news) == 1
    run.send_signal(signal.SIGINT)
    loop.wait(run, LIMIT, code=130)
