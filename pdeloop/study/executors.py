# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Executors for the trainings of a study on this machine, and what a study knows of any executor."""

from __future__ import annotations

import contextlib
import math
import multiprocessing
import os
import signal
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    Executor,
    Future,
    ProcessPoolExecutor,
    wait,
)
from dataclasses import dataclass
from functools import partial
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

from pdeloop.process.affinity import usable_cores
from pdeloop.process.module_path import safe_children
from pdeloop.process.start import die_with
from pdeloop.solver.workers import use_cores
from pdeloop.study import training
from pdeloop.study.results import Ended

MOST_DEATHS = 20
"""Workers that one training may lose."""
OWN_DEATHS = 3
"""Deaths in a row at the same place by which a training is recognised as their cause."""
CHANCE = 1e-6
"""Largest probability that the deaths of the cause are those of a cluster that loses workers."""
LINES = 5
"""Lines of a training's progress that are shown."""

Row = Mapping[str, Any]
"""Progress of a training: phase, rollouts that are paid, memory_mb, the largest so far."""


@dataclass
class _Lost:
    deaths: int = 0
    in_a_row: int = 0
    furthest: float = -1.0


class Deaths:
    """Counts the workers that trainings lose, each by itself.

    A cluster that takes workers away interrupts a training now here and now there; one that needs too
    much memory dies at the same place each time. So a training is given up after `OWN_DEATHS` deaths
    in a row none of which came further than those before, or where a share p of the attempts of those
    that have ended well were deaths, after n of them with p^n < `CHANCE`; and after `most` in any case.
    """

    def __init__(self, most: int = MOST_DEATHS) -> None:
        self.most = most
        self.total = 0
        self._lost: dict[str, _Lost] = {}
        self._ended = self._innocent = 0

    def of(self, name: str) -> int:
        """The deaths of a training so far."""
        return self._lost[name].deaths if name in self._lost else 0

    def known(self, name: str, deaths: int) -> None:
        """A training has lost so many workers before, to another driver."""
        self._lost[name] = _Lost(deaths)

    def ended(self, name: str) -> None:
        """A training has ended with its worker alive."""
        self._ended += 1
        self._innocent += self.of(name)

    def died(self, name: str, progress: Sequence[Row] = (), *, announced: bool = False) -> str:
        """The worker of a training has died; why to give it up, empty: not yet.

        progress: its last rows; announced: the worker was retired, which is nobody's fault.
        """
        own = self._lost.setdefault(name, _Lost())
        own.deaths += 1
        self.total += 1
        reached = float(progress[-1].get("rollouts", 0.0)) if progress else 0.0
        own.in_a_row = 0 if announced else own.in_a_row + 1 if reached <= own.furthest else 1
        own.furthest = max(own.furthest, reached)
        lines = "; ".join(map(described, progress[-LINES:])) or "it had just begun"
        if own.in_a_row >= self._needed():
            return (
                f"it kills its workers: {own.in_a_row} died in a row at the same place ({lines}); "
                "is there enough memory?"
            )
        if own.deaths >= self.most:
            return f"it has lost {own.deaths} workers, the most of a training ({lines})"
        return ""

    def _needed(self) -> float:
        """Deaths in a row that are hardly chance."""
        share = self._innocent / max(1, self._innocent + self._ended)
        return max(OWN_DEATHS, math.log(CHANCE) / math.log(share)) if share else OWN_DEATHS


def described(row: Row) -> str:
    """One row of progress, in words."""
    return (
        f"{row.get('phase', '?')} after {row.get('rollouts', 0):g} rollouts, "
        f"{row.get('memory_mb', 0):.0f} MB"
    )


AHEAD = 2
"""Trainings for each worker that an executor has at a time, the running ones among them."""
STILLBORN = 2
"""Processes in a row, for each one that there may be, that may end before they can train."""
UNKNOWN = 64
"""Workers of an executor that does not say how many it has."""


class Death(NamedTuple):
    """The worker of a training has died: its last progress, and whether the end was announced."""

    name: str
    progress: list[Mapping[str, Any]]
    announced: bool = False


class LostWorkerError(RuntimeError):
    """A training whose worker has died, and which has to be submitted again."""


def lost() -> Future[Ended]:
    """The outcome of a training whose worker has died."""
    future: Future[Ended] = Future()
    future.set_exception(LostWorkerError())
    return future


