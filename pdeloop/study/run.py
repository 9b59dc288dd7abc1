# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Carries out a study, or continues it: trains what its folder does not have yet.

DIR/study.json                what was asked for
DIR/PROBLEM/VARIANT/SEED/     parameters.yaml, policy.npz, result.json of a finished training, with
                              `curves` also curve.npz (pdeloop.study.training.curve)
"""

from __future__ import annotations

import json
import shlex
import time
from collections.abc import Callable, Mapping
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    CancelledError,
    Executor,
    Future,
    ProcessPoolExecutor,
    wait,
)
from contextlib import AbstractContextManager
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from loop_interfaces.files import make_folder, read_json, write_atomically
from pde_sim_node.build import fingerprint
from pdeloop.study.description import Study, StudyError
from pdeloop.study.executors import no_worker
from pdeloop.study.training import EnvironmentMismatchError, environment, train_one
from pdeloop.training_run import load_compiled
from tuner_node.run_folder import RunFolder, parameter_changes

STUDY_FILE = "study.json"
ATTEMPTS = 3
"""Executors that may break, as when the system kills a process for its memory."""
POLL, WORKER_CHECK = 0.1, 2.0
"""Seconds between two calls of `tell`, and between two checks for workers while no task ends."""

Progress = Callable[[int, int, str], None]
Task = Callable[[Mapping[str, Any], Mapping[str, str] | None], dict[str, bytes]]
"""(resolved parameters, expected environment) -> content of each file, result.json the last."""
_NO_TASKS: Mapping[str, Task] = {}


class Failure(NamedTuple):
    """A training that cannot be carried out."""

    training: str
    reason: str


def write_study(folder: Path, study: Study) -> None:
    """Begin a study in `folder`. StudyError if there is another one, or it cannot be written."""
    if (folder / "parameters.yaml").exists():
        raise StudyError(f"{folder} holds a run; choose another folder")
    try:
        if (folder / STUDY_FILE).exists():
            if read_study(folder) != study:
                raise StudyError(
                    f"{folder} holds another study; choose another folder, or give "
                    f"--out {shlex.quote(str(folder))} alone to continue the one there"
                )
            return
        make_folder(folder)
        write_atomically(folder / STUDY_FILE, json.dumps(study.content(), indent=1).encode())
    except OSError as error:
        raise StudyError(f"cannot write to {folder}: {error.strerror}") from error


def read_study(folder: Path) -> Study:
    """The study in `folder`. StudyError if there is none."""
    try:
        return Study.of(read_json(folder / STUDY_FILE))
    except (OSError, ValueError, AttributeError) as error:
        raise StudyError(f"no study in {folder}: {STUDY_FILE} cannot be used ({error})") from error


def run(
    study: Study,
    folder: Path,
    executor: Callable[[], AbstractContextManager[Executor]],
    *,
    tasks: Mapping[str, Task] = _NO_TASKS,
    any_environment: bool = False,
    again: bool = False,
    tell: Progress = lambda done, total, status: None,
) -> list[Failure]:
    """Train what is not finished yet.

    Parameters
    ----------
    study : Study
        What to train.
    folder : Path
        Of the results; only this process writes there, the workers need no access to it.
    executor : callable
        Makes the `concurrent.futures.Executor` that runs the trainings, as a context manager
        (`pdeloop.study.executors`); called again if an executor breaks.
    tasks : dict of str to callable
        What is carried out instead of a training, by the variant's name. A worker must be able to
        import it, and its result.json have the entry `environment`.
    any_environment : bool
        Take results of workers with other versions or another processor, which may differ in the
        last bits; each result.json says which.
    again : bool
        Train anew where a finished training was made with other parameters or another plant than the
        study has now, which is refused otherwise.
    tell : callable
        Called with the number of trainings that are done, that of all, and what was done last.

    Returns
    -------
    list of Failure
        The trainings that cannot be carried out; all others are in `folder`.

    Raises
    ------
    StudyError
        The executor broke `ATTEMPTS` times, a worker has another environment, a finished training
        was made with something else than the study has now, or the folder cannot be written.
    """
    trainings = study.trainings()  # refuses before there is a folder
    expected = None if any_environment else environment()
    finished = {name for name in trainings if (folder / name / "result.json").exists()}
    known = {n: v for n, v in trainings.items() if n in finished and n.split("/")[1] not in tasks}
    if other := made_otherwise(folder, known):
        if not again:
            raise StudyError(_refusal(folder, other))
        finished -= set(other)
        for name in other:
            (folder / name / "result.json").unlink()
    if expected is not None:
        _check_finished(folder, finished, expected)
    train = partial(train_one, curves=study.curves)
    failures: list[Failure] = []
    for _ in range(ATTEMPTS):
        try:
            with executor() as pool:
                todo = {n: v for n, v in trainings.items() if n not in finished}
                if isinstance(pool, ProcessPoolExecutor):  # of this machine: once for all of them
                    different = {(v["equation"], v["optimizer"]): v for v in todo.values()}
                    for values in different.values():
                        load_compiled(values, fits=True)
                write_study(folder, study)  # not before there are workers
                waiting = {
                    pool.submit(tasks.get(n.split("/")[1], train), v, expected): n
                    for n, v in todo.items()
                }
                _collect(pool, waiting, folder, finished, failures, len(trainings), tell)
            return failures
        except (BrokenExecutor, CancelledError) as error:
            broken = error
    raise StudyError(
        f"the workers ended {ATTEMPTS} times before their trainings ({broken}); is there enough "
        f"memory? {len(finished)} of {len(trainings)} are done and kept in {folder}"
    )


def _collect(
    pool: Executor,
    waiting: dict[Future[dict[str, bytes]], str],
    folder: Path,
    finished: set[str],
    failures: list[Failure],
    total: int,
    tell: Progress,
) -> None:
    """Write every result as it comes."""
    status, lacking, check_at = "", "", time.monotonic() + WORKER_CHECK
    while waiting:
        tell(len(finished), total, lacking or status)
        done, _ = wait(waiting, timeout=POLL, return_when=FIRST_COMPLETED)
        if done or time.monotonic() > check_at:
            check_at = time.monotonic() + WORKER_CHECK
            lacking = no_worker(pool)
        for future in done:
            status = waiting.pop(future)
            try:
                files = future.result()
            except EnvironmentMismatchError as error:
                raise StudyError(
                    f"{error}: its results may differ in the last bits; install the same "
                    "everywhere, or accept them with --any-environment"
                ) from error
            except (BrokenExecutor, CancelledError):
                raise
            except (ValueError, RuntimeError) as error:
                failures.append(Failure(status, str(error)))
            except Exception as error:  # of a worker: no memory, no disk, no pdeloop, given up
                failures.append(Failure(status, f"{type(error).__name__}: {error}"))
            else:
                _write(folder / status, files)
            finished.add(status)
    tell(len(finished), total, status)


def _write(folder: Path, files: Mapping[str, bytes]) -> None:
    try:
        make_folder(folder)
        for name, content in files.items():  # result.json last: with it the training is finished
            write_atomically(folder / name, content)
    except OSError as error:
        raise StudyError(f"cannot write to {folder}: {error.strerror}") from error


def made_otherwise(folder: Path, trainings: Mapping[str, Mapping[str, Any]]) -> dict[str, str]:
    """What finished trainings in `folder` were made with, where that is not what is asked for.

    trainings: the resolved parameters that each is asked to have. Returns the differences in words.
    """
    plants: dict[str, int] = {}
    found = {}
    for name, values in trainings.items():
        whose = name.rpartition("/")[0]
        if whose not in plants:  # one for all seeds
            plants[whose] = fingerprint(values)
        run = RunFolder(folder / name)
        changes = parameter_changes(run.parameters(), values)
        if not changes and run.result().get("plant") != plants[whose]:
            changes = "another plant: its code or its data have changed"
        if changes:
            found[name] = changes
    return found


def _refusal(folder: Path, other: Mapping[str, str]) -> str:
    name, changes = next(iter(other.items()))
    more = f", and {len(other) - 1} more trainings differ" if len(other) > 1 else ""
    return (
        f"{folder / name} was not made with what the study has now ({changes}){more}; choose another "
        "folder, or train anew what differs with --again"
    )


def _check_finished(folder: Path, names: set[str], expected: Mapping[str, str]) -> None:
    """StudyError if a finished training was carried out in another environment."""
    for name in sorted(names):
        result: dict[str, Any] = read_json(folder / name / "result.json")
        if result.get("environment") != expected:
            raise StudyError(
                f"{folder / name} was trained with other versions or on another processor: the rest "
                "may differ from it in the last bits; continue there, or with --any-environment"
            )
