# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Carries out a study, or continues it: trains what its folder does not have yet.

The folder's files: pdeloop.study.results.
"""

from __future__ import annotations

import errno
import hashlib
import json
import platform
import shlex
import shutil
import time
from collections import Counter, defaultdict, deque
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import BrokenExecutor, CancelledError, Executor, Future
from contextlib import AbstractContextManager, ExitStack, contextmanager
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

from pde_sim_node.build import fingerprint
from pdeloop.study.description import Study, StudyError
from pdeloop.study.executors import (
    LINES,
    MOST_DEATHS,
    Death,
    Deaths,
    LostWorkerError,
    Processes,
    Workers,
)
from pdeloop.study.results import STUDY_FILE, UNFINISHED, Ended, Results, made_with, writing
from pdeloop.study.training import CURVE, FILES, Place, code_of, differences, train_one
from pdeloop.training_run import load_compiled
from tuner_node.run_folder import RunFolder, RunFolderError, parameter_changes

ATTEMPTS = 3
"""Executors in a row that may break without a result, as when one cannot start its workers."""
POLL = 0.1
"""Seconds between two calls of `tell`."""

Progress = Callable[[int, int, str], None]
Files = Mapping[str, bytes]
Task = Callable[[Mapping[str, Any]], Files]
"""(resolved parameters) -> content of each file, result.json among them."""
Pool = Callable[[], AbstractContextManager[Executor | Workers]]
_NO_TASKS: Mapping[str, Task] = {}
_COLUMNS = "name, problem, seed, failure, deaths, plant, parameters, environment"


class Failure(NamedTuple):
    """A training that cannot be carried out."""

    training: str
    reason: str


def run(
    study: Study,
    folder: Path,
    executor: Pool,
    *,
    tasks: Mapping[str, Task] = _NO_TASKS,
    any_environment: bool = False,
    again: bool = False,
    most_deaths: int = MOST_DEATHS,
    tell: Progress = lambda done, total, status: None,
) -> list[Failure]:
    """Train what is not finished yet.

    Parameters
    ----------
    study : Study
        What to train.
    folder : Path
        Of the results; only this process writes them, the workers need no access to it. Those that
        have it continue what others have begun.
    executor : callable
        Makes the `concurrent.futures.Executor` that runs the trainings, or the
        `pdeloop.study.executors.Workers`, as a context manager; called again if an executor breaks.
    tasks : dict of str to callable
        What is carried out instead of a training, by the variant's name. A worker must be able to
        import it, and its result.json have the entry `environment`.
    any_environment : bool
        Take results of workers with other versions or another processor, which may differ in the
        last bits; each result.json says which.
    again : bool
        Train anew what has failed, and what was made with other parameters or another plant than the
        study has now, which is refused otherwise.
    most_deaths : int
        Workers that one training may lose.
    tell : callable
        Called with the number of trainings that are done, that of all, and a few words.

    Returns
    -------
    list of Failure
        The trainings that cannot be carried out; all others are in `folder`.

    Raises
    ------
    StudyError
        The executor broke `ATTEMPTS` times without a result, workers have different environments, a
        finished training was made with something else than the study has now, another process
        works on the study, or the folder cannot be written.
    """
    trainings = study.trainings()  # refuses before there is a folder
    with ExitStack() as stack:
        driver: _Driver | None = None

        def begun() -> _Driver:
            results = stack.enter_context(writing(folder, study))
            how = (any_environment, again, most_deaths)
            return _Driver(study, trainings, results, tasks, tell, *how)

        if (folder / STUDY_FILE).exists():
            driver = begun()
        attempts = 0
        while not driver or driver.done < len(trainings):
            before = driver.done if driver else 0
            try:
                with _kept(executor, driver, folder) as pool:
                    driver = driver or begun()  # no folder before there are workers
                    driver.carry_out(pool if isinstance(pool, Workers) else Workers(pool))
            except (BrokenExecutor, CancelledError) as error:
                attempts = 0 if driver and driver.done > before else attempts + 1
                if attempts == ATTEMPTS:
                    done = driver.done if driver else 0
                    raise StudyError(
                        f"the workers ended {ATTEMPTS} times before their trainings ({error}); is "
                        f"there enough memory? {done} of {len(trainings)} are done and kept in {folder}"
                    ) from error
        tell(len(trainings), len(trainings), "")
        return driver.failures()


@contextmanager
def _kept(executor: Pool, driver: _Driver | None, folder: Path) -> Iterator[Executor | Workers]:
    """The executor; where it cannot be made again, the error says what is kept."""
    with ExitStack() as stack:
        try:
            pool = stack.enter_context(executor())
        except StudyError as error:
            if driver is None:
                raise
            raise StudyError(
                f"{error}; {driver.done} trainings are kept in {folder}, which "
                f"`pdeloop study --out {shlex.quote(str(folder))}` continues"
            ) from error
        yield pool


class _Driver:
    """What one process knows of a study that it carries out."""

    def __init__(
        self,
        study: Study,
        trainings: Mapping[str, Mapping[str, Any]],
        results: Results,
        tasks: Mapping[str, Task],
        tell: Progress,
        any_environment: bool,
        again: bool,
        most_deaths: int,
    ) -> None:
        self._trainings, self._results, self._tasks, self._tell = trainings, results, tasks, tell
        self._study, self._root = results.study_id, str((results.folder / UNFINISHED).resolve())
        self._train = partial(train_one, curves=study.curves)
        self._files = (CURVE, *FILES) if study.curves else FILES
        self._deaths = Deaths(most_deaths)
        self._environments = Environments(any_environment)
        self._plants: dict[str, int] = {}
        self._identities: dict[str, str] = {}
        self._finished: set[str] = set()
        self._failures: dict[str, str] = {}
        self._began = time.monotonic()
        self._ended_here = 0
        self._read(again)

    @property
    def done(self) -> int:
        """The trainings that have ended."""
        return len(self._finished)

    def failures(self) -> list[Failure]:
        """Those that cannot be carried out, in the order of the study."""
        failed = self._failures
        return [Failure(name, failed[name]) for name in self._trainings if name in failed]

    def _read(self, again: bool) -> None:
        """Know what is finished, and refuse what was made otherwise."""
        other: dict[str, str] = {}
        for row in self._results.rows(_COLUMNS, "1"):
            name = row["name"]
            if row["deaths"]:
                self._deaths.known(name, row["deaths"])
            if name not in self._trainings or row["parameters"] is None:
                continue
            changes = self._changes(name, json.loads(row["parameters"]), row["plant"])
            if row["failure"] is not None:
                if again or changes:
                    continue
                self._failures[name] = row["failure"]
            elif changes:
                other[name] = changes
                continue
            else:
                self._environments.know(name, json.loads(row["environment"]))
            self._finished.add(name)
        found = self._in_folders(other)
        if other and not again:
            raise StudyError(_refusal(self._results.folder, other))
        self._results.forget(other)
        self._results.add(found)
        self._finished |= {one.name for one in found}

    def _in_folders(self, other: dict[str, str]) -> list[Ended]:
        """Trainings that have only a run folder: finished when no driver was there, or by hand."""
        found = []
        folder = self._results.folder
        for name in self._trainings:
            if name in self._finished or self._task(name) is not None:
                continue
            for place in (folder / UNFINISHED / name, folder / name):
                if (place / FILES[-1]).exists():
                    run = RunFolder(place)
                    try:
                        result, _ = run.result(), run.policies()
                        changes = self._changes(name, run.parameters(), made_with(result))
                        files = {each: (place / each).read_bytes() for each in self._files}
                    except (RunFolderError, OSError):
                        continue  # half copied, or damaged: it is trained anew
                    if changes and place == folder / name:
                        other[name] = changes
                    if not changes:
                        self._environments.know(name, result.get("environment", {}))
                        found.append(Ended.well(name, self._trainings[name], files))
                        break
        return found

    def _changes(self, name: str, known: Mapping[str, Any], plant: int | None) -> str:
        """How a training was made otherwise than it is asked for now, in words; empty: it was not."""
        if changes := parameter_changes(known, self._trainings[name]):
            return changes
        if plant is not None and plant != self._plant(name):
            values = self._trainings[name]
            further = "".join(
                f", or the {word}" for word in ("law", "optimizer") if ":" in values[word]
            )
            return f"another plant{further}: its code or its data have changed"
        return ""

    def _plant(self, name: str) -> int:
        whose = name.rpartition("/")[0]
        if whose not in self._plants:  # one for all seeds
            values = self._trainings[name]
            own = code_of(values) if self._task(name) is None else 0
            self._plants[whose] = fingerprint(values) ^ own
        return self._plants[whose]

    def _identity(self, name: str) -> str:
        """Of what a training is made with, but its seed, which is in its name."""
        whose = name.rpartition("/")[0]
        if whose not in self._identities:
            content = [{**self._trainings[name], "seed": None}, self._plant(name)]
            text = json.dumps(content, sort_keys=True)
            self._identities[whose] = hashlib.sha256(text.encode()).hexdigest()[:16]
        return self._identities[whose]

    def _task(self, name: str) -> Task | None:
        return self._tasks.get(name.split("/")[1])

    def carry_out(self, workers: Workers) -> None:
        """Train what is missing."""
        todo = Todo([name for name in self._trainings if name not in self._finished])
        self._environments.begin(workers.environments)
        workers.begin(self._study)
        for name, kind in workers.left().items():
            self._environments.prefer(name, kind)
        if isinstance(workers, Processes):  # of this machine: once for all of them
            heads = {name.rpartition("/")[0]: name for name in todo.names}
            each = [self._trainings[name] for name in heads.values()]
            for values in {(v["equation"], v["optimizer"]): v for v in each}.values():
                load_compiled(values, fits=True)
        waiting: dict[str, str] = {}  # its kind of worker, by training
        ended: list[Ended] = []
        try:
            while todo or waiting:
                given = Counter(waiting.values())
                windows = {kind: workers.window(kind) for kind in self._environments.kinds(workers)}
                for kind, window in windows.items():
                    for name in todo.taken(window - given[kind], kind, self._environments.kind_of):
                        self._submit(workers, name, kind)
                        waiting[name] = kind
                if todo and not waiting and not workers.grows:
                    raise StudyError(self._environments.lacking(todo.names[0]))
                self._keep(ended)  # when the workers have something to do
                ended.clear()
                workers.settle()
                idle = [name for name, kind in waiting.items() if not windows.get(kind)]
                if not waiting:
                    idle = todo.names[:1]
                lacking = (
                    self._environments.lacking(idle[0]) if idle and any(windows.values()) else ""
                )
                self._tell(self.done, len(self._trainings), self._status(workers, lacking))
                for name, future in workers.collect(POLL):
                    kind = waiting.pop(name)
                    one = self._outcome(name, future)
                    if one is None:
                        todo.put_back(name, kind)
                    else:
                        ended.append(one)
                        self._deaths.ended(name)
                for death in workers.deaths():
                    reason = self._died(death)
                    if not reason:
                        continue
                    if waiting.pop(death.name, None) is not None:
                        workers.take_back(death.name)
                    elif not todo.without(death.name):
                        continue
                    ended.append(Ended.failed(death.name, self._trainings[death.name], reason))
        finally:
            self._keep(ended)

    def _died(self, death: Death) -> str:
        """Count a death; why its training is given up, empty: it is not."""
        rows = death.progress or self._progress(death.name)
        reason = self._deaths.died(death.name, rows, announced=death.announced)
        self._results.died(death.name, self._deaths.of(death.name))
        return reason

    def _submit(self, workers: Workers, name: str, kind: str) -> None:
        values, task, identity = self._trainings[name], self._task(name), self._identity(name)
        if task is not None:
            workers.submit(name, kind, identity, ended_well, name, values, task)
            return
        place = Place(self._root, self._study, name)
        workers.submit(name, kind, identity, ended_well, name, values, self._train, place)

    def _outcome(self, name: str, future: Future[Ended]) -> Ended | None:
        """How a training has ended; None: it has to be submitted again."""
        try:
            one = future.result()
        except LostWorkerError:
            return None
        except (BrokenExecutor, CancelledError):
            raise
        except FullDiskError as error:
            raise StudyError(
                f"{name} cannot be carried out: {error}; free some space there, and continue with "
                f"`pdeloop study --out {shlex.quote(str(self._results.folder))}`"
            ) from error
        except Exception as error:  # of the executor, such as a result that cannot be sent
            return Ended.failed(name, self._trainings[name], f"{type(error).__name__}: {error}")
        if one.row["failure"] is not None:
            return one
        self._environments.require(name, json.loads(one.row["environment"]))
        if (plant := one.row["plant"]) is not None and plant != self._plant(name):
            raise StudyError(
                f"a worker has another plant for {name} than this machine: the code or the data of the "
                "plant differ; have the same on all"
            )
        return one

    def _keep(self, ended: list[Ended]) -> None:
        if not ended:
            return
        self._results.add(ended)
        self._ended_here += len(ended)
        folder = self._results.folder
        for one in ended:
            self._finished.add(one.name)
            place = folder / UNFINISHED / one.name
            if one.row["failure"] is not None:
                self._failures[one.name] = one.row["failure"]
                if place.is_dir() and not (folder / one.name).exists():
                    (folder / one.name).parent.mkdir(parents=True, exist_ok=True)
                    place.rename(folder / one.name)
            if place.is_dir():
                shutil.rmtree(place, ignore_errors=True)

    def _progress(self, name: str) -> list[Mapping[str, Any]]:
        """The last rows that a training has left in its folder."""
        path = self._results.folder / UNFINISHED / name / "progress.jsonl"
        try:
            lines = path.read_bytes()[-4096:].splitlines()[-LINES:]
            return [json.loads(line) for line in lines if line.startswith(b"{")]
        except (OSError, ValueError):
            return []

    def _status(self, workers: Workers, lacking: str) -> str:
        minutes = (time.monotonic() - self._began) / 60
        words = []
        if self._ended_here:
            rate = self._ended_here / minutes
            left = (len(self._trainings) - self.done) / rate
            words.append(f"{rate:.3g} a minute, {left:.0f} min left")
        if self._failures:
            words.append(f"{len(self._failures)} failed")
        if self._deaths.total:
            words.append(f"{self._deaths.total} workers lost")
        remarks = [self._environments.remark(), workers.remark(), lacking]
        return ", ".join([*words, *filter(None, remarks)])


def ended_well(
    name: str, values: Mapping[str, Any], task: Callable[..., Files], *arguments: Any
) -> Ended:
    """Carry out a task, and do on its worker what would occupy the driver of many.

    What it raises becomes a failure here: another process may not know the exception's type, or take a
    SystemExit for its own. FullDiskError, which is no fault of the training, where no space is left.
    """
    try:
        return Ended.well(name, values, task(values, *arguments))
    except (Exception, SystemExit) as error:
        cause: BaseException | None = error
        while cause is not None:
            if isinstance(cause, OSError) and cause.errno in (errno.ENOSPC, errno.EDQUOT):
                raise FullDiskError(f"{cause} on {platform.node()}") from None
            cause = cause.__cause__
        plain = isinstance(error, ValueError | RuntimeError)
        why = str(error) if plain else f"{type(error).__name__}: {error}"
        return Ended.failed(name, values, why)


class FullDiskError(Exception):
    """A worker has no space left."""


class Todo:
    """The trainings that are not submitted yet, in the order of the study, by kind of worker."""

    def __init__(self, names: list[str]) -> None:
        self._any = deque(names)
        self._own: dict[str, deque[str]] = defaultdict(deque)  # by kind

    def __bool__(self) -> bool:
        return bool(self._any or any(self._own.values()))

    @property
    def names(self) -> list[str]:
        return [*chain(*self._own.values(), self._any)]

    def taken(self, count: int, kind: str, kind_of: Callable[[str, str], str]) -> Iterator[str]:
        """Take so many for workers of a kind; `kind_of` (name, kind) is the one that it needs."""
        own = self._own[kind]
        while count > 0 and (own or self._any):
            name = own.popleft() if own else self._any.popleft()
            if (needed := kind_of(name, kind)) == kind:
                count -= 1
                yield name
            else:
                self._own[needed].append(name)

    def put_back(self, name: str, kind: str) -> None:
        """It was taken for this kind, and is the first again."""
        self._own[kind].appendleft(name)

    def without(self, name: str) -> bool:
        """Take this one out; whether it was there."""
        for names in (*self._own.values(), self._any):
            if name in names:
                names.remove(name)
                return True
        return False


class Environments:
    """The environments of workers, which are compared with each other.

    All have the same versions. The trainings of a problem and a seed are compared with each other, so
    they are carried out on one kind of processor.
    """

    def __init__(self, anything: bool) -> None:
        self._anything = anything
        self._versions: dict[str, str] | None = None
        self._kinds: dict[tuple[str, str], str] = {}
        self._workers: Mapping[str, Mapping[str, str]] = {}
        self._fit: list[str] = []

    def know(self, name: str, environment: Mapping[str, str]) -> None:
        """A training was carried out in this environment, before."""
        versions, kind = _split(environment)
        self._versions = versions if self._versions is None else self._versions
        if not self._anything and (other := differences(versions, self._versions)):
            raise StudyError(f"{name} was trained with {other}: {_OTHER}")
        self.prefer(name, kind)

    def prefer(self, name: str, kind: str) -> None:
        """Carry out this training, and those that are compared with it, on this kind if on no other."""
        self._kinds.setdefault(_group(name), kind)

    def begin(self, workers: Mapping[str, Mapping[str, str]]) -> None:
        """These are the workers' environments, by kind. StudyError unless the versions are the same."""
        for environment in workers.values():
            if not self._anything:
                self._same_versions(_split(environment)[0])

    def kinds(self, workers: Workers) -> list[str]:
        """The kinds of workers that may carry out trainings; "" is any. Others may have come by now."""
        if self._anything or not (workers.environments or workers.grows):
            return [""]
        self._workers, self._fit = workers.environments, []
        for kind, environment in self._workers.items():
            versions, _ = _split(environment)
            self._versions = self._versions or versions
            if versions == self._versions:
                self._fit.append(kind)
        return self._fit

    def kind_of(self, name: str, offered: str) -> str:
        """The kind that carries out a training: where it has none yet, the one that is offered."""
        return self._kinds.setdefault(_group(name), offered) if offered else ""

    def lacking(self, name: str) -> str:
        """Why a training cannot be carried out, where no worker of its kind can come."""
        problem, seed = _group(name)
        kind = self._kinds.get((problem, seed), "of its own")
        return (
            f"other trainings of seed {seed} of {problem} were carried out on a processor {kind}, "
            "which no worker has: start one that has it, or accept results that may differ in the last "
            "bits with --any-environment"
        )

    def remark(self) -> str:
        """What is to be said of workers that differ."""
        words = []
        if len(self._fit) > 1:
            words.append(
                f"workers have different processors ({', '.join(self._fit)}), so the trainings of a "
                "seed of a problem stay on one kind"
            )
        for kind in self._workers:
            if kind not in self._fit:
                other = differences(_split(self._workers[kind])[0], self._versions or {})
                words.append(f"a worker that came later has {other}, and gets no trainings")
        return ", ".join(words)

    def require(self, name: str, environment: Mapping[str, str]) -> None:
        """StudyError unless this environment of a result is that of the others."""
        if self._anything:
            return
        versions, kind = _split(environment)
        self._same_versions(versions)
        known = self._kinds.setdefault(_group(name), kind)
        if kind != known:
            raise StudyError(f"a worker has the processor {kind} instead of {known}: {_OTHER}")

    def _same_versions(self, versions: dict[str, str]) -> None:
        self._versions = versions if self._versions is None else self._versions
        if other := differences(versions, self._versions):
            raise StudyError(f"a worker has {other}: {_OTHER}")


_OTHER = (
    "results may differ in the last bits; install the same everywhere, or accept them with "
    "--any-environment"
)


def _split(environment: Mapping[str, str]) -> tuple[dict[str, str], str]:
    versions = dict(environment)
    return versions, versions.pop("processor", "")


def _group(name: str) -> tuple[str, str]:
    problem, _, seed = name.split("/")
    return problem, seed


def _refusal(folder: Path, other: Mapping[str, str]) -> str:
    name, changes = next(iter(other.items()))
    more = f", and {len(other) - 1} more trainings differ" if len(other) > 1 else ""
    return (
        f"{folder / name} was not made with what the study has now ({changes}){more}; choose another "
        "folder, or train anew what differs with --again"
    )
