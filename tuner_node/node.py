# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""tuner_node: identifies, designs and adapts over topics, as a ROS 2 node.

For each pair of plant and controller, in its namespace:
Publishes   policy, episode/start, model
Subscribes  episode/cost, episode/paused, target, model/identified, model/failed, samples
Serves      ~/pause, ~/resume, ~/stop (std_srvs/Trigger)
Messages and their order: docs/protocol.md. The work itself: tuner_node.session.
"""

import contextlib
import os
import sys
import time
from collections import deque
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from rclpy.node import Node
from std_msgs.msg import String

from pdeloop.messages import topics
from pdeloop.messages.frames import Frame
from pdeloop.messages.parameters import TUNER, taken_by, with_budget
from pdeloop.messages.protocol import NO_CONTROLLER, STOPPED, ModelFailure
from pdeloop.messages.spec import FREE
from pdeloop.process.isolation import keep_on_this_machine
from pdeloop.process.ros_environment import steering
from pdeloop.ros.endpoints import Sender, reader_qos, samples_qos, scoped
from pdeloop.ros.introspection import full_name, matched_processes, process_of
from pdeloop.ros.node_loop import NodeLoop
from pdeloop.ros.node_main import ConfigurationError, node_main
from pdeloop.ros.parameters import declare, given_parameters, on_change
from pdeloop.ros.suspend_watchdog import sleep_for
from tuner_node import narration
from tuner_node.batch import ContradictionError, DispatchError, NoModelError
from tuner_node.build import build_dispatcher, build_training, remarks_on
from tuner_node.diagnostics import TunerDiagnostics
from tuner_node.narration import Narration
from tuner_node.optimizer_parameters import setting_specs, with_settings
from tuner_node.pair import PairPublication
from tuner_node.results import summarise
from tuner_node.run_store import open_run
from tuner_node.session import Participants, Publishers, Session

SETTLE = 0.3
"""Grace period (s) for contradictions after the last episode."""
LINGER = 0.5
"""Seconds after an early end in which the last messages, and the answer to a request to stop, are
taken: when a writer is gone, its readers lose what they have not taken yet."""
NAMES_KNOWN = 1.0
"""Seconds to wait at the end for the names of publishers, which are discovered after them."""
PROGRESS_PERIOD = 2.0
"""Seconds between two lines on how far the adaptation is."""
ABSENCE_REPORT = 5.0
"""Seconds between two reports of a missing plant or controller."""


def declare_parameters(node: Node) -> dict[str, Any]:
    """The tuner's parameters, and the problem's, which together define the training."""
    given = given_parameters(node, "tuner_node")
    values = with_budget(declare(node, taken_by("tuner_node"), given))
    # Those of the equation are the plant's to check; here they only identify the run.
    values |= {name: value for name, value in given.items() if name.startswith(FREE)}
    return with_settings(values) | declare(node, setting_specs(values), given)


class TunerNode:
    """Moves messages between the topics and the session, and keeps the run folder."""

    def __init__(self, node: Node, loop: NodeLoop, locks: contextlib.ExitStack) -> None:
        """locks: the run folder is locked until it is closed."""
        values = declare_parameters(node)
        log = node.get_logger()
        training = build_training(values)
        self._writer, identity = open_run(values, training, locks, log.warning)
        self._rows: deque[Mapping[str, Any]] = deque()
        self._problem, self._out = values["problem"], values["out"]
        self._narration = Narration(values["seed"], values["seeds"])
        dispatcher = build_dispatcher(values, training, identity)
        for remark in remarks_on(values):
            log.warning(remark)
        if identity.paused:
            dispatcher.pause()
            log.warning(
                "still paused, as it was when its previous process ended; call ~/resume to continue"
            )
        self._session = Session(training, dispatcher, self._rows.append)
        self._diagnostics = TunerDiagnostics(self._session)
        self._participants = Participants(self._session, values["recorder"])
        self._pairs: list[str] = values["pairs"]
        self._failure: DispatchError | None = None
        self._settled: float | None = None
        """The time when results become final, once all rollouts are done."""
        self._several_publishers: dict[str, list[str]] = {}
        self._wire(node, loop)
        log.info(f"run {identity.run} of {values['problem']}, seed {values['seed']}")

    def run(self) -> int:
        """Train to the end; 0 when done, 130 when interrupted, STOPPED on request."""
        self._guarded(self._session.begin)
        reason = self._loop.run(
            self._housekeeping,
            tick=lambda now: self._loop.stop("done"),
            deadline=lambda: self._settled,
        )
        if self._loop.suspended:
            return 0
        self._send(self._session.dispatcher.release())
        finished = self._session.done and self._failure is None
        try:
            return self._finish() if finished else self._end(reason)
        finally:
            sleep_for(LINGER - SETTLE * finished)

    def _end(self, reason: str) -> int:
        contradicted = isinstance(self._failure, ContradictionError)
        if self._writer and contradicted:
            self._writer.give_up(str(self._failure))
        elif self._writer:
            self._writer.keep(now=self._loop.now(), force=True)
        if self._writer and isinstance(self._failure, NoModelError):
            self._writer.fail(str(self._failure))
        if self._failure:
            told = narration.several_publishers(self._all_several_publishers())
            raise ConfigurationError("; ".join([str(self._failure), *told]))
        if self._session.stopped:
            self._log.info("stopped on request")
            return STOPPED
        again = "; continue with -p resume:=true" if self._writer else ""
        self._log.info(f"stopped by {reason} before the end{again}")
        return 130

    def join(self, node: Node, loop: NodeLoop) -> None:
        self._several_publishers |= self._loop.introspection.several_publishers
        self._wire(node, loop)

    def _wire(self, node: Node, loop: NodeLoop) -> None:
        self._node, self._loop, self._log = node, loop, node.get_logger()
        self._senders: list[dict[str, Sender]] = []
        session, dispatcher = self._session, self._session.dispatcher
        published = topics.POLICY, topics.START, topics.MODEL
        for number, namespace in enumerate(self._pairs):
            self._senders.append({t.name: loop.sender(t, namespace) for t in published})
            # The target before the costs: what has come in with one is then taken before it.
            handlers = {
                topics.TARGET: dispatcher.target,
                topics.COST: dispatcher.cost,
                topics.MODEL_IDENTIFIED: dispatcher.model,
                topics.PAUSED: dispatcher.plant_paused,
            }
            if session.training.settings.trajectories:
                on_state = partial(self._on_state, number)
                loop.observe(namespace, on_state, partial(dispatcher.action, number))
            for topic, handle in handlers.items():
                loop.receive(topic, self._handler(handle, number), namespace)
            failed, qos = scoped(namespace, topics.MODEL_FAILED), reader_qos(topics.MODEL)
            node.create_subscription(String, failed, partial(self._on_failure, number), qos)
            supervised = {topic.name: reader_qos(topic) for topic in topics.ARRAYS}
            supervised |= {topics.MODEL_FAILED: qos, topics.SAMPLES: samples_qos(1)}
            for name, asked in supervised.items():
                loop.introspection.supervise(self._full_name(namespace, name), asked)
        loop.introspection.report("training", self._diagnostics.report)
        loop.introspection.offer("~/pause", self._pause)
        loop.introspection.offer("~/resume", self._resume)
        loop.introspection.offer("~/stop", self._stop)
        on_change(node, TUNER, self._adjust)

    def _full_name(self, namespace: str, topic: str) -> str:
        return self._node.resolve_topic_name(scoped(namespace, topic))

    def _pause(self) -> str:
        self._session.dispatcher.pause()
        if self._writer:
            self._writer.hold(True)
        under_way = len(self._session.dispatcher.episodes())
        return "paused" + (
            f"; {under_way} episode(s) under way will be completed" if under_way else ""
        )

    def _resume(self) -> str:
        was = "resumed" if self._session.dispatcher.paused else "was not paused"
        self._guarded(self._session.dispatcher.resume)
        if self._writer:
            self._writer.hold(False)
        return was

    def _stop(self) -> str:
        self._guarded(lambda now: self._session.stop())
        if self._writer:
            self._writer.hold(False)  # the run is continued deliberately
        if self._session.stopped:
            return "stopping now"
        return "stopping after the rollouts under way" + (
            ", which are waiting for a paused plant"
            if self._session.dispatcher.paused_pairs(self._loop.now())
            else ""
        )

    def _adjust(self, values: dict[str, Any]) -> None:
        for name, value in values.items():
            setattr(self._session.dispatcher, name, value)

    def _on_state(self, pair: int, frame: Frame) -> None:
        if self._session.dispatcher.state(pair, frame):
            self._guarded(self._session.dispatcher.tick)

    def _handler(
        self, handle: Callable[[int, Frame, float], list[PairPublication]], pair: int
    ) -> Callable[[Frame], None]:
        return lambda frame: self._guarded(lambda now: handle(pair, frame, now))

    def _on_failure(self, pair: int, message: String) -> None:
        try:
            failure = ModelFailure.from_json(message.data)
        except ValueError as error:
            self._log.warning(str(error), throttle_duration_sec=1.0)
            return
        self._guarded(lambda now: self._session.dispatcher.failure(pair, failure, now))

    def _guarded(self, event: Callable[[float], list[PairPublication]]) -> None:
        """Perform what an event of the dispatcher or the session leads to."""
        session = self._session
        try:
            with self._loop.introspection.working(session.training.computation):
                now = self._loop.now()
                publications = session.advance(event(now), now)
            self._send(publications)
        except DispatchError as error:
            self._failure = self._failure or error
            self._loop.stop("failure")
        while self._rows:  # after the messages, which others wait for, and before the checkpoint
            self._report(self._rows.popleft())
        if self._writer and self._failure is None:
            with self._loop.introspection.working("writing the checkpoint"):
                self._writer.keep(now=self._loop.now())
        if session.stopped:
            self._loop.stop("done")
        elif session.done and self._settled is None:
            self._settled = self._loop.now() + SETTLE

    def _send(self, publications: list[PairPublication]) -> None:
        for pair, publication in publications:
            self._senders[pair][publication.topic.name].send(publication.frame)

    def _housekeeping(self, now: float) -> None:
        if self._loop.stopped:  # by a service, in this round
            return
        self._guarded(partial(self._participants.update, self._publishers()))
        missing, seconds = self._diagnostics.absent(now)
        if missing:
            hint = "; do they use this ROS_DOMAIN_ID, namespace and DDS profile?"
            if others := steering(os.environ):
                hint += f" Set here: {others}"
            self._log.warning(
                f"waiting for {' and '.join(missing)} for {seconds:.0f} s"
                + (hint if seconds > 2 * ABSENCE_REPORT else ""),
                throttle_duration_sec=ABSENCE_REPORT,
            )
        if text := self._participants.newly_paused(now):
            self._log.info(text)

    def _publishers(self) -> Publishers:
        def count(topic: str) -> list[tuple[str, int]]:
            names = [self._full_name(namespace, topic) for namespace in self._pairs]
            return [(name, self._node.count_publishers(name)) for name in names]

        status = self._full_name("", topics.RECORDER_STATUS)
        recorders = {process_of(there) for there in self._node.get_publishers_info_by_topic(status)}
        unmatched = set[bytes]()
        if self._participants.awaits_recorder:
            for senders in self._senders:
                publisher = senders[topics.START.name].publisher
                unmatched |= recorders - matched_processes(self._node, publisher)
        return Publishers(
            plants=[there for _, there in count(topics.COST.name)],
            controllers=[there for _, there in count(topics.MODEL_IDENTIFIED.name)],
            tuners=dict(count(topics.START.name)),
            recorders=len(recorders),
            unmatched=len(unmatched),
        )

    def _report(self, row: Mapping[str, Any]) -> None:
        if self._writer:
            self._writer.note(row)
        for line in self._narration.lines(row):
            if row["event"] == "repeated":
                self._log.warning(line)
            else:  # a call of its own: rclpy refuses another severity at the same place
                self._log.info(line)
        if row["event"] == "adapted":  # hundreds a second of a small problem
            self._log.info(self._narration.progress, throttle_duration_sec=PROGRESS_PERIOD)

    def _controller(self) -> dict[str, Any]:
        """The controller that answered the states, and its law if that was seen."""
        found = {
            full_name(there)
            for namespace in self._pairs
            for there in self._node.get_publishers_info_by_topic(
                self._full_name(namespace, topics.ACTION.name)
            )
        }
        training = self._session.training
        law = training.settings.law.name if training.law_seen else "not seen"
        return {"nodes": sorted(found), "law": law}

    def _all_several_publishers(self) -> dict[str, list[str]]:
        """The nodes of every topic that has had more than one publisher."""
        introspection, deadline = self._loop.introspection, time.monotonic() + NAMES_KNOWN
        while (
            not introspection.look_at_publishers(self._loop.now()) and time.monotonic() < deadline
        ):
            sleep_for(0.05)
        return self._several_publishers | self._loop.introspection.several_publishers

    def _finish(self) -> int:
        if self._writer:
            try:
                summary = self._writer.finish(
                    {
                        "transport": "topics",
                        "controller": self._controller(),
                        "several_publishers": self._all_several_publishers(),
                    }
                )
            except OSError as error:
                raise ConfigurationError(f"cannot write the results: {error.strerror}") from error
        else:
            summary = summarise(self._session.training)
        for line in narration.closing_lines(self._problem, summary, self._out):
            self._log.info(line)
        for line in narration.warnings(summary):
            self._log.warning(line)
        return NO_CONTROLLER if narration.failed(summary) else 0


def main(args: list[str] | None = None) -> int:
    """Console script."""
    keep_on_this_machine()
    with contextlib.ExitStack() as locks:

        def make(node: Node, loop: NodeLoop) -> TunerNode:
            return TunerNode(node, loop, locks)

        return node_main("tuner_node", args, make)


if __name__ == "__main__":
    sys.exit(main())
