# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Texts and values from files and the network, made safe for display."""

import difflib
import reprlib
from collections.abc import Iterable

MAX_SHOWN = 200
"""Characters of a value in an error."""


def printable(text: str) -> str:
    r"""A text with its non-printable characters, such as a terminal's escape sequences, escaped.

    Examples
    --------
    >>> printable("red " + chr(27) + "[31m")
    'red \\x1b[31m'
    """
    return "".join(c if c.isprintable() or c == "\n" else ascii(c)[1:-1] for c in text)


class _Bounded(reprlib.Repr):
    """Python's notation of the beginning of a value, at a cost that does not grow with the value."""

    def __init__(self) -> None:
        super().__init__()
        self.maxlevel = 4
        self.maxdict = self.maxlist = self.maxtuple = self.maxset = self.maxfrozenset = 8
        self.maxstring = self.maxother = MAX_SHOWN

    def repr_int(self, value: int, level: int) -> str:
        """Python writes no more than 4300 digits."""
        return repr(value) if abs(value) < 2**1000 else "a number of more than 300 digits"

    def repr_str(self, value: str, level: int) -> str:
        return repr(value) if len(value) <= MAX_SHOWN else f"{repr(value[:MAX_SHOWN])[:-1]}..."

    def repr_bytes(self, value: bytes, level: int) -> str:
        return repr(value) if len(value) <= MAX_SHOWN else f"{repr(value[:MAX_SHOWN])[:-1]}..."

    def repr_dict(self, value: dict[object, object], level: int) -> str:
        """In the dict's own order, unlike reprlib's."""
        if level <= 0:
            return "{...}"
        parts = [
            f"{self.repr1(key, level - 1)}: {self.repr1(value[key], level - 1)}"
            for key in list(value)[: self.maxdict]
        ]
        return f"{{{', '.join([*parts, '...'] if len(value) > len(parts) else parts)}}}"


_BOUNDED = _Bounded()


def shown(value: object) -> str:
    """A value as Python writes it, its beginning if that is long: for texts of any foreign value.

    Nothing is written out in full and cut afterwards: a value from a file may stand for gigabytes.

    Examples
    --------
    >>> shown({"horizon": 80, "start": "lqt"})
    "{'horizon': 80, 'start': 'lqt'}"
    >>> len(shown(["x" * 10**6] * 10**6)) <= MAX_SHOWN + 3
    True
    """
    text = _BOUNDED.repr(value)
    return text if len(text) <= MAX_SHOWN else f"{text[:MAX_SHOWN]}..."


def alike(name: str, known: Iterable[str]) -> str:
    """A question for the known name that is meant by another one, if any is near.

    >>> alike("burger", ["burgers", "kdv"]), alike("rocket", ["burgers", "kdv"])
    ("did you mean 'burgers'? ", '')
    """
    near = difflib.get_close_matches(name, list(known), n=1, cutoff=0.7)
    return f"did you mean '{near[0]}'? " if near else ""
