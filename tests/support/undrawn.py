# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Reports whose pictures hold the texts of their figures: drawing is most of what they cost."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

if TYPE_CHECKING:
    from tests.support.loop_harness import Processes

PROGRAM = """
import sys
from pdeloop.cli import main
from tests.support.undrawn import undraw

undraw(setattr)
sys.exit(main())
"""


class Texts:
    """In place of a canvas for SVG files."""

    def __init__(self, figure: Any) -> None:
        self._figure = figure

    def print_svg(self, file: IO[bytes], **_: Any) -> None:
        from matplotlib.text import Text

        file.write("\n".join(text.get_text() for text in self._figure.findobj(Text)).encode())


def undraw(put: Callable[[Any, str, Any], None]) -> None:
    """Put these into the place of what draws figures, with `setattr` or one that is undone."""
    from pdeloop.report import page

    put(page, "_draw", lambda figure, png: png.write(b"a picture"))
    put(page, "FigureCanvasSVG", Texts)


def report(loop: Processes, folder: Path, limit: float) -> str:
    """What `pdeloop report FOLDER` prints. Pictures are tested in tests/tools/test_report.py."""
    return loop.wait(loop.start("-c", PROGRAM, "report", str(folder)), limit)
