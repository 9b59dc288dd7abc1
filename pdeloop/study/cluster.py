# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The workers of a Dask cluster, for the trainings of a study."""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
import json
import logging
import time
import warnings
from collections import defaultdict, deque
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import CancelledError, Future, wait
from importlib import metadata
from itertools import chain
from typing import Any
from uuid import uuid4

from pdeloop.process.module_path import SAFE_PATH
from pdeloop.study import training
from pdeloop.study.description import StudyError
from pdeloop.study.executors import AHEAD, LINES, Death, LostWorkerError, Workers, lost
from pdeloop.study.results import Ended

CONNECTING = 10.0
"""Seconds in which a scheduler has to answer, and to be found again."""
WAITING = 30.0
"""Seconds in which a first worker has to come."""
WORKER = f"{SAFE_PATH}=1 dask worker {{address}} --nthreads 1"
"""The command that starts a worker, which must not run modules of its working directory either."""
ANY = "pdeloop"
"""A Dask resource of every worker that is known; those of one kind also have `resource_of` it."""
MANY = 1e9
"""What a worker has of a resource, of which a training takes 1."""
ACTIONS = ("began", "row", "ended", "add-worker", "remove-worker")
"""Events of workers, in a topic of the study's, and of the scheduler."""
LEAST_PERIOD, MOST_PERIOD, PERIOD = 0.1, 1.0, 1 / 128
"""Seconds in which results gather, and between two rows of progress of a training: so many for each
worker, as few large messages cost a driver less than many. Workers have something to do meanwhile."""
SETTLED, LOOK_PERIOD = 1.0, 30.0
"""Seconds after which the scheduler has what was submitted, and between two looks at what it has."""


