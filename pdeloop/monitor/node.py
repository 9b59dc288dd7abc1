"""The monitor as a ROS 2 node: reads the loop's topics now and then, calls its services when asked.

Subscribes  episode/start, policy, episode/cost, episode/paused, target, /diagnostics;
            samples (of a plant without them state and action) while somebody looks, and no more of
            them than monitor.attention allows
Calls       NODE/pause, resume, step, stop (std_srvs/Trigger) of the loop's nodes
What it learns goes into monitor.view.
"""

from __future__ import annotations

import contextlib
import os
import queue
import signal
import threading
import time
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.node import Node

from loop_interfaces.isolation import keep_on_this_machine
from loop_interfaces.ros.introspection import NAMELESS
from loop_interfaces.ros.node_loop import NodeLoop
from loop_interfaces.ros.node_main import ConfigurationError, ros_node
from loop_interfaces.ros.parameters import RemoteParameters
from loop_interfaces.topics import COST, PAUSED, POLICY, START, TARGET, Topic
from pde_sim_node.equations import EQUATIONS
from pdeloop.display import ProgressFile
from pdeloop.live import Live
from pdeloop.monitor.finder import Finder, run_id
from pdeloop.monitor.read_budget import Attention
from pdeloop.monitor.service_call import ServiceCall
from viewer_node.loop_nodes import ROLES, Endpoint
from viewer_node.loop_reader import DRAIN, Handler, Reader, Samples, drain
from viewer_node.web.page import View
from viewer_node.web.requests import VERBS, Commands, Watch

REFRESH = 0.5
"""Seconds between two looks at rates and at the progress of the run."""
LOOK = 1.0
"""Seconds between two looks at the graph and at which loop runs."""


