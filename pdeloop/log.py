# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A log as rows of numbers, made into trajectories of equal steps by what its user decided."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from pdeloop.log_findings import Finding, Flags, findings, sentinels
from pdeloop.messages.arrays import Array
from pdeloop.method.reduce.channels import Channels, listed

JITTER = 1e-3
"""Relative tolerance of a step of t to the median one."""
GAP = 1.5
"""Median steps of t from which on rows are missing in between."""
UNITS = {
    1e-9: ("ns", "nsec", "nanosecond", "nanoseconds"),
    1e-6: ("us", "µs", "μs", "usec", "microsecond", "microseconds"),
    1e-3: ("ms", "msec", "msecs", "millis", "millisecond", "milliseconds"),
    1.0: ("s", "sec", "secs", "second", "seconds"),
    60.0: ("min", "mins", "minute", "minutes"),
    3600.0: ("h", "hr", "hrs", "hour", "hours"),
    86400.0: ("d", "day", "days"),
}
"""Seconds of each unit of time, and its names."""
SECONDS = {name: seconds for seconds, names in UNITS.items() for name in names}
LARGE_STEP = 50.0
"""A step from which on one without a unit may well be of ms, if it is whole and not one of minutes."""
SINCE_1970 = 1e11
"""A time as large counts since 1970 in a unit below the second."""
DATES = ((25569.0, 73051.0), (719529.0, 767011.0))
"""Days of the years 1970 to 2099, as numbers of spreadsheets and of MATLAB."""
REPEATED = 0.1
"""Share of steps of t that are 0 from which on its clock is too coarse for the log, and of long ones
in a row from which on they are no gaps."""


@dataclass(frozen=True)
class Remedies:
    """What the user decided about a log.

    time_unit: of t, if not what its name says; missing: values that stand for missing readings, None
    where that was not said; cut: leave out rows that are missing or spoilt, and go on after them;
    resample: seconds of equal steps, 0 for the log's own, None for none.
    """

    time_unit: str = ""
    missing: Sequence[float] | None = None
    cut: bool = False
    resample: float | None = None

    def __post_init__(self) -> None:
        if self.time_unit and self.time_unit not in SECONDS:
            units = ", ".join(names[0] for names in UNITS.values())
            raise ValueError(f"the unit of time is '{self.time_unit}'; expected one of {units}")
        if self.resample is not None and not 0.0 <= self.resample < np.inf:
            raise ValueError(
                f"the step to resample to is {self.resample:g} s; expected one above 0"
            )


@dataclass(frozen=True, eq=False)
class Log:
    """Rows of a log.

    channels: names; values (R, n_z + n_a): states and inputs, NaN where missing; times (R,) in s, of
    which one that does not increase begins a trajectory; rows (R,): their numbers in the file; step:
    seconds of a step where they are known without times.
    """

    channels: Channels
    values: Array
    times: Array
    rows: NDArray[np.int64]
    target: Array | None = None
    step: float | None = None
    remarks: list[str] = field(default_factory=list)


@dataclass(frozen=True, eq=False)
class Table:
    """The contents of a log.

    channels: names of the columns; trajectories: states (N + 1, n_z) and actions (N, n_a) each, a_k
    held from z_k to z_{k+1}; target (n_z,): of the row whose t is the word target;
    sample_time: of t, in s; None without such a column; remarks: what was found and left out.
    """

    channels: Channels
    trajectories: list[tuple[Array, Array]]
    target: Array | None
    sample_time: float | None
    remarks: list[str] = field(default_factory=list)