class Cluster(Workers):
    """The workers that a Dask client has.

    A worker tells by an event which training it begins; when the scheduler removes it, that is the one
    that has lost its worker, and not the ones that wait there. What is submitted is published, so
    that the scheduler keeps it, and its result, for the next driver when this one dies.

    A training asks for a Dask resource, which a worker has once its environment is known: one that
    comes later, and is of another kind or has no pdeloop, is not given what it must not carry out.
    """

    grows = True

    def __init__(self, client: Any, environments: Mapping[str, Mapping[str, str]]) -> None:
        self._client = client
        self._study = ""
        self.environments = {}
        self._kinds: dict[str, str] = {}
        self._strangers: dict[str, str] = {}
        self._waiting = {}
        self._new: list[tuple[str, str, bytes]] = []
        self._at: dict[str, Any] = {}
        self._kind_of: dict[str, str] = {}
        self._since: dict[str, float] = {}
        self._again: set[str] = set()
        self._look_at = 0.0
        self._there: set[str] = set()
        for at, environment in environments.items():
            self._meet(at, environment)
        self._datasets: dict[str, str] = {}
        self._left: set[str] = set()
        self._old: list[str] = []
        self._progress: dict[str, deque[Mapping[str, Any]]] = {}
        self._running: dict[str, set[str]] = defaultdict(set)
        self._events: deque[Mapping[str, Any]] = deque()  # from the client's thread

    def begin(self, study: str) -> None:
        self._study = study

        def hear(event: tuple[float, Any]) -> None:
            if isinstance(event[1], dict) and event[1].get("action") in ACTIONS:
                self._events.append(event[1])

        with _of_the_scheduler():
            for topic in (self._topic, "all"):
                self._client.subscribe_topic(topic, hear)
            mine = f"pdeloop/{study}/"
            self._left = {n for n in map(str, self._client.list_datasets()) if n.startswith(mine)}
            present, self._there = self._client.nthreads(), self._with_a_worker()
        self._kinds = {at: kind for at, kind in self._kinds.items() if at in present}
        came = [{"action": "add-worker", "worker": at} for at in present if at not in self._kinds]
        self._events.extend(came)

    def left(self) -> Mapping[str, str]:
        known = {resource_of(own): kind for kind, own in self.environments.items()}
        words = [dataset.split("/", 4)[3:] for dataset in self._left]
        return {name: known[resource] for resource, name in words if resource in known}

    def window(self, kind: str) -> int:
        own = [each for each in self._kinds.values() if kind in ("", each)]
        return AHEAD * len(own)

    def submit(
        self, name: str, kind: str, identity: str, task: Callable[..., Ended], *arguments: Any
    ) -> None:
        from distributed.protocol import pickle

        resource = resource_of(self.environments[kind]) if kind else ANY
        dataset = f"pdeloop/{self._study}/{identity}/{resource}/{name}"
        self._datasets[name], self._kind_of[name] = dataset, kind
        self._since[name] = time.monotonic()
        if dataset in self._left:  # of a driver that has died
            self._left.discard(dataset)
            with _of_the_scheduler():
                future = self._client.get_dataset(dataset)
            if future.key in self._there:
                self._at[name] = future
                return
        # Dask looks into every argument for its own.
        self._new.append((name, resource, pickle.dumps((task, arguments))))

    def settle(self) -> None:
        new, self._new = self._new, []
        with _of_the_scheduler():
            for resource in {resource for _, resource, _ in new}:
                own = {name: pickled for name, other, pickled in new if other == resource}
                futures = self._client.map(
                    on_worker,
                    [*own],
                    [*own.values()],
                    topic=self._topic,
                    period=self._period,
                    key=[f"pdeloop-{name}-{uuid4().hex}" for name in own],
                    retries=0,
                    resources={resource: 1},
                )
                self._at |= zip(own, futures, strict=True)
            if self._old:
                self._client.unpublish_dataset(self._old)
                self._old = []
            if new:
                published = {self._datasets[name]: self._at[name] for name, *_ in new}
                self._client.publish_dataset(published, override=True)

    def collect(self, timeout: float) -> list[tuple[str, Future[Ended]]]:
        time.sleep(self._period)
        asked = {*self._waiting.values()}
        done: dict[Future[Ended], str] = {
            Future(): name for name in self._at if name not in asked and self._at[name].done()
        }
        self._waiting |= done
        for own, name in done.items():
            self._client.loop.add_callback(self._pass_on, self._at[name], own)
        wait(done, timeout)  # but for one that its worker has lost meanwhile
        found = []
        for name, future in super().collect(0):
            again = name in self._again and future.cancelled()
            found.append((name, lost() if again else future))
            self._leave(name)
        return found

    def deaths(self) -> list[Death]:
        found = []
        while self._events:
            event = self._events.popleft()
            worker, name = event.get("worker", ""), event.get("name", "")
            match event["action"]:
                case "began" if name in self._at:  # and has not ended since
                    self._running[worker].add(name)
                    self._progress[name] = deque(maxlen=LINES)
                case "row" if name in self._progress:
                    self._progress[name].append(event["row"])
                case "ended":
                    self._running[worker].discard(name)
                case "add-worker":
                    self._strangers[worker] = ""
                    self._client.loop.add_callback(self._ask, worker)
                case "met" if worker in self._strangers:  # and has not gone since
                    if "environment" in event:
                        del self._strangers[worker]
                        self._look_at = min(self._look_at, time.monotonic() + SETTLED)
                        self._meet(worker, event["environment"])
                    else:
                        self._strangers[worker] = event["why"]
                case "remove-worker":
                    self._kinds.pop(worker, None)
                    self._strangers.pop(worker, None)
                    # Of a training that had just begun the event may be lost with the worker.
                    waited = [n for n in self._at if self._at[n].key in event["processing-tasks"]]
                    only = waited if len(waited) == 1 else []
                    for name in self._running.pop(worker, None) or only:
                        if name in self._at:
                            rows = [*self._progress.get(name, ())]
                            found.append(Death(name, rows, bool(event.get("expected"))))
        if time.monotonic() > self._look_at:
            self._revive()
        return found

    def take_back(self, name: str) -> None:
        future = self._at[name]
        super().take_back(name)
        self._leave(name)
        future.cancel()

    def end(self) -> None:
        """Carry nothing out any longer."""
        self._new = []
        with contextlib.suppress(Exception):  # of a scheduler that has gone
            for name in [*self._at]:
                self.take_back(name)
            self._old += [*self._left]
            self.settle()

    def remark(self) -> str:
        words = [f"the worker at {at} {why}" for at, why in self._strangers.items() if why][:1]
        if not self._kinds:
            start = WORKER.format(address=self._client.scheduler.address)
            words = [f"no worker is left; waiting for one to be started: {start}", *words]
        return ", ".join(words)

    async def _ask(self, at: str) -> None:
        """What a worker is that has come, for `deaths`, which must not wait for it."""
        event: dict[str, Any] = {"action": "met", "worker": at}
        try:
            found = await self._client.run(meet, workers=[at], on_error="return")
            answer = found[at]
            if isinstance(answer, BaseException):
                raise answer
            event["environment"] = answer
        except Exception as error:
            event["why"] = f"gets no trainings, as it does not answer ({error}); is pdeloop there?"
        self._events.append(event)

    def _meet(self, at: str, environment: Mapping[str, str]) -> None:
        kind = environment["processor"]
        same = [each for each, own in self.environments.items() if own == environment]
        if not same and kind in self.environments:  # with other versions
            kind = f"{kind} at {at}"
        kind = same[0] if same else kind
        self.environments = {**self.environments, kind: environment}
        self._kinds[at] = kind

    def _with_a_worker(self) -> set[str]:
        """The keys of what a worker has, or has the result of."""
        results = {key for key, workers in self._client.who_has().items() if workers}
        return {*chain(*self._client.processing().values()), *results}

    def _revive(self) -> None:
        """Have those submitted again that have no worker, though there is one for them.

        The scheduler looks for one only when it comes, and then it has no resource yet.
        """
        now = time.monotonic()
        self._look_at = now + LOOK_PERIOD
        with _of_the_scheduler():
            there = self._with_a_worker()
            for name, future in self._at.items():
                if future.key in there or future.done() or now < self._since[name] + SETTLED:
                    continue
                if self.window(self._kind_of[name]):
                    self._again.add(name)
                    future.cancel()

    @property
    def _topic(self) -> str:
        return f"pdeloop-{self._study}"

    @property
    def _period(self) -> float:
        return min(MOST_PERIOD, max(LEAST_PERIOD, PERIOD * len(self._kinds)))

    def _leave(self, name: str) -> None:
        """A training is not this object's any longer."""
        self._old.append(self._datasets.pop(name))
        del self._at[name], self._kind_of[name], self._since[name]
        self._again.discard(name)
        self._progress.pop(name, None)

    async def _pass_on(self, future: Any, own: Future[Ended]) -> None:
        """Give a future of Dask's outcome to one of concurrent.futures."""
        from distributed import KilledWorker

        try:
            found = await self._client.gather(future, asynchronous=True)
        except (CancelledError, asyncio.CancelledError):
            if own.cancel():
                own.set_running_or_notify_cancel()
        except KilledWorker:
            if own.set_running_or_notify_cancel():
                own.set_exception(LostWorkerError())
        except BaseException as error:
            if own.set_running_or_notify_cancel():
                own.set_exception(error)
        else:
            if own.set_running_or_notify_cancel():
                own.set_result(found)


