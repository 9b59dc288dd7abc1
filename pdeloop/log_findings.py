# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""What loggers and sensors do to a log, found before anything is fitted to it.

Every function looks at the rows of a log in order. `resolution` is the smallest change of a channel:
a signal that comes to rest does so by changes of that size, whereas a frozen or a saturated sensor
stops in the middle of a motion.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from decimal import Decimal

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from pdeloop.messages.arrays import Array
from pdeloop.method.reduce.channels import SHOWN, Channels, listed
from pdeloop.method.reduce.input_delay import LATEST

FULL_SCALE = (32767.0, -32768.0, 65535.0, 2147483647.0, -2147483648.0, 4294967295.0, 1e20, 1e30)
"""Values besides 99, 999.9, -9999, ... that stand for no reading."""
ISOLATED = 3.0
"""Ranges of a channel between it and a value that is none of its own."""
RESTING = 3.0
"""Resolutions by which a signal that comes to rest changes at most."""
FROZEN = 15
"""Equal rows of a frozen sensor."""
LONGER = 5
"""Usual runs of equal rows that a frozen one is as long as."""
STUCK = 2
"""Usual runs of equal inputs that a stuck one is as long as."""
SATURATED = 10
"""Rows at an extreme value of a saturated sensor, at least, and `SATURATED_SHARE` of all."""
SATURATED_SHARE = 0.02
SPIKE = 5.0
"""Size of a jump and of the one back, relative to the 98th percentile of all."""
WRAPPED, SLOW = 0.8, 0.2
"""Parts of the range of a channel that a wrap exceeds, and that all other steps fall below."""
TURNS = (360.0, 2.0 * np.pi)
"""Ranges of an angle."""
EXPLAINED = 0.02
"""Part of usual steps that a regression misses of them at least."""
DRIFT = 50.0
"""Variances by which a trend in time lowers the squares of residuals, from which the plant drifts."""
BLOCKS = 20
"""Parts of a log in each of which residuals may depend on each other."""
PAST = 4
"""Rows of states and inputs beside which that trend counts."""
FOLLOWED = 0.8
"""Share of changes that are regular, or follow an input, from which on they count as such."""
UNLOGGED = 4.0
"""Ratio of squares that are not explained where an input stands still to those elsewhere."""
ONE = 1e-7
"""Standard deviation of the difference of two channels that are one, relative to their own."""
LEAST = 20
"""Rows of a log in which anything is looked for."""
PAIRS = 256
"""Channels of which each two are compared, at most."""

Flags = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Finding:
    """Rows of a log that are not what the plant did, or a property of its channels.

    text: one sentence with the channels, the first row, and the option that helps; spoilt (R,): the
    rows that `--cut` leaves out; step: rows between two readings of a sensor that is slower than the
    log, or 0; begins (R,): rows that begin a trajectory.
    """

    text: str
    spoilt: Flags
    step: int = 0
    begins: Flags | bool = False


def _last_digits(values: Array, column: Array) -> Array:
    """That of each value in a column of as many decimals and digits as its longest numbers have."""
    written = [
        Decimal(repr(value)).normalize().as_tuple()
        for value in column[np.isfinite(column)].tolist()
    ]
    places = max(len(value.digits) for value in written)
    last = min(int(value.exponent) for value in written)
    with np.errstate(divide="ignore"):  # of 0
        first = np.floor(np.log10(np.abs(values)))
    found: Array = 10.0 ** np.maximum(last, first - places + 1)
    return found


