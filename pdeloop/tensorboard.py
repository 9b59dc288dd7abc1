# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The curves of a finished run as event files of TensorBoard."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Iterator
from pathlib import Path

from tensorboardX import SummaryWriter

from pdeloop.finished_run import FinishedRun
from pdeloop.messages.files import writing_to
from pdeloop.messages.spec import ParameterError

_IDS = ("event", "seed", "rollouts")
"""Entries that identify a row of the history."""


def scalars(run: FinishedRun, m: int) -> Iterator[tuple[str, float, int]]:
    """Name, value and rollouts so far of each number of a seed's optimisation and evaluation.

    m: number of the seed among those of the run.
    """
    rollouts = 0
    for row in run.result["history"]:
        if row.get("event") != "adapted" or row["seed"] != run.seeds[m]:
            continue
        rollouts = int(row["rollouts"])
        for name, value in row.items():
            if name not in _IDS and isinstance(value, int | float) and math.isfinite(value):
                yield f"adapt/{name}", float(value), rollouts
    for name, costs in run.costs.items():
        yield f"evaluate/{name}", float(costs[m].mean()), rollouts


def write_events(run: FinishedRun, folder: Path) -> None:
    """Write a new folder, with a folder of event files in it for each seed.

    ParameterError if there is a folder already, where TensorBoard would mix two curves, or if it cannot
    be written; nothing is left then.
    """
    if folder.exists() or folder.is_symlink():
        raise ParameterError(f"{folder} exists; expected a new folder")
    with (
        writing_to(folder, ParameterError),
        tempfile.TemporaryDirectory(dir=folder.parent) as parent,
    ):
        whole = Path(parent) / "events"
        for m, seed in enumerate(run.seeds):
            with SummaryWriter(str(whole / f"seed{seed}")) as writer:
                for name, value, rollouts in scalars(run, m):
                    writer.add_scalar(name, value, rollouts)
        whole.rename(folder)