def resource_of(environment: Mapping[str, str]) -> str:
    """The Dask resource of workers with this environment."""
    text = json.dumps(dict(environment), sort_keys=True)
    return f"{ANY}-{hashlib.sha256(text.encode()).hexdigest()[:16]}"


async def meet(dask_worker: Any) -> dict[str, str]:
    """On a worker: its environment, whose resources it has from now on."""
    own = training.environment()
    if (resource := resource_of(own)) not in dask_worker.state.total_resources:
        await dask_worker.set_resources(**{ANY: MANY, resource: MANY})
    return own


def on_worker(name: str, pickled: bytes, *, topic: str, period: float) -> Ended:
    """Carry out a task on a worker, which tells the driver how far it is.

    pickled: the task and its arguments; period: seconds between two rows of progress, at least.
    """
    from distributed import get_worker
    from distributed.protocol import pickle

    worker = get_worker()
    told_at = float("-inf")

    def tell(action: str, **entries: Any) -> None:
        worker.log_event(
            topic, {"action": action, "worker": worker.address, "name": name, **entries}
        )

    def hear(row: Mapping[str, Any]) -> None:
        nonlocal told_at
        if time.monotonic() > told_at + period:
            told_at = time.monotonic()
            tell("row", row=dict(row))

    tell("began")
    training.work_in(worker.local_directory)
    try:
        with training.listening(hear):
            task, arguments = pickle.loads(pickled)
            return task(*arguments)  # type: ignore[no-any-return]
    finally:
        tell("ended")


