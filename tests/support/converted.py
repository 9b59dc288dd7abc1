# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""`rosbags-convert` in this process."""

from __future__ import annotations

import sys

import pytest
from rosbags.convert.cli import main


def convert(*command: str) -> None:
    """Run the command `rosbags-convert ...`, which has to succeed."""
    assert command[0] == "rosbags-convert"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "argv", list(command))
        with pytest.raises(SystemExit) as ended:
            main()
    assert not ended.value.code
