# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Measurements in a text table, as loggers and spreadsheets write them.

The separator, the decimal mark and the encoding are those of the file; what could mean two things is
refused with its row and column.
"""

from __future__ import annotations

import csv
import io
import re
from array import array
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from fnmatch import fnmatchcase
from math import isfinite, nan
from typing import NamedTuple

import numpy as np

from pdeloop.instants import looks_like_instant, seconds_of
from pdeloop.log import SECONDS, Log, in_seconds
from pdeloop.messages.arrays import Array
from pdeloop.method.reduce.channels import Channels, listed

SEPARATORS = (",", ";", "\t", "|")
"""Tried in this order; without any of them columns are separated by spaces."""
MISSING = (
    "",
    "nan",
    "na",
    "n/a",
    "#n/a",
    "null",
    "none",
    "-",
    "--",
    "bad",
    "bad input",
    "no data",
    "i/o timeout",
)
"""Lower-case texts that stand for a missing value."""
TIME = re.compile(r"(t|[Tt]ime)(_[a-zµμ]+|\s*[\[(][^\])]*[\])])?")
"""The column of times where none is named: t or time, also with its unit, as t_ms or Time [ms]."""
HEAD = 30
"""Lines above the numbers, at most, among which that of the names is looked for."""
TARGET = "target"
"""The word in the column of t whose row has z_r."""


@dataclass(frozen=True)
class Columns:
    """The choice of columns: names, or patterns such as T*, separated by commas.

    Without any, `t`, those that begin with z, and those that begin with a, and no others.
    """

    time: str = ""
    states: str = ""
    inputs: str = ""

    @property
    def chosen(self) -> bool:
        """True if any is given, so that other columns are ignored."""
        return bool(self.time or self.states or self.inputs)


class _Places(NamedTuple):
    """Indices of the columns: time is -1 if there is none."""

    time: int
    states: list[int]
    inputs: list[int]


def read_table(raw: bytes, columns: Columns, *, timed: bool = True, time_unit: str = "") -> Log:
    """The measurements in the bytes of a file. ValueError, one sentence, if it is not such a table.

    timed: whether there has to be a column of times; without one all rows are one trajectory, and their
    numbers the times. time_unit: of t, if not the one in its name.
    """
    separator, numbered = _lines(_text(raw))
    _, first = next(numbered, (1, []))
    if separator == " " and first[:1] == ["#"]:
        first = first[1:]
    head = [name.strip().lstrip("#").strip() for name in first]
    width = _filled(head)
    head = head[:width]
    places = places_of(head, columns, timed)
    channels = Channels([head[i] for i in places.states], [head[i] for i in places.inputs])
    target: Array | None = None
    values, rows, numbers = array("d"), array("q"), _Numbers(head, separator)
    stamps: list[str] = []
    times, unit, own_places = array("d"), "", (*places.states, *places.inputs)
    for row, line in numbered:
        if any(cell.strip() for cell in line[width:]) or len(line) < width:
            raise ValueError(
                f"expected {width} values in row {row}, as in the line of names, got {len(line)}"
            )
        stamp = line[places.time].strip() if places.time >= 0 else ""
        if not rows and target is None:
            others = [line[i].strip() for i in own_places]
            if _are_units(stamp, others):
                unit = stamp.strip("[]() ")
                continue
        if stamp.lower() == TARGET:
            if target is not None:
                raise ValueError(
                    f"expected one row whose t is the word target, got a second one, row {row}"
                )
            target = np.array([numbers.read(line, i, row) for i in places.states])
            if not np.isfinite(target).all():
                lost = head[places.states[int(np.argmin(np.isfinite(target)))]]
                raise ValueError(f"the target of {lost} is missing, in row {row}")
            continue
        rows.append(row)
        if places.time >= 0 and (stamps or (len(rows) == 1 and looks_like_instant(stamp))):
            stamps.append(stamp)
        elif places.time >= 0:
            times.append(numbers.time(stamp, row))
        values.extend([numbers.read(line, i, row) for i in own_places])
    own = np.array(values).reshape(-1, len(places.states) + len(places.inputs))
    if places.time < 0:
        numbers_of_rows = np.arange(len(own), dtype=np.float64)
        return Log(channels, own, numbers_of_rows, np.array(rows), target, 1.0)
    if stamps:
        return Log(channels, own, seconds_of(stamps, rows), np.array(rows), target)
    name = head[places.time] + (unit and f" [{unit}]")
    seconds, remarks = in_seconds(name, np.array(times), time_unit)
    return Log(channels, own, seconds, np.array(rows), target, None, remarks)


def _are_units(time: str, others: Sequence[str]) -> bool:
    """Whether the first row below the names has units: one of time, or no numbers at all."""
    if time.strip("[]() ").lower() in SECONDS:
        return True
    known = time.lower() == TARGET or looks_like_instant(time)
    words = [text for text in others if text.lower() not in MISSING]
    return not known and bool(words) and not any(map(_is_number, (time, *words)))


def _is_number(text: str) -> bool:
    try:
        float(text.replace(",", "."))
    except ValueError:
        return False
    return True


def _text(raw: bytes) -> str:
    """The file's text, in the encodings that spreadsheets write."""
    if raw.startswith((b"\xff\xfe", b"\xfe\xff")):
        return raw.decode("utf-16", errors="replace")
    try:
        return raw.decode("utf-8-sig")
    except UnicodeDecodeError:
        return raw.decode("cp1252", errors="replace")


