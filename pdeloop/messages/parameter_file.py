# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""ROS parameter files, read as rclpy reads them (rcl_yaml_param_parser). No ROS import.

One file may hold the parameters of a whole system. Each of its blocks is headed by the full name of a
node, which may be spread over nested maps and have wildcards:

    /lab:
      pde_sim_node:
        ros__parameters: {n_z: 64}      # of /lab/pde_sim_node
    /**:
      ros__parameters: {horizon: 100}   # of every node
    /lab/*:
      ros__parameters: {seed: 1}        # of every node in /lab

A node takes what stands in each block that it matches; of two values, the last one in the file.
"""

from __future__ import annotations

import ctypes
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from pdeloop.messages.documents import compose_yaml
from pdeloop.messages.files import FileError, read_bounded
from pdeloop.messages.spec import MAX_NAME, MAX_PARAMETERS, MAX_YAML_BYTES, ParameterError
from pdeloop.messages.text import shown

_PARAMETERS = "ros__parameters"
_NODE_NAME = re.compile(r"/?((\*\*?|[A-Za-z_]\w*)/)*(\*\*?|[A-Za-z_]\w*)", re.ASCII)
_TRUE = {"Y", "y", "yes", "Yes", "YES", "true", "True", "TRUE", "on", "On", "ON"}
_FALSE = {"N", "n", "no", "No", "NO", "false", "False", "FALSE", "off", "Off", "OFF"}
_SPECIAL = re.compile(r"[+-]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)")
_TEXT_TAG = "tag:yaml.org,2002:str"


@dataclass
class Block:
    """Parameters by name, with dots.

    misread: what ROS takes for something else than it says, in words; empty: nothing.
    """

    values: dict[str, Any] = field(default_factory=dict)
    misread: str = ""


@dataclass(frozen=True)
class ParameterFile:
    """The blocks of a file, in its order, by the name of nodes that each is for."""

    path: Path
    blocks: Mapping[str, Block]

    def of(self, node: str) -> dict[str, Any]:
        """The parameters that the node of this full name takes. ParameterError if ROS misreads them.

        >>> blocks = {"/**": Block({"a": 1, "b": 1}), "lab/pde_sim_node": Block({"a": 2})}
        >>> ParameterFile(Path("p.yaml"), blocks).of("/lab/pde_sim_node")
        {'a': 2, 'b': 1}
        """
        found: dict[str, Any] = {}
        for name, block in self.blocks.items():
            if matches(name, node):
                if block.misread:
                    raise ParameterError(f"{self.path} {block.misread}")
                found |= block.values
        return found


def matches(name: str, node: str) -> bool:
    """True if the name of a block stands for the node of this full name."""
    pattern = f"/{name.removeprefix('/')}".replace("/*", r"(/\w+)")  # so that /** is (/\w+)*
    return re.fullmatch(pattern, node, re.ASCII) is not None


def read_parameter_file(path: Path) -> ParameterFile:
    """The file's blocks. ParameterError, one sentence, where it cannot be read, or not by ROS."""
    try:
        raw = read_bounded(path, MAX_YAML_BYTES, "expected a parameter file")
    except FileError as error:
        raise ParameterError(str(error)) from error
    try:
        documents = compose_yaml(raw)
    except ValueError as error:
        raise ParameterError(f"{path} is not valid YAML: {error}") from error
    blocks: dict[str, Block] = {}
    try:
        for document in documents:
            for name, body in _blocks(document, ""):
                _add(blocks.setdefault(name, Block()), body, "")
        if sum(len(block.values) for block in blocks.values()) > MAX_PARAMETERS:
            raise ValueError(f"more than {MAX_PARAMETERS} parameters in one file")
    except ValueError as error:
        raise ParameterError(f"{path} is not a ROS parameter file: {error}") from error
    return ParameterFile(path, blocks)


def scalar(text: str, *, quoted: bool = False) -> bool | int | float | str:
    """A value as ROS reads it, by the C library's strtoll and strtod.

    >>> [scalar(text) for text in ("1e3", "0x10", "on", "five")]
    [1000.0, 16, True, 'five']
    >>> scalar("5", quoted=True)
    '5'
    """
    if quoted:
        return text
    if text in _TRUE or text in _FALSE:
        return text in _TRUE
    whole = _converted(_LIBC.strtoll, text, 0)
    if whole is not None:
        return int(whole)
    number = _converted(
        _LIBC.strtod, text.replace(".", "", 1) if _SPECIAL.fullmatch(text) else text
    )
    return text if number is None else float(number)


def yaml_text(values: Mapping[str, Any], comment: str = "") -> str:
    """`values` as the parameter file of every node; dotted names become nested maps."""
    nested: dict[str, Any] = {}
    for name, value in values.items():
        *groups, last = name.split(".")
        place = nested
        for group in groups:
            place = place.setdefault(group, {})
        place[last] = value
    text = yaml.dump({"/**": {_PARAMETERS: nested}}, Dumper=_Dumper, sort_keys=False)
    return "".join(f"# {line}\n" for line in comment.splitlines()) + text


class _Dumper(getattr(yaml, "CSafeDumper", yaml.SafeDumper)):  # type: ignore[misc]
    """Puts texts in quotes that ROS, unlike YAML, would take for truth or a number."""

    def represent_str(self, text: str) -> yaml.ScalarNode:
        style = None if scalar(text) == text else "'"
        node: yaml.ScalarNode = self.represent_scalar(_TEXT_TAG, text, style)
        return node


_Dumper.add_representer(str, _Dumper.represent_str)


def _blocks(node: yaml.Node, outer: str) -> Iterator[tuple[str, yaml.MappingNode]]:
    """The names of nodes and their parameters, in and below a map of nodes."""
    if not isinstance(node, yaml.MappingNode):
        expected = (
            "'/**:' with 'ros__parameters:' in it" if not outer else f"'{_PARAMETERS}:' in it"
        )
        raise ValueError(f"expected {expected}, got {_kind(node)} in line {_line(node)}")
    for number, (key, value) in enumerate(node.value, 1):
        name = _key(key)
        if not name.startswith(_PARAMETERS):
            joined = outer + "/" * bool(outer and not outer.endswith("/")) + name
            yield from _blocks(value, joined)
            continue
        if not _NODE_NAME.fullmatch(outer):
            raise ValueError(
                f"{shown(outer)} is not the name of a node (line {_line(key)})"
                if outer
                else f"'{_PARAMETERS}' is not below the name of a node in line {_line(key)}"
            )
        if number < len(node.value):  # ROS does not know any more where it stands
            raise ValueError(
                f"{outer} has entries after '{_PARAMETERS}' in line {_line(node)}; put them before it"
            )
        if not isinstance(value, yaml.MappingNode):
            raise ValueError(
                f"expected parameters in '{_PARAMETERS}' of {outer}, got {_kind(value)} in line "
                f"{_line(value)}"
            )
        yield outer, value


def _add(block: Block, body: yaml.MappingNode, group: str) -> None:
    """Add the parameters of a map, whose names begin with `group`."""
    values = block.values
    for key, node in body.value:
        name = f"{group}{_key(key)}"
        if len(name) > MAX_NAME:
            raise ValueError(
                f"the name of a parameter has more than {MAX_NAME} characters: {shown(name)}"
            )
        if isinstance(node, yaml.MappingNode):
            if not node.value:
                block.misread = f"has an empty group '{name}' in line {_line(node)}"
            if group and "." in _key(key):
                block.misread = f"has dots in the name of a group in '{name}' in line {_line(node)}"
            _add(block, node, f"{name}.")
            continue
        value: Any
        if isinstance(node, yaml.SequenceNode):
            value = _list(name, node)
            if value is None:
                block.misread = f"has lists within the list '{name}' in line {_line(node)}"
        else:
            value = _value(name, node)
        if name in values and (_type(values[name]), values[name]) != (_type(value), value):
            block.misread = (
                f"has '{name}' as {shown(values[name])} and as {shown(value)} in line "
                f"{_line(node)}; remove one of them"
            )
        values[name] = value


def _list(name: str, node: yaml.SequenceNode) -> list[Any] | None:
    """Its values; None if there are lists or maps among them."""
    if not all(isinstance(item, yaml.ScalarNode) for item in node.value):
        return None
    items = [_value(name, item) for item in node.value]
    if len({type(item) for item in items}) > 1:
        raise ValueError(
            f"the list '{name}' in line {_line(node)} has values of several types; a list in ROS "
            "has values of one type, as in [0.0, 1.5]"
        )
    return items


def _value(name: str, node: yaml.ScalarNode) -> bool | int | float | str:
    text, quoted = str(node.value), node.style in ("'", '"')
    if not text and not quoted:
        raise ValueError(f"'{name}' has no value in line {_line(node)}")
    return scalar(text, quoted=quoted or node.tag == _TEXT_TAG)


def _key(node: yaml.Node) -> str:
    if not isinstance(node, yaml.ScalarNode) or not node.value:
        raise ValueError(f"expected a name, got {_kind(node)} in line {_line(node)}")
    return str(node.value)


def _type(value: object) -> object:
    return (list, *map(type, value[:1])) if isinstance(value, list) else type(value)


def _kind(node: yaml.Node) -> str:
    if isinstance(node, yaml.ScalarNode):
        return shown(node.value) if node.value else "nothing"
    return "a list" if isinstance(node, yaml.SequenceNode) else "a map"


def _line(node: yaml.Node) -> int:
    return int(node.start_mark.line) + 1


_LIBC = ctypes.CDLL(None, use_errno=True)
_LIBC.strtod.restype = ctypes.c_double
_LIBC.strtoll.restype = ctypes.c_longlong


def _converted(function: Any, text: str, *base: int) -> int | float | None:
    """The number that strtoll or strtod reads from a whole text; None if it is not one."""
    content = ctypes.create_string_buffer(text.encode())
    end = ctypes.c_void_p()
    ctypes.set_errno(0)
    value: int | float = function(content, ctypes.byref(end), *base)
    whole = end.value == ctypes.addressof(content) + len(content) - 1
    return value if whole and len(content) > 1 and not ctypes.get_errno() else None
