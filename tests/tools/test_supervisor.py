# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""What a supervisor says of nodes that keep dying."""

from __future__ import annotations

import sys
import time
from pathlib import Path

import pytest

from pdeloop import supervisor
from pdeloop.supervisor import BACK_OFF, Child, NodeError, Supervisor


@pytest.mark.parametrize(("number", "full"), [("SIGBUS", True), ("SIGKILL", False)])
def test_a_node_that_is_given_up_is_told_with_its_signal_and_what_may_cause_it(
    number: str, full: bool, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(supervisor, "BACK_OFF", (0.0,) * len(BACK_OFF))
    code = f"import os, signal; os.kill(os.getpid(), signal.{number})"
    child = Child("plant", lambda: [sys.executable, "-S", "-c", code], tmp_path / "log")
    running = Supervisor([child], "plant", 7, tmp_path, lambda line: None, {})
    with pytest.raises(NodeError) as error:
        while not running.poll():
            time.sleep(0.01)
    assert f"plant was killed by {number} for the 6th time" in str(error.value)
    assert ("/dev/shm" in str(error.value)) is full