def _lines(text: str) -> tuple[str, Iterator[tuple[int, list[str]]]]:
    """The separator that the line of names has, and from there on the rows with their numbers."""
    skipped, head, separator = _head(text)
    try:
        fields = {s: len(_cells(head, s)) for s in SEPARATORS}
    except csv.Error as error:
        raise ValueError(f"it is not a table: {error} in row {skipped + 1}") from error
    if not separator:
        separator = max(SEPARATORS, key=lambda s: fields[s])
        separator = separator if fields[separator] > 1 else " "
    source = io.StringIO(text, newline="")
    for _ in range(skipped):
        source.readline()
    return separator, _rows(source, skipped, separator)


def _cells(line: str, separator: str) -> list[str]:
    return line.split() if separator == " " else next(csv.reader([line], delimiter=separator), [])


def _head(text: str) -> tuple[int, str, str]:
    """Number of lines before the line of names, that line, and the separator that one before names.

    Lines that begin with # are remarks; the last of them is the line of names if numbers follow it. Of
    several lines above the numbers, as with a title or names of groups, it is the first of those with
    the most different names, if these are as many as the numbers.
    """
    separator, remark, above = "", (0, ""), list[tuple[int, str]]()
    for skipped, line in enumerate(io.StringIO(text, newline=None)):
        words = line.strip()
        if words.lower().startswith("sep=") and len(words) == 5:  # as spreadsheets ask for
            separator = words[4]
        elif words.startswith("#"):
            remark = skipped, words
        elif words:
            bare = words.lstrip("\"'+-.").lower()
            numeric = bare[:1].isdigit() or bare.startswith(TARGET) or _has_numbers(line)
            if not above and numeric and remark[1]:
                return (*remark, separator)
            if numeric or len(above) == HEAD:
                return (*_names(above or [(skipped, line)], line, separator), separator)
            above.append((skipped, line))
    return (*(above[0] if above else remark), separator)


def _names(above: Sequence[tuple[int, str]], numbers: str, separator: str) -> tuple[int, str]:
    """Of the lines above the first one with numbers that of the names."""
    best, most = above[0], 1
    try:
        for s in (separator,) if separator else (*SEPARATORS, " "):
            row = _cells(numbers, s)
            for place, line in above if len(above) > 1 and (s != " " or most == 1) else []:
                names = _cells(line, s)
                different = len({name.strip() for name in names if name.strip()})
                whole = _filled(row) <= _filled(names) <= len(row)
                if whole and different > most and not any(map(_is_number, names)):
                    best, most = (place, line), different
    except csv.Error:
        pass  # as told of the first line
    return best


def _has_numbers(line: str) -> bool:
    """Whether most cells of a line are numbers, by any separator."""
    try:
        cells = [_cells(line.strip(), s) for s in SEPARATORS]
    except csv.Error:
        return False
    return any(2 * sum(map(_is_number, row)) > len(row) for row in cells)


def _filled(cells: Sequence[str]) -> int:
    """Number of cells up to the last one that is not empty."""
    return max((i for i, cell in enumerate(cells) if cell.strip()), default=-1) + 1


def _rows(source: io.StringIO, skipped: int, separator: str) -> Iterator[tuple[int, list[str]]]:
    """The rows that are not empty, with their numbers from 1 on; remarks are left out."""
    if separator == " ":
        numbered = ((number, line.split()) for number, line in enumerate(source, skipped + 1))
    else:
        reader = csv.reader(source, delimiter=separator, skipinitialspace=True)
        numbered = ((skipped + reader.line_num, cells) for cells in reader)
    first = True
    try:
        for number, cells in numbered:
            if any(cell.strip() for cell in cells) and (first or not cells[0].startswith("#")):
                first = False
                yield number, cells
    except csv.Error as error:
        raise ValueError(
            f"it is not a table: {error} in row {skipped + reader.line_num}"
        ) from error


