# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""`pdeloop study`."""

from __future__ import annotations

import argparse
import fnmatch
import importlib.util
import json
import shlex
import sys
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pdeloop.commands import common
from pdeloop.commands.settings import add_set, read_settings
from pdeloop.messages.spec import ParameterError
from pdeloop.output import print_json

TLS = {
    "--tls-ca-file": ("tls_ca_file", "certificate of the authority"),
    "--tls-cert": ("tls_client_cert", "certificate of this client"),
    "--tls-key": ("tls_client_key", "its private key"),
}
"""Flags for an encrypted scheduler: the name in `distributed.Security`, and what the file is."""
WORKER_DEATHS = 20
"""Default of --worker-deaths."""

if TYPE_CHECKING:
    from pdeloop.study import Study


def add(commands: common.Commands) -> None:
    """The command `study`."""
    study = common.command(
        commands,
        "study",
        _study,
        help="run many trainings (problems, variants, seeds) on this machine or a cluster",
        description="Train every problem of a study with every variant and every seed, each in a "
        "process of its own, and compare them. Ctrl-C interrupts; --out DIR of an interrupted study "
        "continues it. `status DIR` says how far one is. docs/scaling.md shows a study's file.",
        example="pdeloop study examples/study.yaml --out runs/study",
    )
    study.add_argument(
        "words",
        nargs="*",
        type=common.a_path,
        metavar="STUDY.yaml",
        help="file with problems, seeds, variants and settings; or `status DIR`: how far the study in "
        "DIR is, while it is carried out or later",
    )
    add_set(study, "any parameter, for all trainings")
    common.add_own_code(study)

    add_execution(study)


def add_execution(parser: argparse.ArgumentParser) -> None:
    """The options for where a study's trainings run, and for output; see `carry_out`."""
    name, add = parser.prog.rpartition(" ")[2], parser.add_argument
    add(
        "--out", type=common.a_path, metavar="DIR", help=f"folder of the results [runs/{name}-TIME]"
    )
    add(
        "--processes",
        type=int,
        metavar="N",
        help="number of trainings at the same time [one per core]",
    )
    add(
        "--scheduler",
        metavar="ADDRESS",
        help="train on the workers of this Dask scheduler (tcp://HOST:PORT) instead",
    )
    for flag, (_, what) in TLS.items():
        add(
            flag,
            type=common.a_path,
            metavar="FILE",
            help=f"{what}, for a scheduler tls://HOST:PORT",
        )
    add(
        "--worker-deaths",
        type=int,
        default=WORKER_DEATHS,
        metavar="N",
        help=f"workers that one training may lose before it counts as failed [{WORKER_DEATHS}]",
    )
    add(
        "--run-folders",
        nargs="?",
        const="*",
        metavar="PATTERN",
        help="also write the run folders DIR/PROBLEM/VARIANT/SEED of these trainings [all]",
    )
    add(
        "--any-environment",
        action="store_true",
        help="also accept results of workers with other versions or another processor, which may "
        "differ in the last bits",
    )
    add(
        "--again",
        action="store_true",
        help="train anew what has failed, and what was made with other parameters or another plant "
        "than the study has now",
    )
    common.add_json(parser, "print the table as JSON; progress goes to stderr")


