# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""What docs/reference renders says what goes in and what comes out, with the shapes of arrays."""

from __future__ import annotations

import importlib
import inspect
import re
from collections.abc import Iterator
from typing import Any

import griffe
import pytest

from tests.support.interpreter import ROOT

NAMES = re.findall(r"^::: (\S+)$", (ROOT / "docs/reference/index.md").read_text(), re.MULTILINE)
ARRAYS = re.compile(r"\b(Array|ArrayLike|NDArray)\b")


def found(name: str) -> Any:
    parts = name.split(".")
    for count in range(len(parts), 0, -1):
        try:
            thing: Any = importlib.import_module(".".join(parts[:count]))
        except ModuleNotFoundError:
            continue
        for part in parts[count:]:
            thing = getattr(thing, part)
        return thing
    raise LookupError(name)


def callables(name: str, thing: Any) -> Iterator[tuple[str, Any, str]]:
    """Functions, classes and methods of a name, each with its docstring."""
    if inspect.ismodule(thing):
        for public in thing.__all__:
            yield from callables(f"{name}.{public}", getattr(thing, public))
    elif inspect.isclass(thing):
        yield name, thing, inspect.getdoc(thing) or ""
        for public, member in vars(thing).items():
            if not public.startswith("_") and inspect.isfunction(member):
                yield f"{name}.{public}", member, inspect.getdoc(member) or ""
    else:
        yield name, thing, inspect.getdoc(thing) or ""


EVERY = [item for name in NAMES for item in callables(name, found(name))]


def sections(text: str) -> dict[str, Any]:
    parsed = griffe.Docstring(text).parse("numpy")
    return {section.kind.value: section.value for section in parsed}


@pytest.mark.parametrize(("name", "thing", "text"), EVERY, ids=[name for name, _, _ in EVERY])
def test_what_goes_in_and_comes_out_is_described(name: str, thing: Any, text: str) -> None:
    described = sections(text)
    known = described.get("attributes" if _is_record(thing) else "parameters", ())
    entries = {single.strip(" *"): item for item in known for single in item.name.split(",")}
    signature = inspect.signature(thing)
    if getattr(thing, "_is_protocol", False) or inspect.isabstract(thing):  # nobody makes one
        signature, entries = inspect.Signature(), {}
    wanted = {p.name: str(p.annotation) for p in signature.parameters.values() if p.name != "self"}
    assert set(entries) >= set(wanted), "not described"
    if not _is_record(thing):
        assert set(entries) <= set(wanted), "described, but no argument"
    for argument, annotation in wanted.items():
        if ARRAYS.search(annotation):
            assert "(" in str(entries[argument].annotation), f"{argument}: of what shape?"
    if inspect.isfunction(thing) and str(signature.return_annotation) not in ("None", ""):
        kind = "yields" if "Iterator" in str(signature.return_annotation) else "returns"
        assert kind in described, "what does it return?"
    if inspect.isclass(thing) and not getattr(thing, "_is_protocol", False):
        thing = vars(thing).get("__post_init__" if _is_record(thing) else "__init__", _nothing)
    if "    raise " in inspect.getsource(thing):
        assert "raises" in described, "what does it raise?"


def _nothing() -> None:
    """In place of a constructor that does nothing."""


def _is_record(thing: Any) -> bool:
    """A class whose constructor takes its attributes."""
    return inspect.isclass(thing) and (
        hasattr(thing, "__dataclass_fields__") or issubclass(thing, tuple)
    )
