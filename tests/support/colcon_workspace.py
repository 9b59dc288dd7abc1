# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A colcon workspace with a clean copy of the sources, built once for the tests that ask for it."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

from pdeloop.training_run import load_compiled, resolve
from tests.support.small import SMALL

ROOT = Path(__file__).resolve().parents[2]
_NOT_SOURCES = (".*", "__pycache__", "*.egg-info", "build", "install", "log", "runs", "tests")


@dataclass(frozen=True)
class Workspace:
    """prefix: where the package was installed; environment: what `. install/setup.sh` changes."""

    prefix: Path
    environment: dict[str, str]
    said: str

    def run(self, *command: str, cwd: Path) -> subprocess.CompletedProcess[str]:
        """A command in the workspace's environment; an executable is named as `ros2 run` does."""
        return subprocess.run(
            [str(self.executable(command[0])), *command[1:]],
            env=os.environ | self.environment,
            cwd=cwd,
            capture_output=True,
            text=True,
            timeout=300,
        )

    def add_compiled(self) -> None:
        """Put beside the installed files what Numba has compiled of the sources, which are the same.

        Compiling it again would be most of what the tests of an installation do.
        """
        (library,) = self.prefix.glob("lib/python*/site-packages")
        add_compiled(library)

    def executable(self, name: str) -> Path:
        """The file that `ros2 run pdeloop NAME` and launch_ros look for."""
        return self.prefix / "lib" / "pdeloop" / name


def add_compiled(library: Path) -> None:
    """Put what Numba has compiled of the sources beside their copies in a folder of packages."""
    load_compiled(resolve(str(SMALL), {}))
    for installed in library.iterdir():
        for path in (ROOT / installed.name).rglob("*.nb[ic]"):
            target = library / path.relative_to(ROOT)
            target.parent.mkdir(exist_ok=True)
            shutil.copy2(path, target)


def copy_sources(folder: Path) -> Path:
    """A clean copy of the sources in a new folder."""
    shutil.copytree(ROOT, folder, ignore=shutil.ignore_patterns(*_NOT_SOURCES))
    return folder


def build(folder: Path, *options: str) -> Workspace:
    """A workspace in `folder`, after `colcon build OPTIONS`."""
    copy_sources(folder / "src" / "pdeloop")
    clean = {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "AMENT_PREFIX_PATH")}
    clean["PATH"] = f"{Path(sys.executable).parent}{os.pathsep}{clean['PATH']}"
    done = subprocess.run(
        [sys.executable, "-m", "colcon", "build", *options],
        cwd=folder,
        env=clean,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stdout[-5000:]
    shown = subprocess.run(
        ["sh", "-c", ". install/setup.sh && env -0"],
        cwd=folder,
        env=clean,
        capture_output=True,
        text=True,
        check=True,
        timeout=600,
    )
    after = dict(item.split("=", 1) for item in shown.stdout.split("\0") if item)
    # The workers share it, and each has a temporary folder of its own.
    environment = {name: value for name, value in after.items() if os.environ.get(name) != value}
    prefix = Path(environment["AMENT_PREFIX_PATH"].split(os.pathsep)[0])
    return Workspace(prefix, environment, done.stdout)