@dataclass(frozen=True, eq=False)
class _Runs:
    """Equal values in a row, of one channel: first row, length, the changes before and after.

    grain: the last digit of each value in a column of as many decimals and digits as its longest
    numbers have, or the resolution if that is larger.
    """

    begins: NDArray[np.int64]
    lengths: NDArray[np.int64]
    before: Array
    after: Array
    resolution: float
    grain: Array

    @staticmethod
    def of(x: Array, first: Flags) -> _Runs:
        """first: the first rows of trajectories, where no change is one."""
        begins = np.flatnonzero(np.r_[True, x[1:] != x[:-1]] | first)
        lengths = np.diff(np.r_[begins, len(x)])
        change = np.abs(x[begins] - x[begins - 1])
        change[first[begins]] = 0.0
        moved = change[change > 0.0]
        resolution = float(moved.min()) if moved.size else 0.0
        grain = np.full(len(begins), resolution)
        if (lengths >= 3).any():
            own = x[begins]
            grain = np.maximum(resolution, _last_digits(own, own))
        return _Runs(begins, lengths, change, np.r_[change[1:], 0.0], resolution, grain)

    @property
    def abrupt(self) -> Flags:
        """Runs before which the channel was in motion."""
        return np.asarray(self.before > RESTING * self.grain)

    @property
    def whole(self) -> Flags:
        """Runs that neither begin nor end a trajectory."""
        return np.asarray((self.before > 0.0) & (self.after > 0.0))

    def rows(self, chosen: Flags, size: int) -> Flags:
        """The rows of some of them."""
        found = np.zeros(size, dtype=bool)
        for begin, length in zip(self.begins[chosen], self.lengths[chosen], strict=True):
            found[begin : begin + length] = True
        return found


def sentinels(values: Array, n_z: int) -> list[tuple[int, float, Flags]]:
    """Values that stand for no reading: column, value, rows.

    Of the states also any other value that comes back exactly and is far from all others; of the
    inputs, which may well have rare pulses, only the usual ones.
    """
    found = []
    for i, x in enumerate(values.T):
        known = x[np.isfinite(x)]
        usual = _usual_sentinel(known)
        own = known[~usual]
        if known.size < LEAST or own.size < known.size / 2:
            continue
        low, high = _cluster(own) if i < n_z else (float(own.min()), float(own.max()))
        reach = ISOLATED * max(high - low, 0.0 if i < n_z else max(abs(low), abs(high)))
        for value in np.unique(known[(known < low - reach) | (known > high + reach)]):
            rows = x == value
            again = int(rows.sum()) > 1 and i < n_z and high > low
            if _usual_sentinel(np.array([value]))[0] or again:
                found.append((i, float(value), rows))
    return found


def _usual_sentinel(x: Array) -> Flags:
    """Nothing but nines, or the full scale of a converter."""
    text = np.array([f"{abs(value):.6g}".replace(".", "") for value in np.unique(x)])
    nines = [len(t) > 1 and set(t) == {"9"} for t in text]
    special = np.unique(x)[np.array(nines, dtype=bool)] if text.size else np.zeros(0)
    return np.isin(x, [*special, *FULL_SCALE]) | (np.abs(x) >= 1e30)


def _cluster(x: Array) -> tuple[float, float]:
    """Lowest and highest value of the channel itself: no gap of `ISOLATED` of its ranges in between."""
    values = np.unique(x)
    low, high = (float(q) for q in np.quantile(x, (0.05, 0.95)))
    reach = ISOLATED * (high - low)
    for value in values[values > high]:
        if value - high > reach:
            break
        high = float(value)
    for value in values[values < low][::-1]:
        if low - value > reach:
            break
        low = float(value)
    return low, high


