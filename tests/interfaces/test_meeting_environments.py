# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Commands in environments that are set for other work: each works, or names the variable."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from pdeloop.process.isolation import NETWORK
from pdeloop.process.ros_environment import STEERING, steering, with_servers_there
from pdeloop.process.start import BLAS_THREADS, OWN, what_to_install
from tests.support.interpreter import LIMIT, ROOT
from tests.support.loop_harness import Processes
from tests.support.small import SMALL


def command(folder: Path, *words: str, **environment: str) -> subprocess.CompletedProcess[str]:
    """`pdeloop WORDS...` in a folder and an environment."""
    return subprocess.run(
        [sys.executable, "-m", "pdeloop", *words],
        env={**os.environ, "PYTHONPATH": str(ROOT), **environment},
        cwd=folder,
        capture_output=True,
        text=True,
        check=False,
    )


def test_figures_need_no_backend_of_another_program(loop: Processes) -> None:
    (loop.folder / "matplotlibrc").write_text("text.usetex: True\nfont.family: nowhere\n")
    for backend in ("module://matplotlib_inline.backend_inline", "TkAgg", "none"):
        loop.environment["MPLBACKEND"] = backend
        loop.wait(loop.pdeloop("check", str(SMALL), "--picture", f"{backend[:3]}.png"), LIMIT)
        assert (loop.folder / f"{backend[:3]}.png").read_bytes()[1:4] == b"PNG"


def test_a_stream_that_cannot_write_a_character_ends_no_training(tmp_path: Path) -> None:
    plant = tmp_path / "plant.py"
    plant.write_text(
        "import numpy as np, pdeloop\n"
        "class Plant(pdeloop.Dynamics):\n"
        "    n_z, n_a, horizon = 2, 1, 10\n"
        "    def initial_state(self, rng):\n"
        "        return rng.normal(size=2)\n"
        "    def step(self, z, a):\n"
        "        return 0.9 * z + a\n"
    )
    folder = tmp_path / "größe"
    words = ("train", "--plant", f"{plant}:Plant", "--in-process", "--rollouts", "6")
    words += ("--optimizer", "two_point")
    ended = command(tmp_path, *words, "--out", str(folder), PYTHONIOENCODING="ascii")
    assert ended.returncode in (0, 3), ended.stderr  # 3: the law of few rollouts costs more
    assert "gr\\xf6\\xdfe" in ended.stdout and (folder / "result.json").exists()


def test_the_rclpy_of_another_python_is_named_with_its_place(tmp_path: Path) -> None:
    foreign = tmp_path / "foreign" / "rclpy"
    foreign.mkdir(parents=True)
    for missing in ("ImportError", "ModuleNotFoundError"):
        text = f"raise {missing}('_rclpy_pybind11', name='_rclpy')\n"
        (foreign / "__init__.py").write_text(text)
        with pytest.raises(ImportError) as raised:
            exec(compile(text, str(foreign / "__init__.py"), "exec"))
        assert f"rclpy in {foreign.parent} cannot be loaded" in str(what_to_install(raised.value))
    words = ("train", "allen-cahn", "--rollouts", "6")
    path = os.pathsep.join([str(foreign.parent), str(ROOT)])
    ended = command(tmp_path, *words, PYTHONPATH=path, ROS_LOG_DIR=str(tmp_path))
    assert ended.returncode == 1
    assert "Traceback" not in ended.stderr
    assert f"rclpy in {foreign.parent} cannot be loaded by this Python" in ended.stderr


def test_a_discovery_server_that_is_not_there_is_left_out_and_named() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as server:
        server.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{server.getsockname()[1]}"
        there = {"ROS_DISCOVERY_SERVER": address}
        assert with_servers_there(there) == (there, [])
    found, (said,) = with_servers_there(there)
    assert (
        found == {} and said == f"ROS_DISCOVERY_SERVER={address} is ignored: no server runs there"
    )
    elsewhere = {"ROS_DISCOVERY_SERVER": "192.0.2.7:11811"}
    assert with_servers_there(elsewhere) == (elsewhere, [])


def test_who_waits_names_the_variables_that_may_be_the_cause() -> None:
    usual = {"ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET", "RMW_IMPLEMENTATION": "rmw_fastrtps_cpp"}
    assert steering(usual) == ""
    set_ = {"ROS_STATIC_PEERS": "192.0.2.7", "ROS_DISCOVERY_SERVER": "x:1"}
    assert steering(usual | set_) == "ROS_STATIC_PEERS=192.0.2.7, ROS_DISCOVERY_SERVER=x:1"


def test_a_table_names_the_variables() -> None:
    page = (ROOT / "docs" / "troubleshooting.md").read_text()
    names = {*STEERING, *OWN, NETWORK, BLAS_THREADS, "ROS_LOG_DIR", "PYTHONIOENCODING"}
    assert {name for name in names if f"`{name}`" not in page} == set()
