# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Dates and times of day of a column, as loggers and spreadsheets write them, in seconds.

All texts of a column have one form: ISO 8601, day.month.year, 31-Jan-2026, year/month/day, a time of
day alone, or a date of which only the whole column tells whether it begins with the day or with the
month.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from datetime import datetime, timedelta

import numpy as np

from pdeloop.messages.arrays import Array

DAY = 86400.0
GAP = 1.5
"""Median steps up to which one time follows another without a gap."""
MONTHS = ["jan", "feb", "mar", "apr", "may", "jun", "jul", "aug", "sep", "oct", "nov", "dec"]
FORM = re.compile(
    r"""(?:(?P<first>\d{1,2}|\d{4})(?P<mark>[./-])(?P<second>\d{1,2}|[A-Za-z]{3})(?P=mark)(?P<third>\d{4}|\d{1,2})
    (?:[\ T]+|$))?
    (?:(?P<hour>\d{1,4}):(?P<minute>\d{2})(?::(?P<rest>\d{2}(?:[.,]\d+)?))?
    \s*(?P<half>[AaPp])?(?(half)\.?[Mm]\.?))?""",
    re.VERBOSE,
)


def looks_like_instant(text: str) -> bool:
    """True for a text that is no number, but a date or a time of day."""
    return _iso(text) is not None or bool(_form(text))


def seconds_of(texts: Sequence[str], rows: Sequence[int]) -> Array:
    """Seconds of each time since the first one; of times of day alone, since midnight.

    rows: their numbers in the file. ValueError, one sentence, for what could mean two things.

    >>> seconds_of(["31.01.2026 23:59:59", "01.02.2026 00:00:01"], [2, 3]).tolist()
    [0.0, 2.0]
    >>> seconds_of(["11:59:58 PM", "11:59:59 PM", "12:00:00 AM"], [2, 3, 4]).tolist()
    [86398.0, 86399.0, 86400.0]
    """
    if _iso(texts[0]) is not None:
        return _of_iso(texts, rows)
    form = _form(texts[0])
    for text, row in zip(texts, rows, strict=True):
        if _form(text) != form:
            raise ValueError(
                f"expected a time t in row {row} in the form of '{texts[0]}', got '{text[:40]}'"
            )
    if form == ":":
        return _through_midnight(_read(texts, rows, lambda *_: (2000, 1, 1)))
    if form == "year":
        return _since(_read(texts, rows, lambda *date: tuple(map(int, date))))
    if form == ".":
        return _since(_read(texts, rows, _day_month_year))
    return _by_order(texts, rows)


def _iso(text: str) -> datetime | None:
    if "-" not in text[1:] and ":" not in text:  # a number
        return None
    try:
        return datetime.fromisoformat(text)
    except ValueError:
        return None


def _of_iso(texts: Sequence[str], rows: Sequence[int]) -> Array:
    first, seconds = _iso(texts[0]), []
    assert first is not None
    for text, row in zip(texts, rows, strict=True):
        instant = _iso(text)
        if instant is None:
            raise ValueError(f"expected a time t in row {row}, got '{text[:40]}'")
        if bool(instant.tzinfo) != bool(first.tzinfo):
            raise ValueError(
                f"expected a time zone in all rows or in none, got '{text[:40]}' in {row}"
            )
        seconds.append((instant - first).total_seconds())
    return np.array(seconds)


def _form(text: str) -> str:
    """The mark between the numbers of a date, "year" where that is first, ":" without a date; or "".

    It is a dot, too, where the name of the month tells the day from it.

    Hours and minutes without a date may as well be minutes and seconds, and years of two digits days.
    """
    match = FORM.fullmatch(text)
    if match is None:
        return ""
    if match["mark"] is None:
        return ":" if match["rest"] or match["half"] else ""
    if len(match["first"]) == 4:
        return "year" if len(match["third"]) <= 2 else ""
    named = match["second"].isalpha()
    if named and match["second"].lower() not in MONTHS:
        return ""
    mark = "." if named else match["mark"]
    return mark if len(match["third"]) in ((2, 4) if mark == "." else (4,)) else ""


def _day_month_year(first: str, second: str, third: str) -> tuple[int, int, int]:
    month = MONTHS.index(second.lower()) + 1 if second.isalpha() else int(second)
    return int(third) + 2000 * (len(third) == 2), month, int(first)


def _month_day_year(first: str, second: str, third: str) -> tuple[int, int, int]:
    return _day_month_year(second, first, third)


def _read(
    texts: Sequence[str], rows: Sequence[int], date: Callable[..., tuple[int, int, int]]
) -> Array:
    """Seconds since the beginning of the year 2000. ValueError for what is no date."""
    seconds = []
    for text, row in zip(texts, rows, strict=True):
        match = FORM.fullmatch(text)
        assert match is not None
        try:
            day = date(match["first"], match["second"], match["third"])
            seconds.append(_instant(match, day).total_seconds())
        except ValueError as error:
            raise ValueError(
                f"expected a time t in row {row}, got '{text[:40]}' ({error})"
            ) from error
    return np.array(seconds)


def _instant(match: re.Match[str], date: tuple[int, int, int]) -> timedelta:
    hour, minute = int(match["hour"] or 0), int(match["minute"] or 0)
    second = float((match["rest"] or "0").replace(",", "."))
    if match["half"]:
        if not 1 <= hour <= 12:
            raise ValueError(f"an hour of {hour}")
        hour = hour % 12 + 12 * (match["half"].upper() == "P")
    if minute > 59 or second >= 61.0 or (hour > 24 and match["mark"]):
        raise ValueError("no time of day")
    day = datetime(*date) - datetime(2000, 1, 1)
    return day + timedelta(hours=hour, minutes=minute, seconds=second)


def _since(seconds: Array) -> Array:
    since: Array = np.round(seconds - seconds[0], 6)
    return since


def _through_midnight(seconds: Array) -> Array:
    """Times of day, which go on after midnight where the step is one of the others."""
    steps = np.diff(seconds)
    forward = steps[steps > 0.0]
    usual = float(np.median(forward)) if forward.size else 0.0
    wraps = (steps < 0.0) & (steps + DAY > 0.0) & (steps + DAY <= GAP * usual)
    days: Array = seconds + DAY * np.r_[0, np.cumsum(wraps)]
    return days


def _by_order(texts: Sequence[str], rows: Sequence[int]) -> Array:
    """Of day and month the order in which all dates exist, or in which the times are equal steps."""
    found, reasons = [], []
    for date in (_day_month_year, _month_day_year):
        try:
            found.append(_since(_read(texts, rows, date)))
        except ValueError as error:
            reasons.append(error)
    if not found:
        raise reasons[0]
    if len(found) == 1 or np.array_equal(found[0], found[1]):
        return found[0]
    if len(even := [seconds for seconds in found if _is_even(seconds)]) == 1:
        return even[0]
    raise ValueError(
        f"the times, such as '{texts[0]}' in row {rows[0]}, may begin with the day or with the month: "
        "write them as 2026-01-31 12:00:00"
    )


def _is_even(seconds: Array) -> bool:
    """Whether there is neither a gap nor a step back."""
    steps = np.diff(seconds)
    return bool(steps.size and steps.min() > 0.0 and steps.max() <= GAP * np.median(steps))