def in_seconds(name: str, times: Array, given: str = "") -> tuple[Array, list[str]]:
    """Numbers of a column of times in s, by the unit that is given or in its name; and remarks.

    >>> in_seconds("Time [ms]", np.array([0.0, 100.0]))[0].tolist()
    [0.0, 0.1]
    """
    unit = given or _unit_of(name)
    if unit in SECONDS:
        factor = SECONDS[unit]
        if factor == 1.0:
            return times, []
        # By a division where that is exact: 0.1 s of 100 ms.
        scaled = times / round(1.0 / factor) if factor < 1.0 else times * factor
        return scaled, []
    remedy = "give --time-unit ms, or another one" + ", or s if it is in s"
    if unit:
        return times, [f"the unit '{unit}' of {name} is not known, so it is taken as s: {remedy}"]
    if times.size and float(np.abs(times).max()) > SINCE_1970:
        largest = float(np.abs(times).max())
        unit = "ms" if largest < 1e14 else "us" if largest < 1e17 else "ns"
        return in_seconds(name, times, unit)[0], [
            f"{name} counts since 1970 in {unit}, by its size, and was read as such: otherwise give "
            "--time-unit"
        ]
    steps = np.diff(times)
    step = float(np.median(steps[steps > 0.0])) if (steps > 0.0).any() else 0.0
    if any(
        times.size and first <= times.min() and times.max() < last for first, last in DATES
    ) and (_is_short(86400.0 * step) and not _is_short(step)):
        return in_seconds(name, times, "d")[0], [
            f"{name} has dates as numbers of days, by their size, and was read as such: otherwise give "
            "--time-unit"
        ]
    whole = step >= LARGE_STEP and step == round(step) and step % 60.0 != 0.0
    if whole:
        return times, [f"the steps of {name} are {step:g}, taken as s: {remedy}"]
    return times, []


def _is_short(step: float) -> bool:
    """Whether a step has three digits, but for the rounding of times."""
    return step > 0.0 and abs(float(f"{step:.3g}") - step) <= 0.1 * JITTER * step


def _unit_of(name: str) -> str:
    """The unit that a name has at its end: t_ms, Time [ms], t (min), time in h, t/us; or nothing."""
    bracketed = re.search(r"[\[(<]\s*([^\[\]()<>]*?)\s*[\])>]\s*$", name)
    if bracketed:
        return bracketed.group(1).strip().lower()
    ended = re.search(r"(?:[_./,\-\s]|\bin\s)\s*([^\W\d_]+)\s*$", name)
    word = ended.group(1).lower() if ended else ""
    if not word and (close := re.match(r"^(?:t|time)(ms|us|ns|min|sec)$", name.lower())):
        word = close.group(1)
    if not word and (camel := re.search(r"[a-z](Ms|Us|Ns|Sec|Min|MS|NS|US)$", name)):
        word = camel.group(1).lower()
    return word if word in SECONDS else ""


