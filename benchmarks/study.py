# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""`python -m benchmarks study`: studies whose processes are killed, and what a study costs by itself.

`killed`: a study on several processes, of which one is killed at random every few seconds, and whose
driver is killed twice: the same bits as in one process without any kill. `overhead`: seconds per
training on one process of a study against a bare loop in this one, and the speed-up with two.
`simulated`: many tasks that sleep, on many simulated workers: processor time and memory of the driver.
`scheduler`: the same on a Dask scheduler, whose workers are threads of one process.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import logging
import multiprocessing
import os
import pickle
import random
import resource
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
from operator import sub
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from types import MappingProxyType
from typing import Any

from benchmarks.processes import markdown
from pdeloop.process.affinity import usable_cores
from pdeloop.solver.workers import use_cores
from pdeloop.study import Study
from pdeloop.study import run as carry_out
from pdeloop.study.executors import local_workers
from pdeloop.study.results import Ended, reading
from pdeloop.study.run import Pool, Task, ended_well
from pdeloop.study.table import status
from pdeloop.study.training import listener, train_one

SETTINGS: dict[str, Any] = {"optimizer": "two_point", "rollouts": 20}
SHORT: dict[str, Any] = {"optimizer": "two_point", "rollouts": 5, "evaluation_fields": 2}
DRIVER_KILLS = 2
BLOCK = 6


def run(
    *,
    trainings: int = 1000,
    workers: int = 8,
    every: float = 2.0,
    alone: int = 5,
    tasks: int = 10_000,
    simulated: int = 64,
    seconds: float = 1.0,
    scheduler: bool = False,
    problem: str = "burgers",
) -> dict[str, Any]:
    """Kill workers and drivers, and measure what a study adds to its trainings.

    Parameters
    ----------
    trainings
        Trainings of the study whose processes are killed, short ones; 0: leave this part out.
    workers
        Its processes.
    every
        Seconds between two kills of a worker.
    alone
        Blocks of `BLOCK` trainings of the comparison with a bare loop; 0: leave this part out.
    tasks
        Tasks that sleep; 0: leave this part out.
    simulated
        Simulated workers that carry them out.
    seconds
        Seconds that each sleeps.
    scheduler
        Also carry the tasks out on a Dask scheduler.
    problem
        The problem of the trainings.
    """
    result: dict[str, Any] = {}
    with TemporaryDirectory(prefix="pdeloop-") as place:
        folder = Path(place)
        if alone:
            result["overhead"] = overhead(problem, folder, alone)
        if trainings:
            result["killed"] = killed(
                _study(problem, range(trainings), SHORT), folder, workers, every
            )
        if tasks:
            result["simulated"] = without_work(problem, folder, tasks, simulated, seconds)
        if tasks and scheduler:
            result["scheduler"] = on_a_scheduler(problem, folder, tasks, simulated, seconds)
    return result


def _study(problem: str, seeds: range, settings: Mapping[str, Any] = SETTINGS) -> Study:
    content = {"problems": [problem], "seeds": [*seeds], "settings": settings}
    return Study.of({**content, "variants": {"two-point": {}}})


def overhead(problem: str, folder: Path, blocks: int) -> dict[str, Any]:
    """Seconds per training on one process of a study, against the same one in a bare loop here.

    Both take turns, block by block, so that what else the machine does meets both: the medians are of
    pairs of the same training. Processor seconds, of driver and process together, are those of a block,
    and depend less on what else the machine does. Then the speed-up with two processes.
    """
    use_cores(usable_cores()[:1])  # as a process of a study does
    pairs: list[tuple[float, float]] = []
    spent: list[tuple[float, float, float]] = []  # processor time: bare loop, driver, process
    with local_workers(1) as one:
        for block in range(blocks + 1):
            study = _study(problem, range(block * BLOCK, (block + 1) * BLOCK))
            bare, first = [], time.process_time()
            for values in study.trainings().values():
                began = time.perf_counter()
                train_one(values)
                bare.append(time.perf_counter() - began)
            second, before = time.process_time(), _of_children()
            at = _ends(study, folder / f"block{block}", lambda: contextlib.nullcontext(one))
            own = time.process_time() - second
            if block:  # the first one compiles and loads
                pairs += [*zip(bare[1:], map(sub, at[1:], at), strict=True)]
                spent.append((second - first, own, _of_children() - before))
    rates = []
    for count in (1, 2):
        study = _study(problem, range(2 * BLOCK))
        at = _ends(study, folder / f"alone{count}", partial(local_workers, count))
        # From the first that are finished on: processes import and load for some seconds.
        rates.append((len(at) - count) / (at[-1] - at[count - 1]))
    return {
        "pairs": len(pairs),
        "bare_seconds": median(bare for bare, _ in pairs),
        "study_seconds": median(own for _, own in pairs),
        "overhead_percent": 100 * (median(own / bare for bare, own in pairs) - 1),
        "bare_processor_seconds": median(bare for bare, *_ in spent) / BLOCK,
        "driver_processor_seconds": median(driver for _, driver, _ in spent) / BLOCK,
        "processor_overhead_percent": 100
        * (median((driver + process) / bare for bare, driver, process in spent) - 1),
        "speed_up_two": rates[1] / rates[0],
    }


