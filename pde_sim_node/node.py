# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""pde_sim_node: the plant as a ROS 2 node.

Subscribes  episode/start, action
Publishes   state, episode/cost, target, episode/paused, samples, /clock
Serves      ~/pause, ~/resume, ~/step (std_srvs/Trigger)
Messages and their order: docs/protocol.md. The protocol is pde_sim_node.lockstep.
"""

import sys
from dataclasses import fields
from importlib import import_module
from importlib.util import find_spec
from typing import Any

import numpy as np
from rcl_interfaces.msg import ParameterDescriptor
from rclpy.node import Node
from rosgraph_msgs.msg import Clock

from pde_sim_node.build import complete
from pde_sim_node.diagnostics import PlantDiagnostics
from pde_sim_node.equations import configured_equation
from pde_sim_node.lockstep import Lockstep
from pde_sim_node.plant import Plant
from pde_sim_node.plants.loading import PHYSICAL, physical_of
from pde_sim_node.real_time import Timing
from pde_sim_node.run_record import RunRecord
from pdeloop.messages.actuators import boxes_of, text_of
from pdeloop.messages.files import FileError
from pdeloop.messages.frames import Frame
from pdeloop.messages.parameters import PLANT, taken_by
from pdeloop.messages.problem import own_values
from pdeloop.messages.protocol import Publication
from pdeloop.messages.samples import ACTION_KIND, clock_message
from pdeloop.messages.spec import Spec, check
from pdeloop.messages.topics import ACTION, COST, PAUSED, START, STATE, TARGET, episode_name
from pdeloop.process.affinity import pin_process
from pdeloop.process.isolation import keep_on_this_machine
from pdeloop.ros.node_loop import NodeLoop
from pdeloop.ros.node_main import node_main
from pdeloop.ros.parameters import declare, given_parameters, on_change

FAST_PATH = import_module("pde_sim_node.fast_path") if find_spec("pdeloop.fast_path") else None
"""Answers actions in compiled code, where that can be had; without it the lock-step answers all."""


def declare_parameters(node: Node) -> tuple[Plant, dict[str, Any]]:
    """The plant, and its parameters, with those of the equation or plant itself under `physical.`."""
    given = given_parameters(node, "pde_sim_node")
    physical = {name: value for name, value in given.items() if name.startswith("physical.")}
    said = [spec for spec in taken_by("pde_sim_node") if spec.name == "grid"]  # by the plant
    specs = [spec for spec in taken_by("pde_sim_node") if spec not in said]
    if given.get("plant"):
        plant, values = complete(own_values(given, check(specs, given)) | physical)
        declare(node, specs, values)
        for name in physical_of(values):
            of_it = ParameterDescriptor(description="a parameter of the plant", read_only=True)
            node.declare_parameter(PHYSICAL + name, values[PHYSICAL + name], of_it, True)
    else:
        values = declare(node, specs, given)
        values |= physical | declare(node, physical_specs(str(values["equation"])), given)
        plant, values = complete(values)
    declare(node, said, values)
    told = ParameterDescriptor(
        description="where each actuator acts: component, and low and high along each axis, in m",
        read_only=True,
    )
    node.declare_parameter("actuators", actuators_of(plant), told, True)
    return plant, values


def actuators_of(plant: Plant) -> str:
    """Positions of the actuators, for pictures; empty if the plant does not know them."""
    if plant.supports is None:
        return ""
    everywhere = np.zeros((plant.n_z, plant.n_a))
    everywhere[plant.forced] = plant.supports
    return text_of(boxes_of(plant.grid, everywhere))


def physical_specs(equation: str) -> list[Spec]:
    """The parameters of an equation, under `physical.`."""
    return [
        Spec(
            f"physical.{item.name}",
            float(item.default),  # type: ignore[arg-type]
            item.metadata["minimum"],
            item.metadata["maximum"],
            unit=item.metadata.get("unit", ""),
        ).means(item.metadata["description"])
        for item in fields(configured_equation(equation))
        if item.name != "length"
    ]


class PlantNode:
    """Moves messages between the topics and the lock-step protocol."""

    def __init__(self, node: Node, loop: NodeLoop) -> None:
        plant, values = declare_parameters(node)
        pin_process(values["pin"])
        if FAST_PATH and plant.parallel is not None:
            # Before there is a publisher: a peer that discovers one expects answers.
            FAST_PATH.load_compiled()
        domain = node.context.get_domain_id()
        self._run_record = RunRecord(node.get_fully_qualified_name(), domain)
        self._lockstep = Lockstep(
            plant,
            Timing(**{spec.name: values[spec.name] for spec in PLANT if spec.live}),
            fingerprint=plant.definition.fingerprint,
            paused=self._run_record.paused,
            signed_run=self._run_record.signed,
        )
        self._diagnostics = PlantDiagnostics(self._lockstep)
        self._paced = self._lockstep.pacer is not None
        self._timed: bool = values["publish_clock"]
        self.join(node, loop)
        node.get_logger().info(
            f"{values['problem']}: {plant.n_z} points, {plant.n_a} actuators, "
            f"{plant.horizon} steps of {values['sample_time']:g} s"
        )
        if self._lockstep.paused:
            node.get_logger().warning(
                "still paused, as it was when its previous process ended; call ~/resume to continue"
            )

    def join(self, node: Node, loop: NodeLoop) -> None:
        self._node, self._loop = node, loop
        self._batcher = loop.batcher
        self._senders = {
            STATE: loop.sender(STATE, sampled=True),
            COST: loop.sender(COST),
            TARGET: loop.sender(TARGET),
            PAUSED: loop.sender(PAUSED),
        }
        self._clock = node.create_publisher(Clock, "/clock", 1) if self._timed else None
        self._batcher.timed = self._timed
        self._clock_wanted = False
        loop.receive(START, self._on_start)
        self._actions = actions = loop.receive(ACTION, self._on_action)
        self._fast_path: Any = None
        if FAST_PATH and self._lockstep.plant.parallel is not None:
            self._fast_path = FAST_PATH.PlantFastPath(self._lockstep, actions.codec, self._batcher)
            loop.answer_fast(actions, self._senders[STATE], self._fast_path)
        loop.introspection.report("lock-step", self._diagnostics.report)
        loop.introspection.offer("~/pause", self._pause)
        loop.introspection.offer("~/resume", self._resume)
        loop.introspection.offer("~/step", self._step)
        on_change(node, PLANT, self._adjust)
        self._send([self._lockstep.announcement(), self._lockstep.paused_report()])

    def run(self) -> int:
        lockstep = self._lockstep
        self._loop.run(
            self._housekeeping,
            tick=lambda now: self._send(lockstep.tick(now)),
            deadline=lambda: lockstep.deadline,
        )
        if not self._loop.suspended:
            self._report_pace()
        return 0

    def _pause(self) -> str:
        self._send(self._lockstep.pause(self._loop.now()))
        self._record_run()
        last = self._lockstep.last_state
        self._batcher.show(self._senders[STATE].encoded(last) if last else None)
        return f"paused at step {self._lockstep.step}; an answer on its way is still accepted"

    def _resume(self) -> str:
        was = "resumed" if self._lockstep.paused else "was not paused"
        self._send(self._lockstep.resume(self._loop.now()))
        self._record_run()
        return was

    def _record_run(self) -> None:
        """Record the run, so that a restarted plant stays paused and asks for the run's signatures."""
        lockstep = self._lockstep
        try:
            self._run_record.keep(lockstep.paused, lockstep.signed_run)
        except (OSError, FileError) as error:
            self._node.get_logger().warning(
                "cannot record a pause and a signing controller, which are lost when this "
                f"process ends: {error}",
                throttle_duration_sec=10.0,
            )

    def _step(self) -> str:
        self._send(self._lockstep.step_once(self._loop.now()))
        return f"sent state {self._lockstep.step}"

    def _adjust(self, values: dict[str, Any]) -> None:
        self._report_pace()
        self._send(self._lockstep.adjust(self._loop.now(), Timing(**values)))
        self._paced = self._lockstep.pacer is not None

    def _on_start(self, frame: Frame) -> None:
        self._send(self._lockstep.start(frame, self._loop.now()))
        self._record_run()
        if not self._lockstep.run:
            self._report_pace()

    def _on_action(self, frame: Frame) -> None:
        taken = self._lockstep.awaits(frame)
        sends = self._lockstep.action(frame, self._loop.now())
        self._record_run()
        if taken and self._batcher.wanted:
            self._batcher.add(ACTION_KIND, self._actions.codec.encode(frame))
        self._send(sends)
        if self._paced:
            self._send(self._lockstep.tick(self._loop.now()))

    def _report_pace(self) -> None:
        """Log how late the states were, at the end of a run or of this node."""
        pacer = self._lockstep.pacer
        if pacer and pacer.count:
            self._node.get_logger().info(f"real time: {pacer.summary()}")
            pacer.clear()

    def _send(self, sends: list[Publication]) -> None:
        for send in sends:
            if send.topic is STATE and send.frame.step == 0:
                self._batcher.begin(self._loop.now())
            elif send.topic is COST and self._lockstep.contradiction:
                self._node.get_logger().error(
                    f"episode is void: {self._lockstep.contradiction}", throttle_duration_sec=1.0
                )
            self._senders[send.topic].send(send.frame)
            if send.topic is COST:
                self._batcher.flush()  # after it: most readers of the cost need no samples
            if self._clock_wanted and send.topic is STATE:
                self._publish_clock(send.frame.time)

    def _publish_clock(self, simulated: float) -> None:
        raw = clock_message(simulated)
        if raw is not None and self._clock is not None:
            self._clock.publish(raw)

    def _housekeeping(self, now: float) -> None:
        self._clock_wanted = self._clock is not None and self._clock.get_subscription_count() > 0
        if self._fast_path:
            self._fast_path.suspended = self._clock_wanted
        if self._lockstep.overdue():
            episode = episode_name(self._lockstep.episode)
            self._node.get_logger().warning(
                f"no action for step {self._lockstep.step} of episode {episode}; "
                "is the controller running?",
                throttle_duration_sec=5.0,
            )


def main(args: list[str] | None = None) -> int:
    """Console script."""
    keep_on_this_machine()
    return node_main("pde_sim_node", args, PlantNode)


if __name__ == "__main__":
    sys.exit(main())
