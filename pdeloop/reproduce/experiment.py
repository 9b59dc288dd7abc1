"""`pdeloop reproduce`: the paper's whole experiment, a process a core, and its table.

DIR/reproduction.json      what was asked for
DIR/PROBLEM/CONTROLLER     a run folder each: lqt_po, pure_po, gauss_newton (pdeloop.reproduce.job)
DIR/table.json             the figures of the table (pdeloop.reproduce.table)
"""

from __future__ import annotations

import json
import multiprocessing
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, wait
from pathlib import Path
from typing import Any

from rich.console import Console

from pdeloop.output import print_json
from pdeloop.progress import Progress
from pdeloop.reproduce.job import LEARNED, Job, run
from pdeloop.reproduce.table import PAPER, rows_of, text
from pdeloop.study import executors
from pdeloop.training_run import Interruption, interruptible
from tuner_node.results import RunFolderError, timestamp, versions

ASKED = "reproduction.json"
DEFAULTS = {"seeds": 6, "iterations": 40, "seed": 0}
"""As the paper."""


def asked(folder: Path) -> dict[str, Any]:
    """What the reproduction in `folder` was asked for."""
    try:
        content: dict[str, Any] = json.loads((folder / ASKED).read_text())
        return content
    except (OSError, ValueError) as error:
        raise RunFolderError(f"no reproduction in {folder}: {ASKED} cannot be read") from error


def reproduce(
    problems: Sequence[str],
    options: Mapping[str, Any],
    out: Path | None,
    processes: int | None,
    as_json: bool = False,
) -> int:
    """Run what is not done yet; returns the exit code.

    as_json: the table alone on stdout, as JSON; progress goes to stderr.
    """
    folder = out or Path("runs") / f"reproduce-{timestamp()}"
    jobs = _jobs(folder, problems, options)
    console = Console(stderr=as_json, highlight=False, soft_wrap=True)
    progress = Progress(console, "reproduce")
    started = time.monotonic()
    try:
        with interruptible():
            _run_all(jobs, processes, progress)
    except Interruption as signal_name:
        progress.close()
        console.print(
            f"stopped by {signal_name}; continue with: pdeloop reproduce --out {folder}",
            markup=False,
        )
        return 130
    finally:
        progress.close()
    rows = rows_of(folder, asked(folder)["problems"])
    (folder / "table.json").write_text(json.dumps({"rows": rows, "versions": versions()}, indent=1))
    if as_json:
        print_json({"folder": str(folder), "rows": rows})
        return 0
    console.print(text(rows), markup=False)
    console.print(
        f"{time.monotonic() - started:.0f} s; results in {folder} (figures: pdeloop report {folder})",
        markup=False,
    )
    return 0


def _jobs(folder: Path, problems: Sequence[str], options: Mapping[str, Any]) -> list[Job]:
    """The jobs of a new reproduction, or of the one in `folder`."""
    if (folder / ASKED).exists():
        content = asked(folder)
        known = {**content["options"], "problems": list(content["files"])}
        now = {**options, **({"problems": list(problems)} if problems else {})}
        changes = [
            f"{k}: {known.get(k)} there, {v} now" for k, v in now.items() if known.get(k) != v
        ]
        if changes:
            raise RunFolderError(
                f"the reproduction in {folder} was asked for something else "
                f"({'; '.join(changes)}); continue it with: pdeloop reproduce --out {folder}"
            )
    else:
        files, options = list(problems) or list(PAPER), {**DEFAULTS, **options}
        # The parameters of every job are resolved here, so that what is wrong is said at once.
        values = [Job(file, name, folder, options).values() for file in files for name in LEARNED]
        names = [value["problem"] for value in values[:: len(LEARNED)]]
        if len(set(names)) != len(files):
            raise RunFolderError(f"two of the problems have the same name: {', '.join(names)}")
        content = {"problems": names, "files": files, "options": dict(options)}
        try:
            folder.mkdir(parents=True, exist_ok=True)
            (folder / ASKED).write_text(json.dumps({**content, "versions": versions()}, indent=1))
        except OSError as error:
            raise RunFolderError(f"cannot write to {folder}: {error.strerror}") from error
    return [
        Job(file, controller, folder / name / controller, content["options"])
        for controller in reversed(LEARNED)  # Gauss-Newton takes longest
        for file, name in zip(content["files"], content["problems"], strict=True)
    ]


def _run_all(jobs: Sequence[Job], processes: int | None, progress: Progress) -> None:
    """Run what is not done, in processes of their own.

    An interruption ends the processes at once: what they were at begins again when it is continued.
    """
    shares: Any = multiprocessing.get_context("spawn").Array("d", [float(job.done) for job in jobs])
    with executors.processes(processes, _share, shares) as pool:
        waiting = {pool.submit(_work, i, job) for i, job in enumerate(jobs) if not job.done}
        while waiting:
            done, waiting = wait(waiting, timeout=0.1, return_when=FIRST_COMPLETED)
            for future in done:
                future.result()
            progress.tell(sum(shares) / len(shares))


_SHARES: list[Any] = []
"""In the process of a job: the share of each job that is done."""


def _share(shares: Any) -> None:
    """In a process that is about to run jobs."""
    _SHARES[:] = [shares]


def _work(index: int, job: Job) -> None:
    def tell(share: float) -> None:
        _SHARES[0][index] = share

    try:
        run(job, tell)
    except (ValueError, RuntimeError, OSError) as error:
        raise RunFolderError(f"{job.folder}: {error}") from error
    tell(1.0)