def _of_children() -> float:
    """Processor seconds of the processes that this one has started."""
    fields = [
        Path(f"/proc/{child.pid}/stat").read_text().rpartition(")")[2].split()
        for child in multiprocessing.active_children()
    ]
    return sum(int(own[11]) + int(own[12]) for own in fields) / os.sysconf("SC_CLK_TCK")


def _ends(study: Study, folder: Path, pool: Pool) -> list[float]:
    """When each training of a study was kept."""
    at: list[float] = []

    def tell(done: int, total: int, status: str) -> None:
        at.extend([time.perf_counter()] * (done - len(at)))

    carry_out(study, folder, pool, tell=tell)
    return at


def killed(study: Study, folder: Path, workers: int, every: float) -> dict[str, Any]:
    """Results of a study whose workers and drivers are killed, compared with those of a bare loop."""
    out, file, draw = folder / "killed", folder / "study.json", random.Random(0)
    file.write_text(json.dumps(study.content()))
    words = [sys.executable, "-m", "pdeloop.cli", "study", str(file), "--out", str(out)]
    words += ["--processes", str(workers)]
    kills, drivers, total = 0, 0, len(study.trainings())
    began = time.perf_counter()
    while True:
        driver = subprocess.Popen(words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        try:
            while driver.poll() is None:
                with contextlib.suppress(subprocess.TimeoutExpired):
                    driver.wait(every)
                done = status(out)["finished"] if (out / "results.sqlite").exists() else 0
                if drivers < DRIVER_KILLS and done > total * (drivers + 1) / (DRIVER_KILLS + 1):
                    driver.kill()
                    driver.wait()
                    drivers += 1
                elif training := _training_processes(driver.pid, out):
                    os.kill(draw.choice(training), signal.SIGKILL)
                    kills += 1
        finally:
            driver.kill()
        if driver.returncode != -signal.SIGKILL:
            break
    elapsed = time.perf_counter() - began
    found = _digests(out)
    wanted = {name: _digest(train_one(values)) for name, values in study.trainings().items()}
    counted = status(out)
    return {
        "trainings": total,
        "workers": workers,
        "workers_killed": kills,
        "trainings_interrupted": counted["workers_lost"],
        "most_of_one": max([0, *counted["deaths"].values()]),
        "drivers_killed": drivers,
        "failed": counted["failed"],
        "same_bits": found == wanted,
        "seconds": elapsed,
    }


def _training_processes(driver: int, out: Path) -> list[int]:
    """The processes of a driver that have begun to train, once there is a result or two."""
    if not (out / "unfinished").exists():
        return []
    path = Path(f"/proc/{driver}/task/{driver}/children")
    with contextlib.suppress(OSError):
        children = [int(word) for word in path.read_text().split()]
        command = [(pid, Path(f"/proc/{pid}/cmdline").read_bytes()) for pid in children]
        return [pid for pid, words in command if b"spawn_main" in words]
    return []


def _digests(out: Path) -> dict[str, str]:
    with reading(out) as results:
        return {name: _digest(results.files(name)) for name in results.names()}


def _digest(files: Mapping[str, bytes]) -> str:
    content = b"".join(name.encode() + files[name] for name in sorted(files))
    return hashlib.sha256(content).hexdigest()


def without_work(
    problem: str, folder: Path, tasks: int, simulated: int, seconds: float
) -> dict[str, Any]:
    """Processor time and memory of a driver whose trainings are tasks that sleep."""
    study = _study(problem, range(tasks))
    name, values = next(iter(study.trainings().items()))
    ended = ended_well(name, values, train_one)

    class Sleeping(ThreadPoolExecutor):
        """Sleeps for each training, and has a result for it, as its worker would return it."""

        def submit(self, task: Any, name: str, *arguments: Any) -> Future[Any]:  # type: ignore[override]
            return super().submit(self.sleep, name)

        def sleep(self, name: str) -> Ended:
            time.sleep(seconds)
            return ended._replace(name=name)

    return _driver(study, folder / "simulated", partial(Sleeping, simulated), simulated, seconds)


def on_a_scheduler(
    problem: str, folder: Path, tasks: int, simulated: int, seconds: float
) -> dict[str, Any]:
    """The same on a Dask scheduler, with its workers in one process: real messages, and progress."""
    from pdeloop.study.cluster import cluster

    study = _study(problem, range(tasks))
    path = folder / "files"
    path.write_bytes(pickle.dumps(train_one(next(iter(study.trainings().values())))))
    context = multiprocessing.get_context("spawn")
    address = context.SimpleQueue()
    process = context.Process(target=_dask, args=(simulated, address), daemon=True)
    process.start()
    try:
        pool = partial(cluster, address.get())
        own = {"two-point": partial(asleep, str(path), seconds)}
        memory: list[int] = []

        def look() -> None:
            memory.append(_memory(process.pid))

        found = _driver(study, folder / "scheduler", pool, simulated, seconds, own, look)
    finally:
        process.kill()
        process.join()
    found["scheduler_and_workers_mb"] = max(memory) / 1e6
    found["their_growth_mb"] = (max(memory) - memory[0]) / 1e6
    return found


def _dask(count: int, address: Any) -> None:
    """In a process of its own: a scheduler with so many workers."""
    from distributed import LocalCluster

    with LocalCluster(  # type: ignore[no-untyped-call]
        n_workers=count,
        threads_per_worker=1,
        processes=False,
        memory_limit=0,
        silence_logs=logging.CRITICAL + 1,
        host="127.0.0.1",
        protocol="tcp",
        dashboard_address=None,
    ) as own:
        address.put(own.scheduler_address)
        threading.Event().wait()


ROWS = 12
"""Rows of progress of a task, as many as of a training by `SETTINGS`."""


def asleep(path: str, seconds: float, values: Mapping[str, Any]) -> Mapping[str, bytes]:
    """Sleep, with the progress of a training, and have the files that another one has left there."""
    tell = listener()
    for row in range(ROWS):
        tell({"phase": "adapting", "rollouts": 2.0 * row, "memory_mb": 200.0})
        time.sleep(seconds / ROWS)
    files: Mapping[str, bytes] = pickle.loads(Path(path).read_bytes())
    return files


def _memory(pid: int | None) -> int:
    return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * resource.getpagesize()


def _driver(
    study: Study,
    folder: Path,
    pool: Pool,
    simulated: int,
    seconds: float,
    own: Mapping[str, Task] = MappingProxyType({}),
    look: Callable[[], None] = lambda: None,
) -> dict[str, Any]:
    """Processor time and memory of a driver from the first results to the last tasks.

    look: called meanwhile.
    """
    tasks = len(study.trainings())
    marks: list[tuple[int, float, float, int]] = []

    def tell(done: int, total: int, status: str) -> None:
        if simulated <= done < tasks:
            now = done, time.perf_counter(), time.process_time(), _memory(os.getpid())
            marks[1:] = [now]
            look()

    carry_out(study, folder, pool, tasks=own, tell=tell)
    (first, began, before, memory), (last, ended, after, most) = marks
    spent, elapsed, count = after - before, ended - began, last - first
    kept = [path for path in folder.rglob("*") if path.is_file()]
    return {
        "tasks": tasks,
        "workers": simulated,
        "task_seconds": seconds,
        "seconds": elapsed,
        "share_of_workers_percent": 100 * count * seconds / (elapsed * simulated),
        "driver_ms_per_task": 1e3 * spent / count,
        "driver_percent_of_a_core": 100 * spent / elapsed,
        "memory_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        "memory_growth_mb": (most - memory) / 1e6,
        "files": len(kept),
        "megabytes": sum(path.stat().st_size for path in kept) / 1e6,
    }


def text(result: Mapping[str, Any]) -> str:
    """A Markdown table for each part."""
    parts = []
    for name, found in result.items():
        rows = [(k, f"{v:.3g}" if isinstance(v, float) else v) for k, v in found.items()]
        parts.append(f"{name}\n\n{markdown(('what', 'measured'), rows)}")
    return "\n\n".join(parts)
