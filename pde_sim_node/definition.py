# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The definition of a plant, and its fingerprint on the network and in results."""

from __future__ import annotations

import hashlib
import inspect
import json
import pickle
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import CodeType, FunctionType
from typing import Any

import numpy as np

from pdeloop.messages.frames import MAX_ID


@dataclass(frozen=True)
class Definition:
    """Everything that the states and costs of a plant depend on.

    values: its parameters; sources: the source of its code.
    """

    values: Mapping[str, Any]
    sources: Sequence[str]

    def having(self, values: Mapping[str, Any]) -> Definition:
        """The same with further values."""
        return Definition({**self.values, **values}, self.sources)

    @property
    def fingerprint(self) -> int:
        """A number in [1, 2^53) that two plants share only if they are the same plant."""
        content = json.dumps([dict(self.values), list(self.sources)], sort_keys=True, default=float)
        digest = hashlib.sha256(content.encode()).digest()
        return 1 + int.from_bytes(digest[:8], "big") % (MAX_ID - 1)


def sources_of(kind: type, root: type) -> list[str]:
    """The source of a class and of its base classes below `root`.

    Each with its whole module: constants and functions next to the class are part of it.
    """
    return [source_of(base) for base in kind.__mro__ if issubclass(base, root)]


def source_of(kind: type) -> str:
    """The source of a class' module; of one that was typed into an interpreter, its own or its code."""
    for source in (inspect.getmodule(kind), kind):
        try:
            return inspect.getsource(source or kind)
        except (OSError, TypeError):
            continue
    functions = sorted(vars(kind).items())
    return repr([(n, code_of(own.__code__)) for n, own in functions if inspect.isfunction(own)])


def code_of(code: CodeType) -> Any:
    """A description of a function's code, the same in each process."""
    constants = [code_of(c) if isinstance(c, CodeType) else repr(c) for c in code.co_consts]
    return code.co_code.hex(), code.co_names, constants


def described(name: str, value: Any) -> Any:
    """A parameter as JSON can hold it.

    ValueError if it is an object that cannot be told from another one.
    """
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, list | tuple):
        return [described(name, item) for item in value]
    if isinstance(value, Mapping):
        return {str(key): described(name, item) for key, item in value.items()}
    if isinstance(value, np.ndarray) and value.dtype != object:
        raw = np.ascontiguousarray(value).tobytes()
        return [str(value.dtype), list(value.shape), hashlib.sha256(raw).hexdigest()]
    if isinstance(value, FunctionType):
        cells = [cell.cell_contents for cell in value.__closure__ or ()]
        return [
            code_of(value.__code__),
            described(name, cells),
            described(name, value.__defaults__),
        ]
    try:
        return hashlib.sha256(pickle.dumps(value)).hexdigest()
    except Exception as error:
        raise ValueError(
            f"the parameter {name} is a {type(value).__name__}, which has no fingerprint; give "
            f"numbers, texts or arrays ({error})"
        ) from error