def findings(
    values: Array, first: Flags, rows: NDArray[np.int64], channels: Channels, step: float
) -> list[Finding]:
    """What the rows of a log show.

    values (R, n_z + n_a): states and inputs, NaN where a number is missing; first (R,): whether a row
    is the first of a trajectory; rows (R,): their numbers in the file; step: seconds between two rows.
    """
    if len(values) < LEAST:
        return []
    n_z = len(channels.states)
    states, inputs = values[:, :n_z], values[:, n_z:]
    held = np.r_[True, (inputs[1:] == inputs[:-1]).all(axis=1)] | first
    found: dict[tuple[str, int, int], tuple[list[int], Flags]] = {}
    slow: dict[int, list[int]] = {}
    straight: dict[int, list[int]] = {}
    moves = [_Runs.of(u, first) for u in inputs.T]
    regular = [_regular(runs) for runs in moves]
    for i, x in enumerate(states.T):
        if np.ptp(x[np.isfinite(x)]) == 0.0 if np.isfinite(x).any() else True:
            continue
        runs = _Runs.of(x, first)
        period = _slow(runs)
        if period:
            slow.setdefault(period, []).append(i)
        elif lines := _interpolated(x, first, ~held, regular):
            straight.setdefault(lines, []).append(i)
        kinds = {"spike": _spikes(x, inputs, first), "wrap": _wraps(x, first)}
        if not period:
            kinds |= {"saturated": _saturated(x, runs), "frozen": _frozen(x, runs, held)}
            kinds["frozen"] &= ~kinds["saturated"]
        for kind, spoilt in kinds.items():
            if spoilt.any():
                place = int(np.argmax(spoilt)), int(spoilt.sum())
                found.setdefault((kind, *place), ([], spoilt))[0].append(i)
    others = np.any(
        [np.zeros(len(values), dtype=bool), *(own for _, own in found.values())], axis=0
    )
    others[1:] |= others[:-1].copy()
    result = [
        Finding(_sentence(kind, own, spoilt, states, rows, channels), spoilt)
        for (kind, _, _), (own, spoilt) in found.items()
    ]
    nothing = np.zeros(len(values), dtype=bool)
    if (jumps := _jumps(states, inputs, first) & ~others).any():
        more = f" (and in {int(jumps.sum()) - 1} more rows)" if jumps.sum() > 1 else ""
        text = (
            f"the states jump in row {rows[int(np.argmax(jumps))]}{more}, and not by an input, as "
            "where another experiment begins: a trajectory begins there"
        )
        result.append(Finding(text, nothing, begins=jumps))
    if sum(map(len, slow.values())) < n_z:  # the others are as fast as the log
        for period in regular:
            slow.pop(period, None)
    for period, own in slow.items():
        names = listed([channels.state(i) for i in own])
        result.append(
            Finding(
                f"{names} {'changes' if len(own) == 1 else 'change'} in every "
                f"{_ordinal(period)} row only, so the log is faster than the sensor (first in row "
                f"{rows[min(period, len(rows) - 1)]}): give --resample {period * step:.6g}",
                nothing,
                period,
            )
        )
    for period, own in straight.items():
        names, lie = listed([channels.state(i) for i in own]), "lies" if len(own) == 1 else "lie"
        result.append(
            Finding(
                f"{names} {lie} on straight lines of {period} rows, as where readings of a slower "
                "sensor are interpolated, which no model of single rows describes: give --resample "
                f"{period * step:.6g}",
                nothing,
                period,
            )
        )
    result += [Finding(text, nothing) for text in _twins(values, rows, channels)]
    result += [Finding(text, nothing) for text in _drifts(states, inputs, first, channels)]
    return result + _stuck(states, inputs, moves, first, rows, channels)


def _sentence(
    kind: str,
    own: Sequence[int],
    spoilt: Flags,
    states: Array,
    rows: NDArray[np.int64],
    channels: Channels,
) -> str:
    k, count = int(np.argmax(spoilt)), int(spoilt.sum())
    names, value = listed([channels.state(i) for i in own]), states[k, own[0]]
    are = "is" if len(own) == 1 else "are"
    more = f" (and in {count - 1} more rows)" if count > 1 else ""
    if kind == "spike":
        return (
            f"{names} {'jumps' if len(own) == 1 else 'jump'} to {value:.6g} for one row, row "
            f"{rows[k]}{more}: leave it out with --cut"
        )
    if kind == "wrap":
        return (
            f"{names} {'jumps' if len(own) == 1 else 'jump'} from one end of the range to the other in "
            f"row {rows[k]}{more}, as an angle or a counter that begins anew: log it without that (as "
            "numpy.unwrap makes it), or begin a trajectory there with --cut"
        )
    if kind == "saturated":
        return (
            f"{names} {are} at {value:.6g}, an end of the range, in {count} rows, the first of them "
            f"row {rows[k]}, as of a saturated sensor: leave them out with --cut"
        )
    return (
        f"{names} {are} frozen ({value:.6g}) in {count} rows, from row {rows[k]} on: leave them out "
        "with --cut"
    )


def _slow(runs: _Runs) -> int:
    """Rows between two changes of a channel that hardly ever changes twice in a row; or 0."""
    lengths, changes = runs.lengths[runs.whole], runs.before[runs.whole]
    if len(lengths) < 10 or (lengths == 1).mean() >= 0.1:
        return 0
    if np.median(changes) < 3.0 * runs.resolution:  # a slow signal in coarse steps
        return 0
    return int(np.median(lengths))


def _regular(runs: _Runs) -> int:
    """The rows between two changes of an input, if they are always the same; or 0."""
    period = _slow(runs)
    return period if period and (runs.lengths[runs.whole] % period == 0).mean() > FOLLOWED else 0


