# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A law exported as a ROS 2 package: built by colcon, and over topics that of the loop, to the bit."""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import pdeloop
from pdeloop.cli import main
from pdeloop.finished_run import FinishedRun
from pdeloop.messages.action_set import ActionSet
from pdeloop.messages.arrays import Array
from pdeloop.ros2_package import write_package
from tests.support.loop_harness import Processes
from tests.support.small import SMALL
from tests.support.small_loop import LIMIT

QUICK: dict[str, Any] = {"optimizer": "two_point", "rollouts": 6, "evaluation_fields": 2}


RATE = [0.1, np.inf, 0.25]
SAFE = [-0.125, 0.0, 0.25]


class Bounded(pdeloop.Dynamics):
    """Three actuators with bounds, one of one side."""

    n_z, n_a, horizon, sample_time = 8, 3, 20, 0.1
    action_low, action_high = (-0.2, -1.0, 0.0), (0.4, np.inf, 0.3)

    def __init__(self) -> None:
        self._A = 0.9 * np.eye(8) + 0.05 * np.eye(8, k=1)
        self._B = np.eye(8, 3) + 0.2 * np.eye(8, 3, k=-3)

    def initial_state(self, rng: np.random.Generator) -> Array:
        return rng.standard_normal(8)

    def step(self, z: Array, a: Array) -> Array:
        return np.asarray(self._A @ z + self._B @ a)


