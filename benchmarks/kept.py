# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Trainings side by side, each kept in a file, so that an interrupted run continues where it stood."""

from __future__ import annotations

import json
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from pdeloop.messages.files import make_folder, read_json, write_atomically
from pdeloop.study.executors import processes

Row = dict[str, Any]
Task = TypeVar("Task")


def rows_of(
    tasks: Sequence[Task],
    train: Callable[..., Row],
    line: Callable[[Sequence[Row]], str],
    *,
    jobs: int | None,
    folder: Path,
) -> list[Row]:
    """The row of each task, in their order; each is printed as a line once it is there.

    train: of a task, with `folder`; line: of one or more rows; jobs: processes, one a core if none.
    """
    make_folder(folder)
    rows, began = [], time.monotonic()
    with processes(jobs) as pool:
        for row in pool.map(partial(train, folder=folder.resolve()), tasks):
            rows.append(row)
            done = f"({len(rows)} of {len(tasks)}, {time.monotonic() - began:.0f} s)"
            print(f"{line([row])} {done}", file=sys.stderr, flush=True)
    return rows


def kept_row(path: Path, case: Mapping[str, Any], costs: Callable[[], Mapping[str, Any]]) -> Row:
    """The row in a file, or one of this case with its costs, or the error that ended it, put there."""
    if path.exists():
        found: Row = read_json(path)
        return found
    row = dict(case)
    try:
        row |= costs()
    except (ValueError, RuntimeError) as error:
        row["error"] = " ".join(str(error).split())
    write_atomically(path, json.dumps(row).encode())
    return row


def errors(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    """What ended trainings, a line each."""
    return [
        f"{row['problem']}, seed {row['seed']}: {row['error']}" for row in rows if "error" in row
    ]
