# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Texts in YAML and JSON, read without trusting them: bounded before anything is built from them.

YAML can name a part of a document and repeat it (anchors and aliases), so that one kilobyte stands for
any number of entries, or for a map that contains itself. No file of the project needs that, and what
reads a document goes through all of its entries; so aliases are refused.
"""

from __future__ import annotations

import json
from typing import Any

import yaml

MAX_DEPTH = 32
"""Maps and lists within each other."""
MAX_YAML_NODES = 50_000
"""Entries of a YAML document: its maps, lists, keys and values."""
MAX_YAML_SCALAR = 10_000
"""Characters of a key or a value; of a longer one in base 60, Python's integers would take minutes."""
MAX_JSON_CONTAINERS = 5_000_000
"""Brackets that open an object or a list in a JSON text: each takes some 60 bytes of memory."""

_Loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


def parse_yaml(text: str | bytes, most: int = MAX_YAML_NODES) -> Any:
    r"""The content of a YAML document. ValueError if it is not one, or has more than `most` nodes.

    >>> parse_yaml("a: {b: [1, 2.5, text]}")
    {'a': {'b': [1, 2.5, 'text']}}
    >>> parse_yaml("a: &x {b: 1}\nc: *x")
    Traceback (most recent call last):
        ...
    ValueError: line 2 repeats 'x' by an alias (*); write the values out
    """
    try:
        _check_yaml(text, most)
        return yaml.load(text, _UniqueLoader)
    except yaml.YAMLError as error:
        raise ValueError(_yaml_problem(error)) from error
    except (ArithmeticError, AttributeError, LookupError, TypeError, RecursionError) as error:
        # PyYAML's constructors on values that are not of the type which they are tagged as.
        raise ValueError("it has a value that is not of the type it is tagged as") from error


class _UniqueLoader(_Loader):  # type: ignore[misc, valid-type]
    """Refuses a map with a key that stands in it twice, of which YAML would keep the last value."""

    def construct_mapping(self, node: Any, deep: bool = False) -> Any:
        keys: set[tuple[str, str]] = set()
        for key, _ in node.value:
            if isinstance(key, yaml.ScalarNode):
                if (key.tag, key.value) in keys:
                    raise yaml.constructor.ConstructorError(
                        problem=f"'{key.value}' stands twice in one map; leave one of them out",
                        problem_mark=key.start_mark,
                    )
                keys.add((key.tag, key.value))
        return super().construct_mapping(node, deep)


class _TaggedLoader(_Loader):  # type: ignore[misc, valid-type]
    """Gives no scalar a type: only tags that stand in the text are seen."""

    def resolve(self, kind: Any, value: Any, implicit: Any) -> str:
        return ""


def compose_yaml(text: str | bytes) -> list[yaml.Node]:
    """The documents of a text as YAML's nodes, for a reader with rules of its own; see `parse_yaml`."""
    try:
        _check_yaml(text, MAX_YAML_NODES)
        return list(yaml.compose_all(text, _TaggedLoader))
    except yaml.YAMLError as error:
        raise ValueError(_yaml_problem(error)) from error


def _check_yaml(text: str | bytes, most: int) -> None:
    """ValueError for a document that would be larger than its text suggests."""
    depth = nodes = 0
    for event in yaml.parse(text, _Loader):
        line = 1 + (event.start_mark.line if event.start_mark is not None else 0)
        if isinstance(event, yaml.AliasEvent):
            name = str(event.anchor)[:40]
            raise ValueError(f"line {line} repeats '{name}' by an alias (*); write the values out")
        if isinstance(event, yaml.CollectionEndEvent):
            depth -= 1
            continue
        nodes += isinstance(event, yaml.NodeEvent)
        depth += isinstance(event, yaml.CollectionStartEvent)
        if depth > MAX_DEPTH:
            raise ValueError(f"maps and lists nested more than {MAX_DEPTH} deep, in line {line}")
        if nodes > most:
            raise ValueError(f"more than {most} entries, in line {line}")
        if isinstance(event, yaml.ScalarEvent) and len(event.value) > MAX_YAML_SCALAR:
            raise ValueError(f"a value of more than {MAX_YAML_SCALAR} characters, in line {line}")


def _yaml_problem(error: yaml.YAMLError) -> str:
    """The error in one line, with its place."""
    first = (str(error).splitlines() or ["it cannot be parsed"])[0]
    if isinstance(error, yaml.MarkedYAMLError) and error.problem_mark is not None:
        return f"{error.problem or first}, in line {error.problem_mark.line + 1}"
    return first


def parse_json(text: str | bytes) -> Any:
    """The content of a JSON text. ValueError if it is malformed, too deep or too large.

    Too large: a number of more than 64 bits, or more than MAX_JSON_CONTAINERS objects and lists.

    >>> parse_json('{"a": [1, null]}')
    {'a': [1, None]}
    """
    raw = text.encode(errors="replace") if isinstance(text, str) else text
    if raw.count(b"[") + raw.count(b"{") > MAX_JSON_CONTAINERS:
        raise ValueError(f"it has more than {MAX_JSON_CONTAINERS} objects and lists")
    try:
        content = json.loads(text, parse_int=_whole)
    except RecursionError:
        raise ValueError("it is nested too deeply") from None
    if _depth_exceeds(content, MAX_DEPTH):
        raise ValueError("it is nested too deeply")
    return content


def _depth_exceeds(content: Any, most: int) -> bool:
    """True if lists and dicts are nested more than `most` deep."""
    level = [content]
    for _ in range(most + 1):
        parts = [part for part in level if isinstance(part, list | dict)]
        if not parts:
            return False
        level = [x for part in parts for x in (part if isinstance(part, list) else part.values())]
    return True


def _whole(digits: str) -> int:
    """A whole number of at most 64 bits."""
    if len(digits) > 20 or not -(2**63) <= (number := int(digits)) < 2**63:
        raise ValueError(f"expected whole numbers of at most 64 bits, got {digits[:20]}...")
    return number
