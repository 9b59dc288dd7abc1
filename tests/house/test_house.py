# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The rules of the house: layers point downwards, and pure modules never see ROS."""

from __future__ import annotations

import ast
from functools import cache
from pathlib import Path

import pytest

from tests.support.interpreter import ROOT, python

NODE = {"pdeloop.messages", "pdeloop.process", "pdeloop.ros"}
KNOWS: dict[str, set[str]] = {
    "pdeloop.messages": set(),
    "pdeloop.jit": {"pdeloop.messages"},
    "pdeloop.process": {"pdeloop.messages"},
    "pdeloop.ros": {"pdeloop.messages", "pdeloop.process"},
    "pdeloop.solver": {"pdeloop.messages", "pdeloop.jit", "pdeloop.process"},
    "pdeloop.fast_path": {"pdeloop.messages", "pdeloop.jit"},
    "pdeloop.method": {"pdeloop.messages", "pdeloop.jit", "pdeloop.process", "pdeloop.solver"},
    "pde_sim_node": NODE | {"pdeloop.jit", "pdeloop.fast_path", "pdeloop.solver"},
    "controller_node": NODE | {"pdeloop.jit", "pdeloop.fast_path", "pdeloop.method"},
    "tuner_node": NODE | {"pdeloop.method"},
    "recorder_node": NODE,
    "viewer_node": NODE,
}
"""Each package below the tools of `pdeloop`, and those that it may import: no node imports another."""
WITH_ROS = {
    "node.py",
    "node_loop.py",
    "sample_subscription.py",
    "observer.py",
    "loop_reader.py",
    "peers.py",
    "node_main.py",
    "endpoints.py",
    "introspection.py",
    "service_call.py",
    "parameters.py",
}
"""Files that may import rclpy or messages."""
ROS = (
    "rclpy",
    "std_msgs",
    "std_srvs",
    "rosgraph_msgs",
    "rcl_interfaces",
    "diagnostic_msgs",
    "sensor_msgs",
    "visualization_msgs",
    "geometry_msgs",
    "launch",
    "launch_ros",
)
LARGE = ("matplotlib", "scipy.signal", "scipy.stats")
"""Half a second of a core to import: for who uses them, not for each node that starts."""


def package_of(module: str) -> str:
    """The package in KNOWS of a module; `pdeloop` for what is above them, and other top names."""
    parts = module.split(".")
    return below if (below := ".".join(parts[:2])) in KNOWS else parts[0]


def sources(*packages: str) -> list[Path]:
    folders = [ROOT.joinpath(*package.split(".")) for package in packages]
    return sorted({path for folder in folders for path in folder.rglob("*.py")})


@cache
def imports(path: Path) -> set[str]:
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            found.add(node.module)
    return found


def tops(path: Path) -> set[str]:
    return {name.split(".")[0] for name in imports(path)}


@pytest.mark.parametrize("package", KNOWS)
def test_a_package_imports_only_what_is_below_it(package):
    others = {"pdeloop", *KNOWS} - {package} - KNOWS[package]
    assert sources(package)
    for path in sources(package):
        assert not {package_of(name) for name in imports(path)} & others, path


def test_only_the_named_files_import_ros():
    for path in sources(*KNOWS, "pdeloop"):
        if path.name not in WITH_ROS:
            assert not tops(path) & set(ROS), path


def test_nothing_installed_imports_benchmarks_or_tests():
    for path in sources(*KNOWS, "pdeloop"):
        assert not tops(path) & {"benchmarks", "tests"}, path


def test_the_loop_runs_in_one_process_without_ros_and_large_imports():
    program = (
        "import sys\n"
        f"for name in {ROS + LARGE!r}: sys.modules[name] = None\n"
        "from tests.support.small import parameters, train_here\n"
        "print(train_here(parameters(iterations=1)).policies().shape)\n"
    )
    done = python("-c", program)
    assert done.stdout.strip() == "(1, 4, 8)"


def test_what_only_some_trainings_need_of_scipy_is_loaded_when_it_is_used():
    parts = [
        f"scipy.{part}" for part in ("fft", "optimize", "signal", "sparse", "special", "stats")
    ]
    program = (
        "import sys, controller_node.node, pde_sim_node.node, tuner_node.node, pdeloop.training_run\n"
        f"print([name for name in {parts} if name in sys.modules])"
    )
    assert python("-c", program).stdout.strip() == "[]"
