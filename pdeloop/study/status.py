# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""How far a study is, from its results while they grow."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pdeloop.study.results import is_worked_on, read_study, reading
from pdeloop.study.table import finished, table

RECENT = 100
"""Trainings from whose times of ending the rate follows."""
SHOWN = 5
"""Failures that are named."""


def status(folder: Path) -> dict[str, Any]:
    """How far the study in `folder` is.

    Returns
    -------
    dict
        `total`, `finished` and `failed` trainings; the `workers_lost` and the trainings that have
        lost most, `deaths`; `running`: whether a process carries the study out; the
        `rate_per_minute` of the last trainings and the `minutes_left`, None where they are not
        known; `failures`, by training; the `rows` of the table so far.

    Raises
    ------
    StudyError
        There is no study.
    """
    study = read_study(folder)
    failures: dict[str, str] = {}
    deaths: Counter[str] = Counter()
    ended: list[float] = []
    with reading(folder) as results, results.unchanged():
        trainings = [*results.rows("name, ended, failure, deaths", "1")]
        known = finished(results)
    for row in trainings:
        deaths[row["name"]] = row["deaths"]
        if row["failure"] is not None:
            failures[row["name"]] = row["failure"]
        if row["ended"] is not None:
            ended.append(row["ended"])
    total = len(study.problems) * len(study.variants) * len(study.seeds)
    running = is_worked_on(folder)
    recent = ended[-RECENT:]
    rate = None
    if running and len(recent) > 1:
        rate = 60 * (len(recent) - 1) / max(time.time() - recent[0], 1e-3)
    return {
        "folder": str(folder),
        "total": total,
        "finished": len(ended) - len(failures),
        "failed": len(failures),
        "running": running,
        "rate_per_minute": rate,
        "minutes_left": None if rate is None else (total - len(ended)) / rate,
        "workers_lost": deaths.total(),
        "deaths": {name: count for name, count in deaths.most_common(SHOWN) if count},
        "failures": failures,
        "rows": table(study, known),
    }


def status_text(found: Mapping[str, Any]) -> list[str]:
    """The lines of a status for a terminal."""
    done = f"{found['finished']} of {found['total']} trainings are finished"
    failed = f", {found['failed']} failed" if found["failed"] else ""
    lines = [done + failed + ("" if found["running"] else "; no process is working on them")]
    if found["rate_per_minute"] is not None:
        left = found["minutes_left"]
        lines.append(f"{found['rate_per_minute']:.3g} a minute, {left:.0f} min left")
    if found["workers_lost"]:
        most = ", ".join(f"{name} {count}" for name, count in found["deaths"].items())
        lines.append(f"{found['workers_lost']} workers were lost, most by {most}")
    failures = [*found["failures"].items()]
    lines += [f"failed: {name}: {reason}" for name, reason in failures[:SHOWN]]
    if len(failures) > SHOWN:
        lines.append(f"and {len(failures) - SHOWN} more, which --json has")
    return lines
