# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""driver_node: runs episodes of a plant and controller on demand and times them.

Publishes episode/start, policy, model and hears episode/cost, like a tuner. Reads one JSON object a
line on stdin and answers with one on stdout:

    {"do": "episodes", "batch": M, "seconds": s}    rounds and seconds, over whole episodes
    {"do": "begin", "batch": M, "seconds": s}       begin one, and drop the run after s
    {"do": "solver", "batch": M, "seconds": s}      the plant's step alone, in this process
"""

from __future__ import annotations

import json
import sys
import time
from typing import Any

import numpy as np
from rclpy.node import Node

from pde_sim_node.build import build_plant
from pdeloop.messages import model_rows
from pdeloop.messages.frames import Frame
from pdeloop.messages.parameters import PROBLEM
from pdeloop.messages.spec import Spec
from pdeloop.messages.topics import COST, MODEL, POLICY, START, CostColumn
from pdeloop.process.isolation import keep_on_this_machine
from pdeloop.ros.node_loop import NodeLoop
from pdeloop.ros.node_main import ConfigurationError, node_main
from pdeloop.ros.parameters import declare
from pdeloop.solver.workers import use_cores

PARAMETERS = (
    Spec("solver_pin", -1, -1, 4095).means("core to measure the solver on; -1: all cores"),
    Spec("give_up", 60.0, 1.0, 3600.0, unit="s").means(
        "silence after which a measurement is given up"
    ),
)
ASK_AGAIN = 0.5
"""Seconds without an answer after which an episode is asked for again."""


class DriverNode:
    """Times the episodes of one plant and controller."""

    def __init__(self, node: Node, loop: NodeLoop) -> None:
        given = {name: value.value for name, value in node._parameter_overrides.items()}
        values = declare(node, [*PROBLEM, *PARAMETERS], given)
        self._give_up = values["give_up"]
        physical = {k: v for k, v in given.items() if k.startswith("physical.")}
        self._values = {**values, **physical}
        if values["solver_pin"] >= 0:
            use_cores([values["solver_pin"]])
        self._plant = build_plant(self._values)
        self._run = 1 + time.time_ns() % 2**52
        self._episode = 0
        self.join(node, loop)

    def join(self, node: Node, loop: NodeLoop) -> None:
        self._node, self._loop = node, loop
        self._senders = {topic: loop.sender(topic) for topic in (MODEL, POLICY, START)}
        loop.receive(COST, self._on_cost)

    def run(self) -> int:
        try:
            for line in sys.stdin:
                request = json.loads(line)
                do = {"episodes": self._episodes, "begin": self._begin, "solver": self._solver}
                answer = do[request["do"]](request["batch"], request["seconds"])
                print(json.dumps(answer), flush=True)
        finally:
            self._send(START, np.empty((0, 4)))
        return 0

    def _begin(self, batch: int, seconds: float) -> dict[str, Any]:
        return self._episodes(batch, seconds, abandon=True)

    def _episodes(self, batch: int, seconds: float, abandon: bool = False) -> dict[str, Any]:
        values = self._values
        n_z, n_a, n_s = values["n_z"], values["n_a"], values["reduced_order"]
        model = model_rows.ModelRows(
            A=np.zeros((n_s, n_s)),
            B=np.zeros((n_s, n_a)),
            U=np.eye(n_z, n_s),
            K_a=np.zeros((n_a, n_s)),
            K_b=np.zeros((n_a, n_s)),
            s_r=np.zeros(n_s),
        )
        rows = np.tile([0.0, -1.0, 0.0, 0.0], (batch, 1))
        rows[:, 0] = np.arange(batch)
        rounds, elapsed = 0, 0.0
        while not rounds or elapsed < seconds:
            self._episode += 1
            self._send(MODEL, model_rows.pack(model)[np.newaxis], episode=0)
            self._send(POLICY, np.zeros((batch, n_a, 2 * n_s)))
            began = time.perf_counter()
            self._send(START, rows)
            if abandon:
                self._let_run(seconds)
                self._send(START, rows[:0])
                return {}
            rounds += self._wait(rows)
            elapsed += time.perf_counter() - began
        return {"rounds": rounds, "seconds": elapsed}

    def _let_run(self, seconds: float) -> None:
        limit = time.monotonic() + seconds

        def housekeeping(now: float) -> None:
            if now > limit:
                self._loop.stop("time is over")

        self._loop.run(tick=lambda now: None, deadline=lambda: None, housekeeping=housekeeping)
        self._loop.resume()

    def _wait(self, rows: np.ndarray) -> int:
        """Rounds of the episode just started, once its cost is there."""
        self._cost: Frame | None = None
        limit = time.monotonic() + self._give_up
        ask = time.monotonic() + ASK_AGAIN

        def housekeeping(now: float) -> None:
            nonlocal ask
            if now > limit:
                self._loop.stop("gave up")
            elif now > ask:
                ask = now + ASK_AGAIN
                self._send(START, rows)

        reason = self._loop.run(
            tick=lambda now: None, deadline=lambda: None, housekeeping=housekeeping
        )
        if self._cost is None:
            raise ConfigurationError(f"no cost of an episode arrived ({reason})")
        if (self._cost.values[:, CostColumn.ENDED] != -1).any():
            raise ConfigurationError("an episode of the measurement did not complete")
        self._loop.resume()
        return int(self._cost.step) + 1

    def _on_cost(self, frame: Frame) -> None:
        if (frame.run, frame.episode) == (self._run, self._episode):
            self._cost = frame
            self._loop.stop("cost")

    def _send(self, topic: Any, values: np.ndarray, episode: int | None = None) -> None:
        number = self._episode if episode is None else episode
        self._senders[topic].send(Frame(self._run, number, 0, 0.0, values))

    def _solver(self, batch: int, seconds: float) -> dict[str, Any]:
        plant = self._plant
        actions = np.zeros((batch, plant.n_a))
        plant.reset(np.arange(batch))
        times: list[float] = []
        end = time.perf_counter() + seconds
        while (start := time.perf_counter()) < end or len(times) < 3:
            if plant.step_index >= plant.horizon:
                plant.reset(np.arange(batch))
                continue
            plant.step(actions)
            times.append(time.perf_counter() - start)
        return {"median": float(np.median(times)), "steps": len(times)}


def main(args: list[str] | None = None) -> int:
    """Run by `python -m benchmarks.driver.node`."""
    keep_on_this_machine()
    return node_main("driver_node", args, DriverNode)


if __name__ == "__main__":
    sys.exit(main())
