# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A small study: its content, an executor for it, and the files that it leaves."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from pdeloop.study.results import reading
from tests.support.small import FEW_STEPS, SMALL

LIMIT = 300.0
CONTENT: dict[str, Any] = {
    "problems": [str(SMALL)],
    "seeds": 2,
    "settings": {"rollouts": 9},
    "variants": {"model-based": {"optimizer": "model_based", **FEW_STEPS}, "two-point": {}},
}


def contents(folder: Path) -> dict[str, bytes]:
    """All files of the finished trainings."""
    with reading(folder) as results:
        return {
            f"{row['name']}/{file}": content
            for row in sorted(results.rows("name"), key=lambda row: str(row["name"]))
            for file, content in results.files(row["name"]).items()
        }


@contextmanager
def here() -> Iterator[Executor]:
    with ThreadPoolExecutor(1) as pool:
        yield pool