def _interpolated(x: Array, first: Flags, moved: Flags, regular: Sequence[int]) -> int:
    """Rows of the straight lines of which a channel consists, if no input bends them; or 0.

    moved (R,): the rows in which an input moves; regular: those between two moves of each.
    """
    known = x[np.isfinite(x)]
    largest = np.abs(known).max(keepdims=True)
    rounded = RESTING * float(_last_digits(largest, known[: 100 * LEAST])[0])
    change = np.diff(x)
    change[first[1:]] = np.nan
    size, bend = np.abs(change), np.abs(np.diff(change))
    moving = np.minimum(size[1:], size[:-1]) > 10.0 * rounded
    bent = bend > rounded
    if moving.sum() < LEAST or bent[moving].mean() > 0.6:
        return 0
    knots = np.flatnonzero(bent)
    gaps = np.diff(knots)
    if len(gaps) < 10 or np.median(bend[knots]) < 10.0 * rounded or (gaps == 1).mean() > 0.1:
        return 0
    period = int(np.median(gaps))
    late = [moved[np.maximum(knots + 1 - lag, 0)].mean() for lag in range(-1, LATEST + 1)]
    if max(late) > FOLLOWED > 2.0 * moved.mean():  # the plant keeps its direction between inputs
        return 0
    return 0 if period in regular else period


def _spikes(x: Array, inputs: Array, first: Flags) -> Flags:
    """Rows to which a channel jumps, and back, as it never does else, without a pulse of an input."""
    change = np.diff(x)
    change[first[1:]] = np.nan
    size = np.abs(change)
    known = size[np.isfinite(size)]
    found = np.zeros(len(x), dtype=bool)
    if not known.any():
        return found
    usual = max(float(np.quantile(known, 0.98)), RESTING * float(known[known > 0].min()))
    back = change[:-1] * change[1:] < 0.0
    found[1:-1] = back & (np.minimum(size[:-1], size[1:]) > SPIKE * usual)
    pulse = np.zeros(len(x), dtype=bool)
    moved = np.diff(inputs, axis=0)
    pulse[1:-1] = (moved[:-1] * moved[1:] < 0.0).any(axis=1)
    pulse[1:] |= pulse[:-1].copy()
    return found & ~pulse


def _wraps(x: Array, first: Flags) -> Flags:
    """Rows to which a channel jumps from one end of its range to the other, which it reaches slowly."""
    change = np.diff(x)
    change[first[1:] | ~np.isfinite(change)] = 0.0
    ends, size = float(np.ptp(x[np.isfinite(x)])), np.abs(change)
    jumps = size > WRAPPED * ends
    slow = np.where(jumps, 0.0, change)
    found = np.zeros(len(x), dtype=bool)
    turned = any(WRAPPED * turn < ends <= turn * (1.0 + 1e-3) for turn in TURNS)
    wound = jumps.sum() > 1 and np.ptp(np.cumsum(slow)) > WRAPPED * ends
    if size[~jumps].max(initial=0.0) < SLOW * ends and (turned or wound):
        found[1:] = jumps
    return found


