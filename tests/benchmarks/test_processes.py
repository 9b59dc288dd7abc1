# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The measurements start nodes of their own, wherever the command is given."""

from __future__ import annotations

import pytest

from benchmarks.processes import bench
from pdeloop.process.module_path import PROJECT

pytestmark = pytest.mark.topics


def test_nodes_of_the_benchmarks_start_from_the_checkout(monkeypatch: pytest.MonkeyPatch) -> None:
    """A process leaves its working directory out of the module path."""
    monkeypatch.chdir(PROJECT)
    with bench() as running:
        ping = running.start("benchmarks.ping")
        running.start("benchmarks.ping", "end:=pong")
        assert ping.ask(seconds=0.01, numbers=2)["rounds"] > 0
