# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Executors for the trainings of a study: processes of this machine, or a Dask cluster."""

from __future__ import annotations

import asyncio
import contextlib
import multiprocessing
import os
import signal
import warnings
from collections.abc import Iterator, Mapping
from concurrent.futures import Executor, ProcessPoolExecutor
from importlib import metadata
from tempfile import TemporaryDirectory
from typing import Any

from loop_interfaces.affinity import usable_cores
from loop_interfaces.module_path import SAFE_PATH, safe_children
from loop_interfaces.start import die_with
from pdeloop.study import training
from pdeloop.study.description import StudyError
from spectral_solver.workers import use_cores

CONNECTING = 10.0
"""Seconds in which a scheduler has to answer."""
RETRIES = 3
"""Number of times that a cluster may restart a training whose worker has gone."""
WORKER = f"{SAFE_PATH}=1 dask worker {{address}} --nthreads 1"
"""The command that starts a worker, which must not run modules of its working directory either."""


@contextlib.contextmanager
def processes(count: int | None = None) -> Iterator[Executor]:
    """This many processes on this machine, one core each; by default as many as cores.

    An exception in the block ends them at once, in the middle of what they do, so their files are in
    a folder of this process, which it removes.
    """
    context = multiprocessing.get_context("spawn")
    others = {process.pid for process in multiprocessing.active_children()}
    workers = count or len(usable_cores())
    with (
        TemporaryDirectory(prefix="pdeloop-") as folder,
        safe_children(),
        ProcessPoolExecutor(workers, context, _begin, (os.getpid(), folder)) as pool,
    ):
        try:
            yield pool
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            for process in multiprocessing.active_children():
                if process.pid not in others:
                    process.terminate()
            raise


def _begin(parent: int, folder: str) -> None:
    """In a process that is about to train. Ctrl-C is for its parent, which then ends it.

    folder: where its trainings keep their files.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    die_with(parent)
    use_cores(usable_cores()[:1])  # the others have trainings of their own
    training.work_in(folder)


@contextlib.contextmanager
def cluster(address: str) -> Iterator[Executor]:
    """The workers of the Dask scheduler at `address` (tcp://HOST:PORT).

    StudyError where that is not an address, no scheduler answers there, it or a worker has another
    version of Dask, there are no workers, or one has no pdeloop.
    """
    from distributed import Client
    from distributed.versions import VersionMismatchWarning

    own = metadata.version("distributed")
    there = {"scheduler": _version_at(address)}  # first: a client fails in many ways at another one
    _check_versions(there, own)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", VersionMismatchWarning)
        client = Client(address, timeout=CONNECTING, set_as_default=False)
    with client:
        found: Any = client.get_versions()
        workers = found["workers"]
        if not workers:
            raise StudyError(
                f"the scheduler at {address} has no workers; start some with: "
                + WORKER.format(address=address)
            )
        known = {f"worker at {at}": of["packages"]["distributed"] for at, of in workers.items()}
        _check_versions(known, own)
        # A worker would end at a task of a package that it lacks.
        installed = client.run(metadata.version, "pdeloop", on_error="return")
        for at, version in installed.items():
            if isinstance(version, Exception):
                raise StudyError(
                    f"the worker at {at} has no pdeloop; install pdeloop[cluster] there"
                )
        pool = client.get_executor(retries=RETRIES)
        pool.client = client
        try:
            yield pool
        except BaseException:
            pool.shutdown(wait=False)
            raise


def no_worker(pool: Executor) -> str:
    """Message that a Dask cluster has no worker left; empty if it has, and for other executors."""
    client = getattr(pool, "client", None)
    with contextlib.suppress(OSError):  # no scheduler, either: the trainings fail
        if client is not None and not client.scheduler_info()["workers"]:
            start = WORKER.format(address=client.scheduler.address)
            return f"no worker is left; waiting for one to be started: {start}"
    return ""


def _check_versions(versions: Mapping[str, str], own: str) -> None:
    for whose, version in versions.items():
        if version != own:
            raise StudyError(
                f"the {whose} has Dask {version}, and this machine has {own}; install the same on all"
            )


def _version_at(address: str) -> str:
    """The version of Dask of the scheduler there."""
    from distributed.comm.addressing import get_address_host_port
    from distributed.core import rpc
    from distributed.security import Security

    async def ask() -> str:
        security = Security().get_connection_args("client")
        async with rpc(address, connection_args=security, timeout=CONNECTING) as scheduler:
            found = await asyncio.wait_for(scheduler.versions(), CONNECTING)
            return str(found["packages"]["distributed"])

    try:
        get_address_host_port(address, strict=True)
        return asyncio.run(ask())
    except ValueError as error:
        raise StudyError(
            f"the scheduler's address is {address!r}; expected one like tcp://localhost:8786"
        ) from error
    except TypeError as error:  # distributed's word for a tls:// address without certificates
        raise StudyError(
            f"{address} needs certificates, which Dask's configuration does not name: set ca-file, "
            "client.cert and client.key in distributed.comm.tls"
        ) from error
    except OSError as error:
        raise StudyError(
            f"no Dask scheduler answers at {address} within {CONNECTING:.0f} s; start one with: "
            "dask scheduler"
        ) from error