def trajectories_of(log: Log, remedies: Remedies, *, timed: bool, most: int) -> Table:
    """The trajectories of a log: each ends where t does not grow, and where rows were left out.

    Everything is looked at once, on the rows as they are. ValueError, one sentence with row, column and
    option, for what no model should be fitted to.
    """
    n_z = len(log.channels.states)
    values, remarks = log.values.copy(), list(log.remarks)
    if remedies.missing is not None:
        for value in remedies.missing:
            values[values == value] = np.nan
    remarks += _looked_for_sentinels(values, log, remedies)
    times, rows = log.times, log.rows
    first = np.r_[True, ~(np.diff(times) > 0.0)][: len(times)]
    if int(first.sum()) > most:
        raise ValueError(f"expected at most {most} trajectories, got {int(first.sum())}")
    if (same := np.diff(times) == 0.0).any():
        k, more = int(np.argmax(same)), int(same.sum()) - 1
        text = f"t is the same in rows {rows[k]} and {rows[k + 1]}, and {more} times more: "
        if more + 1 > REPEATED * len(times):
            raise ValueError(
                f"{text}its clock is too coarse for the steps of this log; write t to fractions of "
                "seconds, or take it out of the file and give --sample-time"
            )
        remarks.append(f"{text}each begins another trajectory; leave out rows that are there twice")
    step = _median_step(times, first) if log.step is None else log.step
    after_gap = np.zeros(len(first), dtype=bool)
    if step is not None and timed:
        after_gap[1:] = np.diff(times) > GAP * max(step, remedies.resample or 0.0)
    found = findings(values, first | after_gap, rows, log.channels, step or 1.0)
    for one in found:
        first = first | one.begins
    spoilt = _missing(values, first, n_z)
    dropped = list[int]()
    if remedies.cut:
        for one in found:
            spoilt = spoilt | one.spoilt
        first = first | after_gap | np.r_[False, spoilt[:-1]]
        dropped = rows[spoilt].tolist()
        values, times, rows, first = values[~spoilt], times[~spoilt], rows[~spoilt], first[~spoilt]
        first[:1] = True
    elif spoilt.any():
        raise ValueError(_missing_text(values, spoilt, first, rows, log.channels))
    remarks += [one.text for one in found if not _remedied(one, remedies, step)]
    bounds = [*np.flatnonzero(first).tolist(), len(times)]
    parts = [slice(a, b) for a, b in pairwise(bounds)]
    single = [int(rows[part.start]) for part in parts if part.stop - part.start == 1]
    parts = [part for part in parts if part.stop - part.start > 1]
    if remedies.cut:
        own = (dropped, ""), (single, " alone between gaps")
        left = [
            f"{len(k)} row{'s' * (len(k) > 1)}{what}, the first of them row {k[0]}"
            for k, what in own
            if k
        ]
        remarks += [f"left out {', and '.join(left)}"] if left else []
    elif single:
        remarks.append(
            f"left out row {listed([str(row) for row in single])}: t increases neither before nor "
            "after it"
        )
    whole = [(times[p], values[p]) for p in parts]
    if remedies.resample is not None and parts:
        step = remedies.resample or _rounded(step or 1.0)
        _refuse_gaps(times, rows, parts, step)
        whole = [_resampled(t - t[0], v, n_z, step) for t, v in whole]
        whole = [(t, v) for t, v in whole if len(v) > 1]
    elif timed and parts:
        step = _sample_time(times, rows, parts)
    trajectories = [(v[:, :n_z], v[:-1, n_z:]) for _, v in whole]
    return Table(log.channels, trajectories, log.target, step if parts else None, remarks)


def _remedied(finding: Finding, remedies: Remedies, step: float | None) -> bool:
    """Whether the user's options have taken care of it."""
    if finding.spoilt.any():
        return remedies.cut
    asked = remedies.resample
    return bool(finding.step and asked and asked > (finding.step - 0.5) * (step or 1.0))


def _looked_for_sentinels(values: Array, log: Log, remedies: Remedies) -> list[str]:
    """Refuse values that stand for missing readings; remarks where the user has named some."""
    texts, found = [], sentinels(values, len(log.channels.states))
    every = ",".join(dict.fromkeys(f"{value:.10g}" for _, value, _ in found))
    for i, value, where in found:
        name = [*log.channels.states, *log.channels.inputs][i]
        more = f" (and in {int(where.sum()) - 1} more rows)" if where.sum() > 1 else ""
        text = (
            f"{name} is {value:.10g} in row {log.rows[int(np.argmax(where))]}{more}, far from all "
            "else, as a value for a missing reading"
        )
        if remedies.missing is None:
            raise ValueError(
                f"{text}: give --missing={every} --cut, or --missing=nan if it is a reading"
            )
        texts.append(text)
    return texts


def _missing(values: Array, first: Flags, n_z: int) -> Flags:
    """Rows with a number missing, except the last actions of a trajectory, which nothing follows."""
    known = np.isfinite(values)
    if len(known):
        ends = np.r_[np.flatnonzero(first)[1:] - 1, len(known) - 1]
        known[ends, n_z:] = True
    return np.asarray(~known.all(axis=1))


def _missing_text(
    values: Array, spoilt: Flags, first: Flags, rows: NDArray[np.int64], channels: Channels
) -> str:
    k = int(np.argmax(spoilt))
    name = [*channels.states, *channels.inputs][int(np.argmin(np.isfinite(values[k])))]
    more = int(spoilt.sum()) - 1
    others = f" (and {more} more with gaps)" if more else ""
    if spoilt.mean() > 0.5:  # as of a logger that writes changes alone
        return (
            f"{name} is missing in row {rows[k]}{others}, as where changes alone are written: write in "
            "every row the last value before it, or one row for each step in which all are known"
        )
    return (
        f"{name} is missing in row {rows[k]}{others}: fill the gap, or cut the file in two there, as "
        "several files can be given; --cut does so"
    )