def places_of(head: Sequence[str], columns: Columns, timed: bool) -> _Places:
    """Find time, states and inputs. ValueError if a name is missing, or means two things."""
    shown = ", ".join(head)[:200]
    if twice := sorted({name for name in head if head.count(name) > 1 and name}):
        raise ValueError(f"expected a name for each column, got several named {listed(twice)}")
    if not columns.chosen:
        kinds = {"t": [], "z": [], "a": [], "": []}  # type: dict[str, list[int]]
        for i, name in enumerate(head):
            kind = "t" if TIME.fullmatch(name) else name[:1] if name[:1] in ("z", "a") else ""
            kinds[kind].append(i)
        if kinds[""] or not (kinds["z"] and kinds["a"] and (kinds["t"] or not timed)):
            raise ValueError(
                "expected the names t, z..., a... in the first line, separated by commas, semicolons "
                f"or tabs, got '{shown}'; or choose columns with --time, --states and --inputs"
            )
        return _Places(kinds["t"][0] if kinds["t"] else -1, kinds["z"], kinds["a"])
    named = next((name for name in head if TIME.fullmatch(name)), "t")
    found = {
        "--time": _matching(
            head, columns.time or named, "--time", needed=bool(columns.time) or timed
        ),
        "--states": _matching(head, columns.states or "z*", "--states"),
        "--inputs": _matching(head, columns.inputs or "a*", "--inputs"),
    }
    if len(found["--time"]) > 1:
        names = listed([head[i] for i in found["--time"]])
        raise ValueError(f"expected one column for --time, got {names}")
    for one, other in (("--time", "--states"), ("--time", "--inputs"), ("--states", "--inputs")):
        if both := sorted({*found[one]} & {*found[other]}):
            names = listed([head[i] for i in both])
            raise ValueError(
                f"{names} cannot be of both {one} and {other}; name columns one by one"
            )
    time = found["--time"]
    return _Places(time[0] if time else -1, found["--states"], found["--inputs"])


def _matching(head: Sequence[str], patterns: str, flag: str, *, needed: bool = True) -> list[int]:
    """The columns that the patterns name, in their order and each once."""
    found: dict[int, None] = {}
    asked = [part.strip() for part in patterns.split(",")]
    if twice := [pattern for pattern in dict.fromkeys(asked) if asked.count(pattern) > 1]:
        raise ValueError(f"{flag} names {listed(twice)} more than once: leave out what is repeated")
    for pattern in asked:
        # A name may hold what is special in a pattern, like T [K].
        own = [i for i, name in enumerate(head) if name == pattern] or [
            i for i, name in enumerate(head) if name and fnmatchcase(name, pattern)
        ]
        if not own and needed:
            close = get_close_matches(pattern, head, n=1, cutoff=0.4)
            meant = f"; did you mean {close[0]}?" if close else ""
            raise ValueError(
                f"{flag}: no column is named '{pattern}'; there are {', '.join(head)[:200]}{meant}"
            )
        found |= dict.fromkeys(own)
    return list(found)


class _Numbers:
    """Reads the cells of a table, whose decimal mark is found on the way."""

    def __init__(self, head: Sequence[str], separator: str) -> None:
        self._head = head
        self._separator = separator
        self._mark = ""

    def read(self, line: Sequence[str], i: int, row: int) -> float:
        """The number in a cell; NaN where it is missing."""
        if self._mark == ".":  # as nearly always: a comma is no number then
            try:
                return float(line[i])
            except ValueError:
                pass
        return self._number(line[i].strip(), self._head[i], row)

    def time(self, text: str, row: int) -> float:
        """A time as a number."""
        numeric = re.fullmatch(r"[\d.,+\-eE]+", text) is not None
        value = self._number(text, "t", row) if numeric else nan
        if not isfinite(value):
            raise ValueError(
                f"expected a time t in row {row}, got '{text[:40]}'; times are numbers, h:m:s, or "
                "dates such as 2026-01-31 12:00:00"
            )
        return value

    def _number(self, text: str, name: str, row: int) -> float:
        """The number in a text; NaN where it is missing."""
        if text.lower() in MISSING:
            return nan
        where = f"'{text[:40]}' in row {row}, column {name}"
        mark = "," if "," in text else "." if "." in text else ""
        if mark == self._separator:
            raise ValueError(
                f"expected a decimal point where commas separate the columns, got {where}; separate "
                "them by semicolons, or write points"
            )
        if text.count(",") + text.count(".") > 1 or (mark and self._mark not in ("", mark)):
            after = f", after '{self._mark}' in an earlier number" if self._mark else ""
            raise ValueError(
                f"expected one decimal mark and no mark of thousands, got {where}{after}"
            )
        try:
            value = float(text.replace(",", "."))
        except ValueError:
            raise ValueError(f"expected a number, got {where}") from None
        self._mark = self._mark or mark
        return value
