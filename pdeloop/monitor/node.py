# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The monitor as a ROS 2 node: reads the loop's topics now and then, calls its services when asked.

Subscribes  episode/start, policy, model, episode/cost, episode/paused, target, /diagnostics;
            samples_throttled (of a plant without it state and action) while a page is open
Calls       NODE/pause, resume, step, stop (std_srvs/Trigger) of the loop's nodes
What it reads goes into the view core (viewer_node.loop_view), and to the page (viewer_node.web).
"""

from __future__ import annotations

import contextlib
import os
import queue
import signal
import threading
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from rclpy.node import Node

from pde_sim_node.equations import EQUATIONS
from pdeloop.display import ProgressFile
from pdeloop.domain import Live
from pdeloop.messages.grid import Grid
from pdeloop.monitor.finder import Finder, run_id
from pdeloop.monitor.service_call import ServiceCall
from pdeloop.process.isolation import keep_on_this_machine
from pdeloop.ros.node_main import ros_node
from pdeloop.ros.observer import Observer
from pdeloop.ros.peers import Peers
from viewer_node.episode_samples import EpisodeSamples
from viewer_node.learning_curve import LearningCurve
from viewer_node.loop_nodes import ROLES, VERBS, Call, Endpoint
from viewer_node.loop_reader import PERIOD, LoopReader
from viewer_node.loop_view import LoopView
from viewer_node.web.page import Page, ShowLoop

REQUEST_PERIOD = 0.1
"""Period (s) of serving the page's requests and of polling the answers of nodes."""
GRAPH_PERIOD = 1.0
"""Period (s) of polling the ROS graph, and which loop runs."""
KEPT = 20.0
"""Seconds after which another episode is read while no page is open, for the one that will be."""
REFRESH = 0.5
"""Period (s) of updating rates and progress."""


class MonitorNode:
    """Shows one loop in one ROS domain.

    namespace: of the pair to show; None: the first one that is found.
    """

    def __init__(
        self,
        node: Node,
        loop: Observer,
        page: Page,
        live: Live,
        *,
        finder: Finder,
        namespace: str | None,
    ) -> None:
        self._node, self._loop, self._page, self._live = node, loop, page, live
        self._finder, self._given = finder, namespace is not None
        self._reader: LoopReader | None = None
        self._kept: EpisodeSamples | None = None
        self._kept_at = 0.0
        self._calls: list[ServiceCall] = []
        self._peers = Peers(node)
        self._out: Path | None = None
        node.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, 10)
        self._begin(namespace)
        for period, callback in (
            (PERIOD, self._read),
            (REQUEST_PERIOD, self._serve_requests),
            (GRAPH_PERIOD, self._poll_graph),
            (REFRESH, self._refresh),
        ):
            loop.every(period, callback)

    def run(self) -> str:
        """Run until a signal comes, or another loop must be shown; returns the reason."""
        return self._loop.run()

    def _begin(self, namespace: str | None) -> None:
        if self._reader is not None:
            self._reader.close()
        self._namespace = namespace
        folder = self._live.folder
        self._progress = _progress(folder)
        from_topics = self._progress is None
        self._view = LoopView(only=self._finder.only_run, curve_from_topics=from_topics)
        self._page.show(
            self._view,
            domain=self._live.domain,
            folder=None if folder is None else short(folder),
            namespace=namespace,
        )
        self._reader = None
        if namespace is not None:
            self._reader = LoopReader(self._node, namespace, self._view)

    def _read(self) -> None:
        if self._reader is None:
            return
        with self._page.lock:
            self._reader.read()
        now = self._loop.now()
        if self._view.finished is not self._kept:
            self._kept, self._kept_at = self._view.finished, now
        # A page that is opened later has an episode to show at once.
        self._reader.listen(self._page.open or self._kept is None or now - self._kept_at > KEPT)

    def _serve_requests(self) -> None:
        with contextlib.suppress(queue.Empty):
            while True:
                self._serve(self._page.requests.get_nowait())
        with self._page.lock:
            self._calls = [call for call in self._calls if not call.poll(self._view.operation)]
            for peer in self._peers.poll():
                self._take_parameters(peer.values or {})

    def _serve(self, request: object) -> None:
        if isinstance(request, ShowLoop):
            self._given = True
            self._begin(request.namespace)
            self._poll_graph()
        elif isinstance(request, Call):
            self._calls.append(ServiceCall(self._node, request))
            with self._page.lock:
                self._view.operation.asked(request, self._loop.now())
            self._page.refresh(self._loop.now())

    def _poll_graph(self) -> None:
        """Update which nodes there are, and which loop must be shown."""
        if self._finder.find() != self._live:
            self._loop.stop("moved")
        if self._reader is not None:
            self._reader.poll_graph()
        found = self._namespaces()
        if not self._given and found and self._namespace not in found:
            self._begin(found[0])
        prefix = (self._namespace or "").rstrip("/")
        topics = {role: f"{prefix}/{topic}" for role, topic in ROLES.items()}
        there = self._peers.look(topics.values(), self._loop.now())
        by_role = {
            role: [Endpoint(peer.name, peer.process) for peer in there[topic] if peer.name]
            for role, topic in topics.items()
        }
        with self._page.lock:
            self._page.place["namespaces"] = found
            self._view.nodes.update(by_role)
            self._page.controls = self._controls(by_role)

    def _refresh(self) -> None:
        with self._page.lock:
            self._follow()
            if self._progress is not None:
                for row in self._progress.rows():
                    self._view.curve.row(row)
        self._page.refresh(self._loop.now())

    def _namespaces(self) -> list[str]:
        """Namespaces with a publisher of a topic of the loop's nodes."""
        found = set()
        for name, _ in self._node.get_topic_names_and_types():
            for topic in ROLES.values():
                if name.endswith(f"/{topic}") and self._node.count_publishers(name):
                    found.add(name.removesuffix(f"/{topic}") or "/")
        return sorted(found)

    def _controls(self, by_role: dict[str, list[Endpoint]]) -> list[dict[str, Any]]:
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

    def _take_parameters(self, values: dict[str, Any]) -> None:
        """Take a node's parameters; the tuner's may name its run's folder."""
        self._page.take_parameters(values)
        if "equation" in values:
            self._view.components = component_names(values)
        out = values.get("out")
        self._out = Path(out) if isinstance(out, str) and out else self._out

    def _follow(self) -> None:
        """Take the curve from the tuner's folder (`out`), if its run is the one on the topics."""
        if self._progress is None and self._out is not None:
            run = self._view.run
            if run and run_id(self._out) == run:
                self._progress = _progress(self._out)
                self._page.place["folder"] = short(self._out)
                self._view.curve_from_topics, self._view.curve = False, LearningCurve()

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        now = self._loop.now()
        with self._page.lock:
            for status in message.status:
                values = [(str(v.key), str(v.value)) for v in status.values]
                level = status.level[0] if isinstance(status.level, bytes) else int(status.level)
                name, text = str(status.name), str(status.message)
                self._view.nodes.diagnosis(name, level, text, values, now)


