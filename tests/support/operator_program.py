# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""An operator's ROS tools in a process of their own, with commands and answers through a pipe.

{"know": [SERVICE, ...]}            look for these already, so that a call is quick
{"call": SERVICE}                   a std_srvs/Trigger; [success, message]
{"set": [NODE, PARAMETER, VALUE]}   [successful, reason]
{"set_each": [NODE, {PARAMETER: VALUE}]}   in one request: {parameter: [successful, reason]}
{"malform": NODE}                   sends a request to set a parameter of no type there is
{"get": [NODE, PARAMETER]}          the value
{"get_each": [NODE, [PARAMETER, ...]]}     in one request: {parameter: value}
{"describe": NODE}                  {parameter: read_only}
{"diagnostics": None}               {status name: [reports so far, level, message, {key: value}]}
{"topics": None}                    {topic: [types]}
{"nodes": None}                     full names
"""

from __future__ import annotations

import contextlib
import threading
import time
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.msg import ParameterValue
from rcl_interfaces.srv import DescribeParameters, GetParameters, ListParameters, SetParameters
from rclpy.parameter import Parameter, parameter_value_to_python
from std_srvs.srv import Trigger

from tests.support.loop_harness import become

LIMIT = 300.0


class Operator:
    def __init__(self) -> None:
        rclpy.init()
        self.node = rclpy.create_node("operator")
        self.statuses: dict[str, list[Any]] = {}
        self.clients: dict[str, Any] = {}
        self.node.create_subscription(DiagnosticArray, "/diagnostics", self.take, 100)
        threading.Thread(target=rclpy.spin, args=(self.node,), daemon=True).start()

    def take(self, message: DiagnosticArray) -> None:
        for status in message.status:
            count = self.statuses.get(status.name, [0])[0]
            values = {item.key: item.value for item in status.values}
            level = int.from_bytes(status.level, "little")
            self.statuses[status.name] = [count + 1, level, status.message, values]

    def request(self, kind: Any, name: str, request: Any) -> Any:
        if name not in self.clients:
            self.clients[name] = self.node.create_client(kind, name)
        client = self.clients[name]
        if not client.wait_for_service(LIMIT):
            raise SystemExit(f"no service {name}")
        future, end = client.call_async(request), time.monotonic() + LIMIT
        while not future.done():
            if time.monotonic() > end:
                raise SystemExit(f"no answer from {name}")
            time.sleep(0.005)
        return future.result()

    def answer(self, command: dict[str, Any]) -> Any:
        ((what, argument),) = command.items()
        if what == "know":
            for name in argument:
                self.clients[name] = self.node.create_client(Trigger, name)
            return None
        if what == "call":
            result = self.request(Trigger, argument, Trigger.Request())
            return [result.success, result.message]
        if what == "set":
            node, name, value = argument
            return self.answer({"set_each": [node, {name: value}]})[name]
        if what == "set_each":
            node, values = argument
            wanted = [Parameter(name, value=values[name]).to_parameter_msg() for name in values]
            request = SetParameters.Request(parameters=wanted)
            results = self.request(SetParameters, f"{node}/set_parameters", request).results
            told = ([result.successful, result.reason] for result in results)
            return dict(zip(values, told, strict=True))
        if what == "malform":
            client = self.node.create_client(SetParameters, f"{argument}/set_parameters")
            assert client.wait_for_service(LIMIT)
            odd = ParameterMessage(name="odd", value=ParameterValue(type=42))
            client.call_async(SetParameters.Request(parameters=[odd]))
            return None
        if what == "get":
            node, name = argument
            return self.answer({"get_each": [node, [name]]})[name]
        if what == "get_each":
            node, names = argument
            request = GetParameters.Request(names=names)
            values = self.request(GetParameters, f"{node}/get_parameters", request).values
            return dict(zip(names, map(parameter_value_to_python, values), strict=True))
        if what == "describe":
            names = self.request(
                ListParameters, f"{argument}/list_parameters", ListParameters.Request()
            ).result.names
            found = self.request(
                DescribeParameters,
                f"{argument}/describe_parameters",
                DescribeParameters.Request(names=names),
            ).descriptors
            return {descriptor.name: descriptor.read_only for descriptor in found}
        if what == "diagnostics":
            return dict(self.statuses)
        if what == "topics":
            return dict(self.node.get_topic_names_and_types())
        if what == "nodes":
            return [
                f"{namespace.rstrip('/')}/{name}"
                for name, namespace in self.node.get_node_names_and_namespaces()
            ]
        raise SystemExit(f"unknown command {what}")


def serve(pipe: Connection, log: Path, environment: dict[str, str]) -> None:
    """Answer the commands from `pipe` until its other end is closed."""
    become(log, environment)
    operator = Operator()
    with contextlib.suppress(EOFError):
        while True:
            pipe.send(operator.answer(pipe.recv()))
    rclpy.shutdown()