def _jumps(states: Array, inputs: Array, first: Flags) -> Flags:
    """Rows to which most channels jump, and stay, as neither the states nor the inputs explain.

    Steps are explained by a linear regression, on inputs with dead times as well.
    """
    found = np.zeros(len(states), dtype=bool)
    rows = np.flatnonzero(~first[1:])
    parts = states[:, np.ptp(states, axis=0) > 0.0], inputs
    if not (np.isfinite(states).all() and np.isfinite(inputs).all() and parts[0].size):
        return found
    z, u = ((x - x.mean(axis=0)) / np.where(np.ptp(x, axis=0), x.std(axis=0), 1.0) for x in parts)
    modes = linalg.svd(z, full_matrices=False)[2][: max(len(z) // LEAST, 1)]
    lags = range(-1, min(LATEST, len(z) // (LEAST * u.shape[1])) + 1)
    near = [u[np.maximum(rows - lag, 0)] for lag in lags]
    known = np.hstack([np.ones((len(rows), 1)), z[rows] @ modes.T, *near])
    step = z[rows + 1] - z[rows]
    missed = np.abs(step - known @ linalg.lstsq(known, step)[0])
    least = EXPLAINED * np.quantile(np.abs(step), 0.98, axis=0)
    usual = np.maximum(np.quantile(missed, 0.98, axis=0), least)
    size = np.zeros(len(states))
    size[rows + 1] = np.quantile(missed / usual, 0.5, axis=1, method="lower")
    near_by = np.maximum(np.r_[0.0, size[:-1]], np.r_[size[1:], 0.0])
    found[:] = (size > SPIKE) & (size > SPIKE * near_by)
    return found


def _drifts(states: Array, inputs: Array, first: Flags, channels: Channels) -> list[str]:
    """States whose rest moves with time, as of a machine that wears or of a disturbance that grows.

    Steps are explained by a linear regression on `PAST` rows, without and with a trend; one trajectory.
    """
    z, u = states, inputs[: len(states) - 1]
    width = PAST * (z.shape[1] + u.shape[1]) + 2
    if first[1:].any() or not (np.isfinite(z).all() and np.isfinite(u).all()) or len(u) < 5 * width:
        return []
    k = np.arange(PAST - 1, len(u))
    known = np.hstack([np.ones((len(k), 1)), *(x[k - lag] for x in (z, u) for lag in range(PAST))])
    trend = k / len(u) - 0.5
    trend = trend - known @ linalg.lstsq(known, trend)[0]
    found = linalg.lstsq(known, z[k + 1])[0]
    missed = z[k + 1] - known @ found
    seen = trend @ missed
    gained = seen**2 / (trend @ trend)
    least = EXPLAINED**2 * np.sum((z[k + 1] - z[k]) ** 2, axis=0)
    left = np.maximum(np.sum(missed**2, axis=0) - gained, least)
    # What a linear model misses of a nonlinear plant is no noise from row to row.
    rest = trend[:, None] * (missed - np.outer(trend, seen / (trend @ trend)))
    chance = sum(np.sum(part, axis=0) ** 2 for part in np.array_split(rest, BLOCKS))
    sure = (gained * (len(k) - width) > DRIFT * left) & (seen**2 > DRIFT * chance)
    own = np.flatnonzero(sure)
    if not own.size:
        return []
    names = listed([channels.state(i) for i in own.tolist()])
    drift, them = ("drifts", "it") if own.size == 1 else ("drift", "them")
    return [
        f"{names} {drift} through the log, and not by an input, which a model takes for slow modes and "
        f"wrong gains: give what drives {them} as an input, or take the trend out"
    ]


def _stuck(
    states: Array,
    inputs: Array,
    moves: Sequence[_Runs],
    first: Flags,
    rows: NDArray[np.int64],
    channels: Channels,
) -> list[Finding]:
    """Inputs that stand still in the log for long, while the states move as by one that does not.

    moves: the runs of each input. Steps are explained by linear regressions on two rows, of those rows
    and of the others apart.
    """
    pair = np.flatnonzero(~(first[2:] | first[1:-1]))
    known = np.hstack(
        [np.ones((len(pair), 1)), *(x[pair + i] for x in (states, inputs) for i in (0, 1))]
    )
    step = states[pair + 2] - states[pair + 1]
    least = 5 * known.shape[1]
    if len(pair) < 2 * least or not (np.isfinite(known).all() and np.isfinite(step).all()):
        return []
    found = []
    for j, runs in enumerate(moves):
        longest = int(np.argmax(runs.lengths))
        begin, length = int(runs.begins[longest]), int(runs.lengths[longest])
        own = (pair >= begin) & (pair + 1 < begin + length)
        others = (
            np.quantile(np.delete(runs.lengths, longest), 0.95) if len(runs.lengths) > 1 else 0.0
        )
        if length < STUCK * others or min(own.sum(), (~own).sum()) < least:
            continue
        inside, outside = (
            np.var(step[part] - known[part] @ linalg.lstsq(known[part], step[part])[0], axis=0)
            for part in (own, ~own)
        )
        usual = np.maximum(outside, EXPLAINED**2 * np.var(step, axis=0))
        moved = np.flatnonzero(inside > UNLOGGED * usual)
        if moved.size:
            spoilt = np.zeros(len(states), dtype=bool)
            spoilt[begin : begin + length] = True
            names = listed([channels.state(i) for i in moved.tolist()])
            found.append(
                Finding(
                    f"{channels.input(j)} stands at {inputs[begin, j]:.6g} in {length} rows, from row "
                    f"{rows[begin]} on, while {names} {'moves' if moved.size == 1 else 'move'} as by "
                    "an input that is not in the log: leave them out with --cut",
                    spoilt,
                )
            )
    return found


def _frozen(x: Array, runs: _Runs, held: Flags) -> Flags:
    """Rows of long runs that begin or end in the middle of a motion."""
    others = np.quantile(runs.lengths, 0.95) if len(runs.lengths) > LEAST else 1.0
    long = (runs.lengths >= FROZEN) & (runs.lengths >= LONGER * others) & (runs.before > 0.0)
    left = runs.after > RESTING * runs.grain
    for number in np.flatnonzero(long & ~runs.abrupt):
        begin = runs.begins[number]
        moved = not held[begin + 1 : begin + runs.lengths[number] - 1].all()
        long[number] = moved and left[number]
    return runs.rows(long, len(x))


def _saturated(x: Array, runs: _Runs) -> Flags:
    """Rows of several runs at the largest or the smallest value, reached in the middle of a motion."""
    found = np.zeros(len(x), dtype=bool)
    for end in (np.nanmax(x), np.nanmin(x)):
        own = (x[runs.begins] == end) & (runs.lengths >= 3)
        count, rows = int(own.sum()), int(runs.lengths[own].sum())
        elsewhere = runs.lengths[~own & (x[runs.begins] != end)]
        usual = float(elsewhere.mean()) if elsewhere.size else np.inf
        enough = count > 1 and rows >= max(SATURATED, SATURATED_SHARE * len(x))
        if enough and runs.abrupt[own].mean() >= 0.5 and rows / count >= 3.0 * usual:
            found |= x == end
    return found


def _twins(values: Array, rows: NDArray[np.int64], channels: Channels) -> list[str]:
    """Two channels, of which one at least is a state, that are one in two units."""
    n_z, names = len(channels.states), [*channels.states, *channels.inputs]
    whole = values[np.isfinite(values).all(axis=1)]
    if len(whole) < LEAST or values.shape[1] > PAIRS:
        return []
    centred = whole - whole.mean(axis=0)
    spread = centred.std(axis=0)
    moving = np.flatnonzero(spread > 1e-12 * np.abs(whole).max(axis=0))
    unit = centred[:, moving] / spread[moving]
    with np.errstate(all="ignore"):
        change = np.abs(np.diff(whole[:, moving], axis=0))
        grain = np.nanmin(np.where(change > 0.0, change, np.nan), axis=0) / spread[moving]
    grain = np.where(grain < 0.02, grain, 0.0)
    same = np.abs(unit.T @ unit) / len(unit)
    found, taken = [], set[int]()
    for i, j in np.argwhere(np.triu(same > 1.0 - 1e-3, 1)).tolist():
        one, other = int(moving[i]), int(moving[j])
        if one in taken or other in taken or (one >= n_z and other >= n_z):
            continue
        sign = np.sign(unit[:, i] @ unit[:, j])
        if np.abs(unit[:, j] - sign * unit[:, i]).max() > max(ONE, grain[i] + grain[j]):
            continue
        taken.add(other)
        factor = sign * spread[other] / spread[one]
        offset = whole[:, other].mean() - factor * whole[:, one].mean()
        scaled = names[one] if abs(factor - 1) < 1e-3 else f"{factor:.4g} {names[one]}"
        small = abs(offset) < 1e-3 * spread[other]
        plus = "" if small else f" {'+' if offset > 0.0 else '-'} {abs(offset):.4g}"
        flag = "--states" if other < n_z else "--inputs"
        found.append(
            f"{names[other]} is {scaled}{plus} in every row from row {rows[0]} on, so the two are one "
            f"channel: leave one out of {flag}"
        )
    if len(found) > SHOWN:
        found[SHOWN:] = [f"{len(found) - SHOWN} more channels are others again"]
    return found


def _ordinal(number: int) -> str:
    """2nd, 3rd, 4th, ..."""
    endings = {1: "st", 2: "nd", 3: "rd"}
    return f"{number}{'th' if number % 100 in (11, 12, 13) else endings.get(number % 10, 'th')}"