class MonitorNode:
    """Watches one loop in one ROS domain.

    namespace: of the pair to watch; None: the first one that is found. watched: whether somebody
    looks at the page.
    """

    def __init__(
        self,
        node: Node,
        loop: NodeLoop,
        view: View,
        live: Live,
        *,
        finder: Finder,
        namespace: str | None,
        commands: Commands,
        watched: Callable[[], bool],
    ) -> None:
        self._node, self._loop, self._view, self._live = node, loop, view, live
        self._finder, self._commands, self._watched = finder, commands, watched
        self._namespace = namespace
        self._given = namespace is not None
        self._attention = Attention()
        self._latched: list[Reader] = []
        self._samples: Samples | None = None
        self._calls: list[ServiceCall] = []
        self._asked: dict[bytes, RemoteParameters] = {}
        self._progress: ProgressFile | None = None
        self._out: Path | None = None
        self._refresh_at = self._look_at = 0.0
        node.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, 10)
        self._begin(namespace)

    def run(self) -> str:
        """Watch until a signal comes, or another loop is to be watched; the reason."""
        return self._loop.run(
            tick=self._tick, deadline=lambda: 0.0, housekeeping=self._housekeeping
        )

    def _begin(self, namespace: str | None) -> None:
        """Watch the loop in `namespace`."""
        for reader in self._latched:
            reader.close()
        self._stop_reading()
        self._latched, self._attention = [], Attention()
        self._namespace = namespace
        folder = self._live.folder
        self._progress = _progress(folder)
        place: dict[str, Any] = {
            "domain": self._live.domain,
            "folder": None if folder is None else _short(folder),
            "namespace": namespace,
            "namespaces": [],
        }
        self._view.watch(place, run=self._finder.only_run, from_topics=self._progress is None)
        if namespace is not None:
            view = self._view
            handlers: dict[Topic, Handler] = {
                START: view.start,
                POLICY: view.policy,
                PAUSED: view.paused,
                COST: view.cost,
                TARGET: view.target,
            }
            self._latched = [
                Reader(self._node, topic, self._name(topic), handle)
                for topic, handle in handlers.items()
            ]

    def _stop_reading(self) -> None:
        if self._samples is not None:
            self._samples.close()
            self._samples = None

    def _name(self, topic: Topic | str) -> str:
        name = topic if isinstance(topic, str) else topic.name
        return f"{(self._namespace or '').rstrip('/')}/{name}"

    def _tick(self, now: float) -> None:
        time.sleep(DRAIN)
        self._attention.took(*drain(self._latched[:3], self._samples, self._latched[3:]))
        namespace = self._namespace
        wanted = namespace is not None and self._attention.decide(
            now, watched=self._watched(), complete=self._view.complete
        )
        if not wanted:
            self._stop_reading()
        elif self._samples is None and namespace is not None:
            self._samples = Samples(self._node, namespace, self._view.state, self._view.action)

    def _housekeeping(self, now: float) -> None:
        self._obey()
        if self._samples is not None:
            self._samples.look()
        self._calls = [call for call in self._calls if not call.poll()]
        for parameters in self._asked.values():
            if parameters.values is None:
                parameters.poll()
                if parameters.values is not None:
                    self._learn(parameters.values)
        if now >= self._look_at:
            self._look_at = now + LOOK
            self._look()
            if self._finder.find() != self._live:
                self._loop.stop("moved")
        if now >= self._refresh_at:
            self._refresh_at = now + REFRESH
            self._follow()
            if self._progress is not None:
                self._view.progress(self._progress.rows())
            self._view.refresh(now)

    def _obey(self) -> None:
        """Take what the page asks for."""
        while True:
            try:
                command = self._commands.get_nowait()
            except queue.Empty:
                return
            if isinstance(command, Watch):
                self._given = True
                self._begin(command.namespace)
                self._look_at = 0.0
            else:
                self._calls.append(ServiceCall(self._node, command, self._view))

    def _look(self) -> None:
        found = self._namespaces()
        if not self._given and found and self._namespace not in found:
            self._begin(found[0])
        self._view.namespaces(found)
        by_role: dict[str, list[Endpoint]] = {}
        for role, topic in ROLES.items():
            by_role[role] = []
            for endpoint in self._node.get_publishers_info_by_topic(self._name(topic)):
                if endpoint.node_name == NAMELESS:
                    continue
                name = f"{endpoint.node_namespace.rstrip('/')}/{endpoint.node_name}"
                process = bytes(endpoint.endpoint_gid)[:12]
                by_role[role].append(Endpoint(name, process))
                if role != "controller" and process not in self._asked:
                    self._asked[process] = RemoteParameters(self._node, name)
        alive = {endpoint.process for found in by_role.values() for endpoint in found}
        for process in set(self._asked) - alive:
            self._asked.pop(process).close()
        self._view.look(by_role, self._controls(by_role))

    def _namespaces(self) -> list[str]:
        """Namespaces in which somebody publishes what a node of a loop does."""
        found = set()
        for name, _ in self._node.get_topic_names_and_types():
            for topic in ROLES.values():
                if name.endswith(f"/{topic}") and self._node.count_publishers(name):
                    found.add(name.removesuffix(f"/{topic}") or "/")
        return sorted(found)

    def _controls(self, by_role: dict[str, list[Endpoint]]) -> list[dict[str, Any]]:
        """Which services the nodes of the loop offer."""
        offered: dict[str, set[str]] = {}
        for name, types in self._node.get_service_names_and_types():
            node, _, verb = name.rpartition("/")
            if verb in VERBS and "std_srvs/srv/Trigger" in types:
                offered.setdefault(node, set()).add(verb)
        return [
            {"role": role, "node": name, "verbs": [v for v in VERBS if v in offered[name]]}
            for role, endpoints in by_role.items()
            for name in sorted({endpoint.name for endpoint in endpoints})
            if name in offered
        ]

    def _learn(self, values: dict[str, Any]) -> None:
        """Take a node's parameters; the tuner's may say where its run's folder is."""
        self._view.parameters(values)
        if values.get("sensors"):
            count = int(values.get("sensor_delays") or 1)
            self._view.components(["y", *(f"y {k} ago" for k in range(1, count))])
        elif values.get("equation") in EQUATIONS:
            self._view.components(EQUATIONS[values["equation"]].components)
        out = values.get("out")
        self._out = Path(out) if isinstance(out, str) and out else self._out

    def _follow(self) -> None:
        """Take the curve from the folder that the tuner told, if its run is the one on the topics."""
        if self._progress is None and self._out is not None:
            run = self._view.run
            if run and run_id(self._out) == run:
                self._progress = _progress(self._out)
                self._view.follow(_short(self._out))

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        now = time.monotonic()
        for status in message.status:
            values = [(str(v.key), str(v.value)) for v in status.values]
            level = status.level[0] if isinstance(status.level, bytes) else int(status.level)
            self._view.diagnosis(str(status.name), level, str(status.message), values, now)


def _progress(folder: Path | None) -> ProgressFile | None:
    """The progress of the run in `folder`, if there is a run."""
    if folder is None or run_id(folder) is None:
        return None
    return ProgressFile(folder / "progress.jsonl", past=True)


def _short(folder: Path) -> str:
    with contextlib.suppress(ValueError):
        return str(folder.resolve().relative_to(Path.cwd()))
    return str(folder)


def stand_back() -> None:
    """Let the loop's processes go first: a message that arrives here must not preempt its sender."""
    with contextlib.suppress(OSError, AttributeError):
        os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))
        os.nice(19)


def watch(
    view: View,
    finder: Finder,
    commands: Commands,
    *,
    namespace: str | None,
    watched: Callable[[], bool],
    network: bool,
) -> None:
    """Watch what `finder` finds, one loop after the other, until SIGINT or SIGTERM."""
    stop = threading.Event()

    def on_signal(number: int, frame: FrameType | None) -> None:
        stop.set()

    while not stop.is_set():
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, on_signal)
        live = finder.find()
        if live is None:
            view.refresh(time.monotonic())
            stop.wait(REFRESH)
            continue
        if not (network or live.network):
            keep_on_this_machine()
        os.environ["ROS_DOMAIN_ID"] = str(live.domain)
        with ros_node("monitor", ["--ros-args", "--disable-external-lib-logs"]) as (node, loop):
            body = MonitorNode(
                node,
                loop,
                view,
                live,
                finder=finder,
                namespace=namespace,
                commands=commands,
                watched=watched,
            )
            if body.run().startswith("SIG"):
                return


__all__ = ["ConfigurationError", "MonitorNode", "stand_back", "watch"]
