# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The worker processes of a study or a benchmark are forked in tests, as nodes are, not executed.

They need no imports of their own, which cost more than the trainings of the tests. All else of them is
as always: processes of their own, on a core of their own, that end with the pool.
"""

from __future__ import annotations

import multiprocessing
import os
from collections.abc import Callable, Mapping
from concurrent.futures import ProcessPoolExecutor
from typing import Any

from pdeloop.study import executors
from tests.support.loop_harness import FORKING, forked


def fork_workers(patch: Any) -> None:
    """Pools of the process that runs the tests have workers that `loop_harness` forks."""
    forked(os.getpid).join()  # what they are forked from is there, and has everything loaded

    def pool(
        workers: int, context: Any, first: Callable[..., None], given: tuple[int, str]
    ) -> ProcessPoolExecutor:
        return ProcessPoolExecutor(workers, FORKING, begin, (first, dict(os.environ), given[1]))

    patch.setattr(executors, "ProcessPoolExecutor", pool)


def begin(first: Callable[..., None], environment: Mapping[str, str], folder: str) -> None:
    """In a worker: `first` as for one that was executed with this environment.

    Its parent is not the process that has the pool, but the one that ends with it.
    """
    os.environ.clear()
    os.environ.update(environment)
    first(os.getppid(), folder)


def fork_workers_here() -> None:
    """Pools of this process, which was forked and has one thread when they begin, fork theirs."""
    context = multiprocessing.get_context("fork")
    vars(executors)["ProcessPoolExecutor"] = lambda workers, _, *how: ProcessPoolExecutor(
        workers, context, *how
    )
