"""Where the trainings of a study run: processes of this machine, or a Dask cluster."""

from __future__ import annotations

import multiprocessing
import signal
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, ProcessPoolExecutor
from contextlib import contextmanager
from typing import Any

from loop_interfaces.affinity import usable_cores
from pde_sim_node.solver.workers import use_cores
from pdeloop.study.description import StudyError
from pdeloop.supervisor import die_with_parent

CONNECTING = 10.0
"""Seconds in which a scheduler has to answer."""
RETRIES = 3
"""How often a cluster may begin a training again whose worker has gone."""


@contextmanager
def processes(
    count: int | None = None, prepare: Callable[..., None] | None = None, *arguments: Any
) -> Iterator[Executor]:
    """So many processes of this machine, a core each; as many as cores by default.

    An exception in the block ends them at once, in the middle of what they do. prepare(*arguments) is
    called in each before its first task.
    """
    context = multiprocessing.get_context("spawn")
    others = {process.pid for process in multiprocessing.active_children()}
    with ProcessPoolExecutor(
        count or len(usable_cores()), context, _begin, (prepare, arguments)
    ) as pool:
        try:
            yield pool
        except BaseException:
            for process in multiprocessing.active_children():
                if process.pid not in others:
                    process.terminate()
            raise


def _begin(prepare: Callable[..., None] | None, arguments: tuple[Any, ...]) -> None:
    """In a process that is about to train. Ctrl-C is for its parent, which then ends it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    die_with_parent()
    use_cores(usable_cores()[:1])  # the others have trainings of their own
    if prepare is not None:
        prepare(*arguments)


@contextmanager
def cluster(address: str) -> Iterator[Executor]:
    """The workers of the Dask scheduler at `address` (tcp://HOST:PORT).

    Raises
    ------
    StudyError
        No scheduler answers there, or it and its workers cannot be used with this version of Dask.
    """
    from distributed import Client

    try:
        client = Client(address, timeout=CONNECTING, set_as_default=False)
    except (OSError, ValueError) as error:
        raise StudyError(
            f"no Dask scheduler answers at {address} within {CONNECTING:.0f} s ({error}); "
            "start one with: dask scheduler"
        ) from error
    with client:
        try:
            client.get_versions(check=True)
        except ValueError as error:
            raise StudyError(
                f"the scheduler at {address}, its workers and this machine have different versions "
                "of Dask or of what it needs; install the same on all of them"
            ) from error
        if not client.scheduler_info()["workers"]:
            raise StudyError(
                f"the scheduler at {address} has no workers; start some with: "
                f"dask worker {address} --nthreads 1"
            )
        yield client.get_executor(retries=RETRIES)