def exported(folder: Path) -> Any:
    """The law of an exported package, without installing it."""
    path = folder / folder.name / "law.py"
    spec = importlib.util.spec_from_file_location(f"exported_{folder.name}", path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.Law()


def answers(run: FinishedRun, readings: Array) -> Array:
    """The actions of the run's law."""
    law = run.law()
    return np.array([law(k, y[None])[0] for k, y in enumerate(readings)])


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> FinishedRun:
    out = tmp_path_factory.mktemp("runs") / "run"
    return pdeloop.train(plant=Bounded(), reduced_order=4, **QUICK, out=out)


@pytest.mark.parametrize("rate", [[], RATE])
@pytest.mark.parametrize("balanced", [False, True])
def test_the_affine_law_has_the_bits_of_the_loop_within_the_bounds(
    trained: FinishedRun, tmp_path: Path, balanced: bool, rate: list[float]
) -> None:
    bounds = [*trained.values["action_bounds"][:-1], float(balanced), *rate]
    run = replace(trained, values={**trained.values, "action_bounds": bounds})
    write_package(run, tmp_path / "law")
    readings = 3.0 * np.random.default_rng(0).standard_normal((20, 8))
    law, expected = exported(tmp_path / "law"), answers(run, readings)
    for _ in range(2):
        assert np.array_equal([law(y) for y in readings], expected)
        law.reset()
    low, high = np.array(Bounded.action_low), np.array(Bounded.action_high)
    assert (expected >= low).all() and (expected <= high).all()
    assert ((expected == low) | (expected == high)).any()
    if balanced:
        assert np.abs(expected.sum(axis=1)).max() < 1e-12
    moved = np.abs(np.diff(expected, axis=0)).max(axis=0)
    assert ((moved <= np.array(rate or 3 * [np.inf]) + 1e-12).all()) and (rate or moved[0] > 0.1)


def test_the_observer_has_the_bits_of_the_loop_and_begins_anew(tmp_path: Path) -> None:
    sensed = {"law": "observer", "sensors": 8, "action_limit": 0.2, "horizon": 20}
    run = pdeloop.train(str(SMALL), **sensed, **QUICK, out=tmp_path / "run")
    write_package(run, tmp_path / "law")
    readings = 500.0 * np.random.default_rng(0).standard_normal((12, 8))
    law, expected = exported(tmp_path / "law"), answers(run, readings)
    for _ in range(2):
        assert np.array_equal([law(y) for y in readings], expected)
        law.reset()
    assert (np.abs(expected) == 0.2).any()


def test_what_cannot_be_a_package_is_refused(
    trained: FinishedRun, tmp_path: Path, capsys: Any
) -> None:
    full = tmp_path / "full"
    full.mkdir()
    (full / "own.py").touch()
    for folder, told in {
        "My-Law": "cannot be the name of a ROS 2 package",
        "full": "exists",
    }.items():
        assert main(["export", str(trained.folder), "--ros2", str(tmp_path / folder)]) == 1
        assert told in capsys.readouterr().err
    assert not (tmp_path / "My-Law").exists() and len([*full.iterdir()]) == 1


DRIVER = """
import sys, time
import numpy as np, rclpy
from std_msgs.msg import Float64MultiArray

readings, out, limit = np.load(sys.argv[1]), sys.argv[2], time.monotonic() + 60.0
rclpy.init()
node, heard, safe = rclpy.create_node("rig"), [], []
sender = node.create_publisher(Float64MultiArray, "measurement", 1)

def listen(message):
    action = list(message.data)
    (safe if action == [-0.125, 0.0, 0.25] else heard).append(action)

node.create_subscription(Float64MultiArray, "action", listen, 10)

def wait(condition):
    while not condition():
        assert time.monotonic() < limit, "nobody answers"
        rclpy.spin_once(node, timeout_sec=0.05)

wait(lambda: sender.get_subscription_count() and safe)
heard.clear()
for k, y in enumerate(readings):
    sender.publish(Float64MultiArray(data=y.tolist()))
    wait(lambda: len(heard) > k)
safe.clear()
wait(lambda: safe)  # as there are no measurements any more
sender.publish(Float64MultiArray(data=[1.0]))
wait(lambda: len(safe) > 3)
np.save(out, np.array(heard))
"""


@pytest.mark.topics
def test_colcon_builds_it_and_over_topics_it_is_the_law_of_the_loop(
    loop: Processes, tmp_path: Path
) -> None:

    class Slow(Bounded):
        """With rate limits."""

        action_rate = tuple(RATE)

    run = pdeloop.train(plant=Slow(), reduced_order=4, **QUICK, out=tmp_path / "run")
    package = tmp_path / "src" / "bounded_law"
    assert main(["export", str(run.folder), "--ros2", str(package)]) == 0
    manifest = ElementTree.parse(package / "package.xml").getroot()
    needs = {item.text for item in manifest.iter("exec_depend")}
    assert needs == {"rclpy", "std_msgs", "python3-numpy"}
    assert not any("pdeloop" in path.read_text() for path in package.rglob("*.py"))
    clean = {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "AMENT_PREFIX_PATH")}
    clean["PATH"] = f"{Path(sys.executable).parent}{os.pathsep}{clean['PATH']}"
    built = subprocess.run(
        [sys.executable, "-m", "colcon", "build", "--base-paths", str(package)],
        cwd=tmp_path,
        env=clean,
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert built.returncode == 0, built.stdout + built.stderr
    node = tmp_path / "install" / "bounded_law" / "lib" / "bounded_law" / "law"
    assert (tmp_path / "install/bounded_law/share/bounded_law/launch/law.launch.py").is_file()
    readings = 3.0 * np.random.default_rng(1).standard_normal((20, 8))
    np.save(tmp_path / "readings.npy", readings)
    (library,) = (tmp_path / "install" / "bounded_law").glob("lib/python*/site-packages")
    loop.environment["PYTHONPATH"] = str(library)
    parameters = ["-p", f"safe_action:={SAFE}", "-p", "timeout_samples:=10"]
    started = loop.program(str(node), "--ros-args", *parameters, name="law")
    files = str(tmp_path / "readings.npy"), str(tmp_path / "heard.npy")
    driver = loop.program(sys.executable, "-c", DRIVER, *files, name="rig")
    loop.wait(driver, LIMIT)
    heard, held = np.load(files[1]), np.array(SAFE)  # until the first measurement
    free = replace(run, values={**run.values, "action_bounds": []})
    for k, requested in enumerate(answers(free, readings)):
        held = ActionSet.of(run.values).project(requested, after=held)
        assert np.array_equal(heard[k], held)
    # Without measurements it goes to the safe action within the rate limits.
    returns = np.diff([*heard[19:], SAFE], axis=0)
    assert len(returns) > 1 and (np.abs(returns) <= np.array(RATE) + 1e-12).all()
    assert "no measurement for" in loop.output(started)
    assert "must be 8 finite numbers, got 1" in loop.output(started)


OPERATOR = """
import sys, time
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from lifecycle_msgs.srv import ChangeState
from std_msgs.msg import Float64MultiArray

rclpy.init()
node, heard, told, limit = rclpy.create_node("rig"), [], [], time.monotonic() + 60.0
sender = node.create_publisher(Float64MultiArray, "measurement", 1)
node.create_subscription(Float64MultiArray, "action", lambda m: heard.append(list(m.data)), 100)
node.create_subscription(DiagnosticArray, "/diagnostics", lambda m: told.extend(m.status), 10)
change = node.create_client(ChangeState, "bounded_law/change_state")

def wait(condition):
    while not condition():
        assert time.monotonic() < limit, (heard, told)
        rclpy.spin_once(node, timeout_sec=0.05)

def go(transition):
    request = ChangeState.Request()
    request.transition.label = transition
    answer = change.call_async(request)
    wait(answer.done)
    assert answer.result().success, transition

def told_of(state):
    told.clear()
    wait(lambda: told and told[-1].message == state)
    return {entry.key: int(entry.value) for entry in told[-1].values}, told[-1].level[0]

wait(change.service_is_ready)
go("configure")
wait(sender.get_subscription_count)
assert told_of("inactive") == ({"answered": 0, "refused measurements": 0}, 0) and not heard
go("activate")
sender.publish(Float64MultiArray(data=[1.0] * 8))
wait(lambda: len(heard) >= 3)  # of one measurement, at the rate
counts, level = told_of("active")
assert counts["answered"] >= 3 and level == 0
go("deactivate")
assert told_of("inactive")[1] == 0
print("heard", heard[0], heard[2], heard[-1], flush=True)
"""


@pytest.mark.topics
def test_an_operator_steps_its_lifecycle_and_reads_its_diagnostics(
    loop: Processes, trained: FinishedRun, tmp_path: Path
) -> None:
    """By the services of `ros2 lifecycle set`; one measurement is answered at the rate."""
    write_package(trained, tmp_path / "bounded_law")
    loop.environment["PYTHONPATH"] = str(tmp_path / "bounded_law")
    words = ["autostart:=false", "rate:=10.0", "timeout_samples:=1000", f"safe_action:={SAFE}"]
    parameters = [part for word in words for part in ("-p", word)]
    node = [sys.executable, "-m", "bounded_law.node", "--ros-args", *parameters]
    loop.program(*node, name="law")
    operator = loop.program(sys.executable, "-c", OPERATOR, name="rig")
    loop.wait(operator, LIMIT)
    expected = answers(trained, np.ones((1, 8)))[0].tolist()
    assert f"heard {expected} {expected} {SAFE}" in loop.output(operator)
