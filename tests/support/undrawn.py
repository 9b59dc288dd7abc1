# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Reports of a command whose PNGs hold no picture: drawing is most of what they cost."""

from __future__ import annotations

from pathlib import Path

from tests.support.loop_harness import Processes

PROGRAM = """
import sys
from pdeloop.cli import main
from pdeloop.report import page

page._draw = lambda figure, png: png.write(b"a picture")
sys.exit(main())
"""


def report(loop: Processes, folder: Path, limit: float) -> str:
    """What `pdeloop report FOLDER` prints. Pictures are tested in tests/tools/test_report.py."""
    return loop.wait(loop.start("-c", PROGRAM, "report", str(folder)), limit)