@contextlib.contextmanager
def cluster(address: str, security: Mapping[str, str] | None = None) -> Iterator[Workers]:
    """The workers of the Dask scheduler at `address` (tcp://HOST:PORT or tls://HOST:PORT).

    security: files by the names of `distributed.Security`, such as tls_ca_file, for encryption.

    StudyError where that is not an address, no scheduler answers there, it or a worker has another
    version of Dask, there are no workers, or one has no pdeloop or another one.
    """
    from distributed import Client
    from distributed.security import Security
    from distributed.versions import VersionMismatchWarning

    try:
        secured = Security(**security, require_encryption=True) if security else Security()
        arguments = secured.get_connection_args("client")
    except OSError as error:
        raise StudyError(f"the certificates for {address} cannot be used: {error}") from error
    own = metadata.version("distributed")
    # First, as a client fails in many ways at another one.
    _check_versions({"scheduler": _version_at(address, arguments)}, own)
    with warnings.catch_warnings(), _of_the_scheduler():
        warnings.simplefilter("ignore", VersionMismatchWarning)
        client = Client(address, timeout=CONNECTING, set_as_default=False, security=secured)
    with _quiet(), client:
        with _of_the_scheduler():
            pool = Cluster(client, _environments(client, address, own))
        try:
            yield pool
        finally:
            pool.end()


def _environments(client: Any, address: str, own: str) -> dict[str, Mapping[str, str]]:
    """Those of the workers, by address. StudyError unless all have this pdeloop and Dask `own`."""
    with contextlib.suppress(TimeoutError):  # in a batch job they come later
        client.wait_for_workers(1, timeout=WAITING)
    workers = client.get_versions()["workers"]
    if not workers:
        raise StudyError(
            f"the scheduler at {address} has no workers; start some with: "
            + WORKER.format(address=address)
        )
    known = {f"worker at {at}": of["packages"]["distributed"] for at, of in workers.items()}
    _check_versions(known, own)
    # A worker would end at a task of a package that it lacks; the scheduler reads tasks as well.
    found = client.run(metadata.version, "pdeloop", on_error="return")
    installed = {f"worker at {at}": version for at, version in found.items()}
    try:
        installed["scheduler"] = client.run_on_scheduler(metadata.version, "pdeloop")
    except metadata.PackageNotFoundError as error:
        installed["scheduler"] = error
    for whose, version in installed.items():
        if isinstance(version, OSError):
            continue  # it has gone meanwhile
        if isinstance(version, Exception):
            raise StudyError(f"the {whose} has no pdeloop; install pdeloop[cluster] there")
        if version != metadata.version("pdeloop"):
            raise StudyError(
                f"the {whose} has pdeloop {version}, and this machine has "
                f"{metadata.version('pdeloop')}; install the same on all"
            )
    answers = client.run(meet, on_error="return")
    environments = {at: own for at, own in answers.items() if not isinstance(own, OSError)}
    for at, answer in environments.items():
        if isinstance(answer, Exception):
            raise StudyError(
                f"the worker at {at} has another pdeloop, or cannot answer ({answer}); install the "
                "same on all"
            )
    return environments


def _is_news(record: logging.LogRecord) -> bool:
    """False for what a client says of a lost connection some seconds after its end."""
    return not record.msg.startswith("Failed to reconnect to scheduler")


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Without the library's own words on a lost connection, which is reported in one sentence."""
    logging.getLogger("distributed.client").addFilter(_is_news)
    loggers = [logging.getLogger(name) for name in ("distributed", "tornado")]
    before = [logger.level for logger in loggers]
    for logger in loggers:
        logger.setLevel(logging.CRITICAL + 1)
    try:
        yield
    finally:
        for logger, level in zip(loggers, before, strict=True):
            logger.setLevel(level)


@contextlib.contextmanager
def _of_the_scheduler() -> Iterator[None]:
    """CancelledError where the scheduler has gone."""
    try:
        yield
    except (OSError, RuntimeError, CancelledError, asyncio.CancelledError) as error:
        raise CancelledError(str(error)) from error


def _check_versions(versions: Mapping[str, str], own: str) -> None:
    for whose, version in versions.items():
        if version != own:
            raise StudyError(
                f"the {whose} has Dask {version}, and this machine has {own}; install the same on all"
            )


def _version_at(address: str, security: Mapping[str, Any]) -> str:
    from distributed.comm.addressing import get_address_host_port
    from distributed.core import rpc

    async def ask() -> str:
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
            f"{address} needs certificates: give --tls-ca-file, --tls-cert and --tls-key, or set "
            "ca-file, client.cert and client.key in Dask's configuration, distributed.comm.tls"
        ) from error
    except OSError as error:
        raise StudyError(
            f"no Dask scheduler answers at {address} within {CONNECTING:.0f} s; start one with: "
            "dask scheduler"
        ) from error