class Workers:
    """The workers of an executor, for trainings that have names.

    Derived classes know more of theirs: which died, and what they are.
    """

    environments: Mapping[str, Mapping[str, str]] = {}
    """The environments of the workers, by a name for each kind; empty: unknown until one answers."""
    grows = False
    """Whether workers may come, also of further kinds."""

    def __init__(self, pool: Executor) -> None:
        self.pool = pool
        self._waiting: dict[Future[Ended], str] = {}

    def window(self, kind: str) -> int:
        """Trainings that workers of a kind may have at a time; of "": all workers."""
        return AHEAD * (getattr(self.pool, "_max_workers", None) or UNKNOWN)

    def begin(self, study: str) -> None:
        """Work for the study with this id."""

    def left(self) -> Mapping[str, str]:
        """The kinds of workers that have trainings of an earlier driver, by training."""
        return {}

    def submit(
        self, name: str, kind: str, identity: str, task: Callable[..., Ended], *arguments: Any
    ) -> None:
        """Have a training carried out by a worker of a kind of `environments`.

        identity: of what it is made with; not another one of that name is taken for it.
        """
        self._waiting[self.pool.submit(task, *arguments)] = name

    def collect(self, timeout: float) -> list[tuple[str, Future[Ended]]]:
        """The trainings that have ended since, after at most `timeout` seconds, results first."""
        done, _ = wait(self._waiting, timeout=timeout, return_when=FIRST_COMPLETED)
        ordered = sorted(done, key=lambda one: one.cancelled() or one.exception() is not None)
        return [(self._waiting.pop(future), future) for future in ordered]

    def deaths(self) -> list[Death]:
        """The trainings whose workers have died since."""
        return []

    def settle(self) -> None:
        """What was collected is kept now, and all that can be submitted is."""

    def take_back(self, name: str) -> None:
        """Carry this training out no longer."""
        for future in [future for future, own in self._waiting.items() if own == name]:
            future.cancel()
            del self._waiting[future]

    def remark(self) -> str:
        """What the user should know of the workers."""
        return ""


class Processes(Workers):
    """Processes of this machine, each with an executor of its own: one that dies breaks no other."""

    def __init__(self, count: int) -> None:
        self._pools: list[ProcessPoolExecutor | None] = [None] * count
        self._begun: list[Future[int]] = [Future() for _ in self._pools]
        self._at: dict[str, int] = {}
        self._died: list[Death] = []
        self._stillborn = 0
        self._waiting = {}
        here = training.environment()
        self.environments = {here["processor"]: here}

    def window(self, kind: str) -> int:
        return len(self._pools)

    def submit(
        self, name: str, kind: str, identity: str, task: Callable[..., Ended], *arguments: Any
    ) -> None:
        # Here and not in a callback: a process dies with the thread that has started it.
        place = next(i for i in range(len(self._pools)) if i not in self._at.values())
        pool = self._pools[place]
        if pool is None:
            context = multiprocessing.get_context("spawn")
            pool = ProcessPoolExecutor(1, context, _begin, (os.getpid(), None))
            self._pools[place], self._begun[place] = pool, pool.submit(os.getpid)
        self._at[name] = place
        try:
            future = pool.submit(task, *arguments)
        except BrokenExecutor:  # its process has died between two trainings
            self._pools[place] = None
            del self._at[name]
            self.submit(name, kind, identity, task, *arguments)
            return
        self._waiting[future] = name

    def collect(self, timeout: float) -> list[tuple[str, Future[Ended]]]:
        found = []
        for name, future in super().collect(timeout):
            place = self._at.pop(name)
            if isinstance(future.exception(), BrokenExecutor):
                self._pools[place] = None
                begun = self._begun[place]
                if begun.done() and begun.exception() is None:
                    self._died.append(Death(name, []))
                    self._stillborn = 0
                else:
                    self._stillborn += 1
                future = lost()
            found.append((name, future))
        return found

    def deaths(self) -> list[Death]:
        found, self._died = self._died, []
        if self._stillborn >= STILLBORN * len(self._pools):
            raise BrokenExecutor("processes end when they start")
        return found

    def shutdown(self, *, wait: bool) -> None:
        """Let the processes end; wait: until they have."""
        for pool in self._pools:
            if pool is not None:
                pool.shutdown(wait, cancel_futures=not wait)


@contextlib.contextmanager
def local_workers(count: int | None = None) -> Iterator[Workers]:
    """This many processes on this machine, one core each; by default as many as cores.

    An exception in the block ends them at once, in the middle of what they do.
    """
    workers = Processes(count or len(usable_cores()))
    with safe_children(), _ended_at_once(partial(workers.shutdown, wait=False)):
        yield workers
        workers.shutdown(wait=True)


@contextlib.contextmanager
def processes(count: int | None = None) -> Iterator[Executor]:
    """The same as an executor, for tasks that are no trainings.

    Their files are in a folder of this process, which it removes.
    """
    context = multiprocessing.get_context("spawn")
    workers = count or len(usable_cores())
    with (
        TemporaryDirectory(prefix="pdeloop-") as folder,
        safe_children(),
        ProcessPoolExecutor(workers, context, _begin, (os.getpid(), folder)) as pool,
        _ended_at_once(partial(pool.shutdown, wait=False, cancel_futures=True)),
    ):
        yield pool


@contextlib.contextmanager
def _ended_at_once(shutdown: Callable[[], None]) -> Iterator[None]:
    """An exception in the block ends the processes that were started in it, after `shutdown`."""
    others = {process.pid for process in multiprocessing.active_children()}
    try:
        yield
    except BaseException:
        shutdown()
        for process in multiprocessing.active_children():
            if process.pid not in others:
                process.terminate()
        raise


def _begin(parent: int, folder: str | None) -> None:
    """In a process that is about to train. Ctrl-C is for its parent, which then ends it.

    folder: where its trainings keep their files, if no other place is named.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    die_with(parent)
    use_cores(usable_cores()[:1])  # the others have trainings of their own
    if folder is not None:
        training.work_in(folder)
