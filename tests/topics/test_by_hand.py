# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The three terminals of docs/ros2.md, as the page prints them."""

from __future__ import annotations

import contextlib
import os
import re
import signal
import subprocess
from functools import partial
from pathlib import Path

import pytest

from pdeloop.process.start import die_with
from tests.support.loop_harness import ROOT, Processes

pytestmark = pytest.mark.topics
LIMIT = 180.0
"""Seconds: a training of Burgers."""


def blocks() -> list[str]:
    page = (ROOT / "docs" / "ros2.md").read_text()
    section = page.partition("## The nodes by hand")[2].partition("\n## ")[0]
    found: list[str] = re.findall(r"```sh\n(.*?)```", section, flags=re.DOTALL)
    return found


def test_the_three_terminals_train_and_say_where_the_results_are(
    loop: Processes, tmp_path: Path
) -> None:
    found = blocks()
    assert len(found) == 3
    home = tmp_path / "home"
    home.mkdir()
    for name in (".venv", "config"):
        (home / name).symlink_to(ROOT / name)
    domain = loop.environment["ROS_DOMAIN_ID"]
    # A new terminal: nothing on the path but what the block puts there.
    bare = {**loop.environment, "PATH": "/usr/local/bin:/usr/bin:/bin"}
    started = []
    try:
        for block in found:
            assert "export ROS_DOMAIN_ID=42" in block
            text = block.replace("ROS_DOMAIN_ID=42", f"ROS_DOMAIN_ID={domain}")
            few = "out:=my_run -p rollouts:=9 -p optimizer:=two_point -p evaluation_fields:=1"
            text = text.replace("out:=my_run", few)
            with (tmp_path / f"{len(started)}.log").open("wb") as log:
                started.append(
                    subprocess.Popen(
                        ["bash", "-e", "-c", text],
                        cwd=home,
                        env=bare,
                        stdin=subprocess.DEVNULL,
                        stdout=log,
                        stderr=subprocess.STDOUT,
                        start_new_session=True,
                        preexec_fn=partial(die_with, os.getpid()),
                    )
                )
        assert started[2].wait(LIMIT) == 0
    finally:
        for process in started:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGTERM)
        for process in started:
            process.wait(LIMIT)
    shown = (tmp_path / "2.log").read_text()
    for words in (
        "seed 0: reduced model of order",
        "rollouts: mean cost",
        "mean stage cost after adaptation",
        "results in my_run",
    ):
        assert words in shown, shown
    assert (home / "my_run" / "result.json").is_file()