def _progress(folder: Path | None) -> ProgressFile | None:
    """The progress of the run in `folder`, if there is a run."""
    if folder is None or run_id(folder) is None:
        return None
    return ProgressFile(folder / "progress.jsonl", past=True)


def component_names(values: Mapping[str, Any]) -> list[str]:
    """Names of the components that make up a state, from a plant's parameters."""
    if values.get("sensors"):
        count = int(values.get("sensor_delays") or 1)
        return ["y", *(f"y {k} ago" for k in range(1, count))]
    if values.get("grid"):
        with contextlib.suppress(ValueError):
            return [part.name for part in Grid.parse(str(values["grid"])).parts]
    equation = EQUATIONS.get(str(values.get("equation")))
    return ["u"] if equation is None else list(equation.components)


def short(folder: Path) -> str:
    """The folder as a person in the working directory writes it."""
    with contextlib.suppress(ValueError):
        return str(folder.resolve().relative_to(Path.cwd()))
    return str(folder)


def show_loops(page: Page, finder: Finder, *, namespace: str | None, network: bool) -> None:
    """Show what `finder` finds, one loop after the other, until SIGINT or SIGTERM."""
    while True:
        stop = threading.Event()
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, lambda *_, stop=stop: stop.set())
        while (live := finder.find()) is None:
            page.refresh(time.monotonic())
            if stop.wait(REFRESH):
                return
        if not (network or live.network):
            keep_on_this_machine()
        os.environ["ROS_DOMAIN_ID"] = str(live.domain)
        options = ["--ros-args", "--disable-external-lib-logs"]
        with ros_node("monitor", options, Observer) as (node, loop):
            if stop.is_set():  # while the loop was looked for, or the node did not exist yet
                return
            MonitorNode(node, loop, page, live, finder=finder, namespace=namespace).run()
        if loop.stop_reason.startswith("SIG"):  # also while the node was destroyed
            return
