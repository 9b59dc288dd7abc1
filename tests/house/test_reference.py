# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""What docs/reference renders says what goes in and what comes out, with the shapes of arrays."""

from __future__ import annotations

import importlib
import inspect
import re
from collections.abc import Iterator
from typing import Any

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


def lacking(thing: Any, text: str) -> Iterator[str]:
    """What its docstring does not say, or says of nothing."""
    import griffe  # not at the top: every worker imports all files of tests

    parsed = griffe.Docstring(text).parse("numpy")
    described: dict[str, Any] = {section.kind.value: section.value for section in parsed}
    known = described.get("attributes" if _is_record(thing) else "parameters", ())
    entries = {single.strip(" *"): item for item in known for single in item.name.split(",")}
    signature = inspect.signature(thing)
    if getattr(thing, "_is_protocol", False) or inspect.isabstract(thing):  # nobody makes one
        signature, entries = inspect.Signature(), {}
    wanted = {p.name: str(p.annotation) for p in signature.parameters.values() if p.name != "self"}
    yield from (f"{name} is not described" for name in {*wanted} - {*entries})
    if not _is_record(thing):
        yield from (f"{name} is described, but no argument" for name in {*entries} - {*wanted})
    for argument, annotation in wanted.items():
        if ARRAYS.search(annotation) and "(" not in str(entries[argument].annotation):
            yield f"{argument}: of what shape?"
    if inspect.isfunction(thing) and str(signature.return_annotation) not in ("None", ""):
        kind = "yields" if "Iterator" in str(signature.return_annotation) else "returns"
        if kind not in described:
            yield "what does it return?"
    if inspect.isclass(thing) and not getattr(thing, "_is_protocol", False):
        thing = vars(thing).get("__post_init__" if _is_record(thing) else "__init__", _nothing)
    if "    raise " in inspect.getsource(thing) and "raises" not in described:
        yield "what does it raise?"


def test_what_goes_in_and_comes_out_is_described() -> None:
    every = [item for name in NAMES for item in callables(name, found(name))]
    assert len(every) > len(NAMES) > 0
    wrong = {name: words for name, thing, text in every if (words := [*lacking(thing, text)])}
    assert wrong == {}


def _nothing() -> None:
    """In place of a constructor that does nothing."""


def _is_record(thing: Any) -> bool:
    """A class whose constructor takes its attributes."""
    return inspect.isclass(thing) and (
        hasattr(thing, "__dataclass_fields__") or issubclass(thing, tuple)
    )
