"""Declares the parameters of loop_interfaces.parameters on a node."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.node import Node

from loop_interfaces.parameters import ParameterError, Spec, check_names, table

_LARGEST = 1.7976931348623157e308


def given_parameters(node: Node) -> dict[str, Any]:
    """What the command line and parameter files give this node. ParameterError for unknown names."""
    given = {name: parameter.value for name, parameter in node._parameter_overrides.items()}
    known = [spec.name for spec in table()]
    ros_own = [name for name in given if name.split(".")[0] in ("use_sim_time", "qos_overrides")]
    check_names(set(given) - set(ros_own), known)
    return given


def declare(node: Node, specs: Iterable[Spec], given: dict[str, Any]) -> dict[str, Any]:
    """Declares `specs` read-only with description and range; returns the checked values.

    Raises ParameterError naming parameter, value and range. A whole number is accepted for a
    floating-point parameter, as YAML writers expect.
    """
    values: dict[str, Any] = {}
    for spec in specs:
        value = spec.check(given.get(spec.name, spec.default))
        node.declare_parameter(spec.name, value, descriptor(spec), ignore_override=True)
        values[spec.name] = value
    return values


def descriptor(spec: Spec) -> ParameterDescriptor:
    """The ROS descriptor of a parameter: description with unit, range, read-only."""
    unit = f" ({spec.unit})" if spec.unit else ""
    result = ParameterDescriptor(
        description=f"{spec.description}{unit}",
        additional_constraints=f"expected {spec.range}",
        read_only=True,
    )
    low = spec.minimum if spec.minimum is not None else (0.0 if spec.positive else -_LARGEST)
    high = spec.maximum if spec.maximum is not None else _LARGEST
    if spec.type is float:
        result.floating_point_range = [FloatingPointRange(from_value=float(low), to_value=high)]
    elif spec.type is int:
        result.integer_range = [
            IntegerRange(from_value=int(low), to_value=min(int(high), 2**63 - 1), step=1)
        ]
    return result


__all__ = ["ParameterError", "declare", "descriptor", "given_parameters"]
