"""`pdeloop study`."""

from __future__ import annotations

import argparse
from functools import partial
from pathlib import Path

from pdeloop.commands.common import Commands, add_json, command


def add(commands: Commands) -> None:
    """The command `study`."""
    study = command(
        commands,
        "study",
        _study,
        help="many trainings, problems by variants by seeds, on this machine or a cluster, a table",
        description="Train every problem of a study with every variant and every seed, each in a "
        "process of its own, and compare them. Ctrl-C interrupts; --out DIR of an interrupted study "
        "continues it. docs/scaling.md shows a study's file.",
        example="pdeloop study examples/study.yaml --out runs/study",
    )
    add = study.add_argument
    add(
        "file",
        nargs="?",
        type=Path,
        metavar="STUDY.yaml",
        help="problems, seeds, variants, settings",
    )
    add("--out", type=Path, metavar="DIR", help="folder of the results [runs/study-TIME]")
    add("--processes", type=int, metavar="N", help="trainings at the same time [one a core]")
    add(
        "--scheduler",
        metavar="ADDRESS",
        help="train on the workers of this Dask scheduler (tcp://HOST:PORT) instead",
    )
    add(
        "--any-environment",
        action="store_true",
        help="also take results of workers with other versions or another processor, which may differ "
        "in the last bits",
    )
    add_json(study, "print the table as JSON; progress goes to stderr")


def _study(options: argparse.Namespace) -> int:
    from rich.console import Console

    from loop_interfaces.spec import ParameterError, read_document
    from pdeloop.output import print_json
    from pdeloop.progress import Progress
    from pdeloop.study.description import Study
    from pdeloop.study.executors import cluster, processes
    from pdeloop.study.run import kept, run
    from pdeloop.study.table import plot, rows, text
    from pdeloop.training_run import Interruption, interruptible
    from tuner_node.results import timestamp

    if options.processes is not None and (options.processes < 1 or options.scheduler):
        raise ParameterError(
            "--processes is how many trainings run on this machine: expected at least 1, and no "
            "--scheduler"
        )
    if options.file is None and options.out is None:
        raise ParameterError(
            "no study given; expected a YAML file, or --out DIR of one to continue"
        )
    folder: Path = options.out or Path("runs") / f"study-{timestamp()}"
    if options.file is None:
        study = kept(folder)
    else:
        study = Study.of(read_document(options.file), options.file.parent)
    console = Console(stderr=options.json, highlight=False, soft_wrap=True)
    progress = Progress(console, "study", "trainings")
    executor = (
        partial(cluster, options.scheduler)
        if options.scheduler
        else partial(processes, options.processes)
    )
    try:
        with interruptible():
            failures = run(
                study,
                folder,
                executor,
                any_environment=options.any_environment,
                tell=progress.tell,
            )
    except Interruption as signal_name:
        progress.close()
        console.print(
            f"stopped by {signal_name}; continue with: pdeloop study --out {folder}", markup=False
        )
        return 130
    finally:
        progress.close()
    table = rows(study, folder)
    if options.json:
        print_json(
            {"folder": str(folder), "rows": table, "failures": [f._asdict() for f in failures]}
        )
    else:
        console.print(text(table), markup=False)
        plot(table, folder / "costs.png")
        console.print(f"results in {folder}, figure in {folder / 'costs.png'}", markup=False)
    for failure in failures:
        console.print(f"failed: {failure.training}: {failure.reason}", markup=False)
    return int(bool(failures))
