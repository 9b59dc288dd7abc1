# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""`python -m benchmarks first_run`: where the first `make run` in a fresh clone spends its time."""

from __future__ import annotations

import os
import subprocess
import tempfile
import time
from pathlib import Path
from typing import Any

from benchmarks.processes import BenchError, machine, markdown
from pdeloop.process.module_path import PROJECT

PARTS = {"start (": "compile", "identify": "start-up", "adapt": "first law"}
"""The phases, in order, each by the beginning of the line that is printed at its end."""


def run(*, python: str = "python3") -> dict[str, Any]:
    """Measure the seconds of each part of `make run` in a clone of this checkout.

    Parameters
    ----------
    python
        Python interpreter with which the virtual environment is made.
    """
    clean = {k: v for k, v in os.environ.items() if k not in ("VIRTUAL_ENV", "NUMBA_CACHE_DIR")}
    clean["PYTHONUNBUFFERED"] = "1"
    with tempfile.TemporaryDirectory() as folder:
        clone = Path(folder) / "clone"
        subprocess.run(["git", "clone", "--quiet", str(PROJECT), str(clone)], check=True)
        began = time.monotonic()
        words = ["make", "--no-print-directory", f"PYTHON={python}", ".venv/runs"]
        subprocess.run(words, cwd=clone, env=clean, check=True, stdout=subprocess.DEVNULL)
        marks = [("set-up", time.monotonic() - began)]
        words[-1] = "run"
        pipe = {"stdout": subprocess.PIPE, "text": True}
        with subprocess.Popen(words, cwd=clone, env=clean, **pipe) as process:  # type: ignore[call-overload]
            for line in process.stdout:
                for beginning, part in PARTS.items():
                    if line.startswith(beginning) and part not in dict(marks):
                        marks.append((part, time.monotonic() - began))
        if process.returncode:
            raise BenchError(f"make run ended with code {process.returncode}")
        marks.append(("adaptation and evaluation", time.monotonic() - began))
    ends = [0.0, *(end for _, end in marks)]
    rows = [{"part": part, "seconds": end - ends[i]} for i, (part, end) in enumerate(marks)]
    return {"rows": rows, "seconds": ends[-1], "machine": machine()}


def text(result: dict[str, Any]) -> str:
    """A table of the parts and their sum."""
    rows = [(row["part"], f"{row['seconds']:.1f}") for row in result["rows"]]
    return markdown(("part", "s"), [*rows, ("in all", f"{result['seconds']:.1f}")])