def carry_out(
    name: str,
    options: argparse.Namespace,
    study_in: Callable[[Path], Study],
    remarks: Callable[[Sequence[Mapping[str, Any]]], list[str]] = lambda rows: [],
) -> int:
    """Train what is missing, as the flags of `add_execution` say; returns the exit code.

    name: of the command; study_in: the study for a folder; remarks: lines that follow the table,
    from its rows.
    """
    from pdeloop.display import Progress, StreamConsole
    from pdeloop.interruption import interruptible
    from pdeloop.messages.files import write_atomically
    from pdeloop.study.executors import local_workers
    from pdeloop.study.results import reading
    from pdeloop.study.run import run
    from pdeloop.study.table import plot, rows, text
    from tuner_node.results import versions
    from tuner_node.run_folder import timestamp

    if options.processes is not None and (options.processes < 1 or options.scheduler is not None):
        raise ParameterError(
            "--processes is the number of trainings at a time on this machine; expected at least "
            "1, without --scheduler"
        )
    given = {flag: getattr(options, flag[2:].replace("-", "_")) for flag in TLS}
    security = {TLS[flag][0]: str(path) for flag, path in given.items() if path is not None}
    if security and (len(security) < len(TLS) or options.scheduler is None):
        raise ParameterError(f"expected --scheduler and all of {', '.join(TLS)}, or none of these")
    if options.worker_deaths < 1:
        raise ParameterError("--worker-deaths is the most of a training; expected at least 1")
    folder: Path = options.out or Path("runs") / f"{name}-{timestamp()}"
    study = study_in(folder)
    console = StreamConsole(sys.stderr if options.json else sys.stdout)
    progress = Progress(console, name, "trainings")
    if options.scheduler is not None:
        from pdeloop.study.cluster import cluster

        executor = partial(cluster, options.scheduler, security)
    else:
        executor = partial(local_workers, options.processes)
    try:
        with interruptible(_continuing(name, folder, options)):
            failures = run(
                study,
                folder,
                executor,
                any_environment=options.any_environment,
                again=options.again,
                most_deaths=options.worker_deaths,
                tell=progress.tell,
            )
    finally:
        progress.close()
    if options.run_folders is not None:
        with reading(folder) as results:
            for name in fnmatch.filter(sorted(results.names()), options.run_folders):
                results.extract(name, folder)
    table = rows(study, folder)
    content = json.dumps({"rows": table, "versions": versions()}, indent=1)
    write_atomically(folder / "table.json", content.encode())
    if table and importlib.util.find_spec("matplotlib"):
        write_atomically(folder / "costs.png", plot(table))
    if options.json:
        told = [failure._asdict() for failure in failures]
        print_json({"folder": str(folder), "rows": table, "failures": told})
    elif table:
        console.print("\n".join([text(table), *remarks(table)]), markup=False)
    for failure in failures:
        console.print(f"failed: {failure.training}: {failure.reason}", markup=False)
    console.print(f"results in {folder}", markup=False)
    return int(bool(failures))


def _continuing(name: str, folder: Path, options: argparse.Namespace) -> str:
    """The command that continues what was begun with these options, where and with the code it was."""
    words = ["pdeloop", name, "--out", str(folder)]
    flags = *("--equation", "--plant", "--optimizer", "--law"), "--processes", "--scheduler", *TLS
    for flag in flags:
        value = getattr(options, flag[2:].replace("-", "_"), None)
        words += [] if value is None else [flag, str(value)]
    if options.worker_deaths != WORKER_DEATHS:
        words += ["--worker-deaths", str(options.worker_deaths)]
    return shlex.join([*words, *["--any-environment"] * options.any_environment])


def _study(options: argparse.Namespace) -> int:
    from pdeloop.messages.spec import read_document
    from pdeloop.study.description import Study
    from pdeloop.study.results import read_study

    words: list[Path] = options.words
    if len(words) == 2 and str(words[0]) == "status":
        return _status(words[1], options.json)
    if len(words) > 1:
        options.refuse("expected one file, or: status DIR")
    file = words[0] if words else None
    common.allow_own_code(options)
    if file is None and options.out is None:
        raise ParameterError(
            "no study given; expected a YAML file, or --out DIR of one to continue"
        )

    settings = read_settings(options.set)
    if file is None and settings:
        raise ParameterError(
            "--out DIR alone continues a study with its own parameters; leave out --set"
        )

    def study_in(folder: Path) -> Study:
        if file is None:
            return read_study(folder)
        return Study.of(read_document(file), file.parent).having(settings)

    return carry_out("study", options, study_in)


def _status(folder: Path, as_json: bool) -> int:
    from pdeloop.study.table import status, status_text, text

    found = status(folder)
    if as_json:
        print_json(found)
    else:
        print("\n".join(status_text(found)))
        if found["rows"]:
            print(f"\n{text(found['rows'])}")
    return 0
