# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Declares the parameters of pdeloop.messages.parameters on a node, and reads another node's.

All are read-only but the live ones, which no result depends on.
"""

import time
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from typing import Any

from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rcl_interfaces.srv import GetParameters, ListParameters
from rclpy.node import Node
from rclpy.parameter import Parameter, parameter_value_to_python

from pdeloop.messages.parameter_file import ParameterFile
from pdeloop.messages.parameters import table, with_names
from pdeloop.messages.problem import code_from, completed, nothing_for, of_ros
from pdeloop.messages.spec import ParameterError, Spec, check_names

UNANSWERED = 1.0
"""Seconds after which a request that got no answer is made again."""
TOLD = ("actuators",)
"""Parameters that a node sets itself; a file with all its parameters also has them."""
_LARGEST = 1.7976931348623157e308


CODE = ("equation", "plant", "optimizer", "law")
"""Parameters that may name code in a file, which is relative to the parameter file that names it."""
_FILES = "_pdeloop_parameter_files"
"""The attribute of a node with the parameter files that it was started with."""


def given_parameters(node: Node, package: str) -> dict[str, Any]:
    """The parameters that command line and files give a node, on top of the problem they name.

    ParameterError for unknown names, and for an unknown problem. A relative file of user code
    is that from the folder of the parameter file, as for the commands.
    """
    given = {
        # rcl knows no type of an empty list, and gives it no value.
        name: [] if parameter.value is None else parameter.value
        for name, parameter in node._parameter_overrides.items()
        if not of_ros(name) and name not in TOLD
    }
    files: Sequence[ParameterFile] = getattr(node, _FILES, ())
    for file in reversed(files):
        own = file.of(node.get_fully_qualified_name())
        for code in CODE:
            if given.get(code) and own.get(code) == given[code]:
                given[code] = code_from(file.path.resolve().parent, given[code])
    given = with_names(given)
    check_names(given, [spec.name for spec in table()])
    return completed(given, package)


def require_parameters(node: Node, files: Sequence[ParameterFile]) -> None:
    """ParameterError where parameter files were given that have nothing for this node.

    It would run with its defaults, which are another problem's. The files are remembered for
    `given_parameters`.
    """
    setattr(node, _FILES, files)
    name = node.get_fully_qualified_name()
    if files and all(of_ros(parameter) for file in files for parameter in file.of(name)):
        raise ParameterError(nothing_for(name, files))


def declare(node: Node, specs: Iterable[Spec], given: dict[str, Any]) -> dict[str, Any]:
    """Declares `specs` with description and range, read-only unless live; returns the checked values.

    Raises ParameterError naming parameter, value and range. A whole number is accepted for a
    floating-point parameter, as YAML writers expect.
    """
    values: dict[str, Any] = {}
    for spec in specs:
        value = spec.check(given.get(spec.name, spec.default))
        node.declare_parameter(spec.name, value, descriptor(spec), ignore_override=True)
        values[spec.name] = value
    return values


def take_over(node: Node, former: Node) -> None:
    """Declare the parameters of a node that has ended, with their last values."""
    for name in former.get_parameters_by_prefix(""):
        if name and not node.has_parameter(name):  # rclpy lets a request make one without a name
            value, description = former.get_parameter(name).value, former.describe_parameter(name)
            node.declare_parameter(name, value, description, ignore_override=True)


def on_change(node: Node, specs: Iterable[Spec], apply: Callable[[dict[str, Any]], None]) -> None:
    """Let the live ones of `specs` be set, in their range; apply(values) gets all live values then.

    To be called once, after every `declare` of the node.
    """
    live = {spec.name: spec for spec in specs if spec.live}

    def check_change(parameters: list[Parameter]) -> SetParametersResult:
        try:
            for parameter in parameters:
                if parameter.name in live:
                    live[parameter.name].check(parameter.value)
        except ParameterError as error:
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def after_change(parameters: list[Parameter]) -> None:
        changed = [parameter for parameter in parameters if parameter.name in live]
        if changed:
            apply({name: node.get_parameter(name).value for name in live})
        for parameter in changed:
            node.get_logger().info(f"parameter '{parameter.name}' is now {parameter.value}")

    node.add_on_set_parameters_callback(check_change)
    node.add_post_set_parameters_callback(after_change)


def descriptor(spec: Spec) -> ParameterDescriptor:
    """The ROS descriptor of a parameter: description with unit, range, read-only unless live."""
    unit = f" ({spec.unit})" if spec.unit else ""
    result = ParameterDescriptor(
        description=f"{spec.description}{unit}",
        additional_constraints=f"expected {spec.range}",
        read_only=not spec.live,
    )
    low = spec.minimum if spec.minimum is not None else (0.0 if spec.positive else -_LARGEST)
    high = spec.maximum if spec.maximum is not None else _LARGEST
    if spec.type is float:  # an int in its place would be written as other bits
        result.floating_point_range = [
            FloatingPointRange(from_value=float(low), to_value=float(high))
        ]
    elif spec.type is int:
        least, most = max(int(low), -(2**63)), min(int(high), 2**63 - 1)
        result.integer_range = [IntegerRange(from_value=least, to_value=most, step=1)]
    return result


class RemoteParameters:
    """Asks another node for its parameters, through the services that every ROS node has.

    name: the node's full name; values: its answer, None before. Call `poll` from time to time. An
    answer is lost if the other process has not discovered its reader yet: the request is repeated.

    The answer also proves that the other process has discovered every endpoint this node had before:
    it discovers our endpoints in their order, and the reader of the answer comes after them.
    """

    def __init__(self, node: Node, name: str) -> None:
        self.values: dict[str, Any] | None = None
        self._node = node
        self._list = node.create_client(ListParameters, f"{name}/list_parameters")
        self._get = node.create_client(GetParameters, f"{name}/get_parameters")
        self._clients = [self._list, self._get]
        self._asking: Iterator[None] = self._ask()

    def poll(self) -> None:
        """Go on with what can be gone on with; never waits."""
        next(self._asking, None)

    def offered(self) -> bool:
        """True once the graph has shown the services."""
        return self.values is not None or self._list.service_is_ready()

    def _ask(self) -> Iterator[None]:
        """Ask for the names, then for the values; yields wherever it has to wait."""
        listed = yield from self._call(self._list, ListParameters.Request())
        names = list(listed.result.names)
        answer = yield from self._call(self._get, GetParameters.Request(names=names))
        values = [parameter_value_to_python(value) for value in answer.values]
        self.values = dict(zip(names, values, strict=True))
        self.close()

    def _call(self, client: Any, request: Any) -> Generator[None, None, Any]:
        """The answer to a request, which is made again when it stays out.

        The first answer counts, also to an earlier one: a node that computes for long answers all late.
        """
        asked: list[Any] = []
        again_at = 0.0
        while not (done := [future for future in asked if future.done()]):
            if time.monotonic() >= again_at and client.service_is_ready():
                asked.append(client.call_async(request))
                again_at = time.monotonic() + UNANSWERED
            yield
        for future in asked:
            client.remove_pending_request(future)
        return done[0].result()

    def close(self) -> None:
        """Drop the clients; nothing is asked any more."""
        self._asking = iter(())
        while self._clients:
            self._node.destroy_client(self._clients.pop())