def _median_step(times: Array, first: Flags) -> float | None:
    """The median step of t: an existing one; of two different ones, the shorter."""
    steps = np.sort(np.diff(times)[~first[1:]])
    return float(steps[(len(steps) - 1) // 2]) if steps.size else None


def _rounded(step: float) -> float:
    """The step in three digits where it is that within the tolerance."""
    short = float(f"{step:.3g}")
    return short if abs(short - step) <= JITTER * step else step


def _sample_time(times: Array, rows: NDArray[np.int64], parts: Sequence[slice]) -> float:
    """The step of t, which has to be the same throughout."""
    steps = [np.diff(times[part]) for part in parts]
    every = np.sort(np.concatenate(steps))
    median = float(every[(len(every) - 1) // 2])
    # A clock that counts since 1970 has steps that are rounded themselves.
    rounding = 4 * np.finfo(np.float64).eps * float(np.abs(times).max())
    for part, own in zip(parts, steps, strict=True):
        if (wrong := np.flatnonzero(np.abs(own - median) > JITTER * median + rounding)).size:
            k = part.start + 1 + int(wrong[0])
            text = (
                f"expected equal steps of t, got {own[wrong[0]]:g} s before row {rows[k]} where the "
                f"others are {median:g} s"
            )
            if float(every[-1]) <= GAP * median:
                raise ValueError(
                    f"{text} (all are between {every[0]:.6g} and {every[-1]:.6g} s): resample the log "
                    f"with --resample {_rounded(median):g}"
                )
            apart = own > GAP * median
            if (apart[1:] & apart[:-1]).sum() > REPEATED * len(own):
                usual = float(np.median(own[apart]))
                raise ValueError(
                    f"{text}, and {int(apart.sum()) - 1} times more: give --resample "
                    f"{_rounded(usual):g}, as --cut would leave out the rows at other steps"
                )
            raise ValueError(
                f"{text}: fill the gap or resample the log, or cut the file in two there, as several "
                "files can be given; --cut does so"
            )
    return median


def _refuse_gaps(
    times: Array, rows: NDArray[np.int64], parts: Sequence[slice], step: float
) -> None:
    """ValueError where rows are missing, over which nothing is interpolated; step: the new one."""
    steps = [np.diff(times[part]) for part in parts]
    median = max(float(np.median(np.concatenate(steps))), step)
    for part, own in zip(parts, steps, strict=True):
        if own.max() > GAP * median:
            k = int(np.argmax(own))
            raise ValueError(
                f"t grows by {own[k]:g} s before row {rows[part.start + 1 + k]} where it usually does "
                f"by {median:g} s, too much to interpolate over: add --cut"
            )


def _resampled(t: Array, values: Array, n_z: int, step: float) -> tuple[Array, Array]:
    """Equal steps: states by linear interpolation, inputs by the mean of what was held in a step."""
    spacing = float(np.median(np.diff(t)))
    if step < spacing / GAP:
        raise ValueError(
            f"expected a step to resample to of at least that of the log, {spacing:g} s, got {step:g} s"
        )
    count = int((t[-1] + JITTER * spacing) / step + 1e-9) + 1
    grid = step * np.arange(count, dtype=np.float64)
    states = np.stack([np.interp(grid, t, x) for x in values[:, :n_z].T], axis=1)
    held = values[:-1, n_z:]
    whole = np.vstack([np.zeros(held.shape[1]), np.cumsum(held * np.diff(t)[:, None], axis=0)])
    area = np.stack([np.interp(grid, t, x) for x in whole.T], axis=1)
    inputs = np.vstack([np.diff(area, axis=0) / step, np.full(held.shape[1], np.nan)])
    return grid, np.hstack([states, inputs])
