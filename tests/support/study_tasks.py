# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Tasks of a study that are no trainings, for workers of other processes to import."""

from __future__ import annotations

import json
import os
import signal
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pdeloop.study.training import environment

Values = Mapping[str, Any]


def result(values: Values, cost: float = 1.0) -> dict[str, bytes]:
    """The files of a task that is finished."""
    content = {
        "environment": environment(),
        "rollouts": [{"total": 1}],
        "costs_by_field": {name: [[cost]] for name in ("none", "lqt", "adapted")},
        "seed": values["seed"],
    }
    return {"result.json": json.dumps(content).encode()}


def noted(folder: str, seconds: float, values: Values) -> dict[str, bytes]:
    """Note in `folder` that it runs, and take some time."""
    with (Path(folder) / f"{values['seed']}").open("a") as file:
        file.write(f"{os.getpid()}\n")
    time.sleep(seconds)
    return result(values)


def waiting(file: str, values: Values) -> dict[str, bytes]:
    """Wait for a file, but with the first seed."""
    while values["seed"] and not Path(file).exists():
        time.sleep(0.05)
    return result(values)


def killing(folder: str, values: Values) -> dict[str, bytes]:
    """End the worker, as one that has no memory left is ended."""
    noted(folder, 0.3, values)  # so that what it tells has been sent
    os.kill(os.getpid(), signal.SIGKILL)
    raise AssertionError("alive")


def raising(folder: str, values: Values) -> dict[str, bytes]:
    """Fail."""
    noted(folder, 0.0, values)
    raise ValueError("no model can be had")


class UnsendableError(Exception):
    """Cannot be made again from what another process is sent of it."""

    def __init__(self, number: int, unit: str) -> None:
        super().__init__(f"{number} {unit} are too much")


def unsendable(folder: str, values: Values) -> dict[str, bytes]:
    """Fail with an exception of its own."""
    noted(folder, 0.0, values)
    raise UnsendableError(7, "MPa")


def exiting(folder: str, values: Values) -> dict[str, bytes]:
    """Fail as a program's script does."""
    noted(folder, 0.0, values)
    sys.exit("no licence")


def full(values: Values) -> dict[str, bytes]:
    """Write on a full disk."""
    try:
        with Path("/dev/full").open("wb", buffering=0) as file:
            file.write(b"progress")
    except OSError as error:
        raise RuntimeError("cannot write") from error
    return result(values)


def runs_in(folder: Path) -> list[int]:
    """How often each seed was carried out."""
    return [len(path.read_text().split()) for path in sorted(folder.iterdir())]
