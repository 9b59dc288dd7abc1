# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Whether and when the inputs of a log move its states, and whether a controller made them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence

import numpy as np
from scipy import linalg

from pdeloop.messages.arrays import Array
from pdeloop.method.reduce.channels import NUMBERED, SHOWN, Channels, listed, scaled
from pdeloop.method.reduce.identifiability import LEFT, NotIdentifiableError, examine_steps
from pdeloop.method.reduce.input_delay import Delays, DelayStudy
from pdeloop.method.reduce.reduced_model import Samples, Trajectory, numerical_rank, steps_of
from pdeloop.process.one_thread import one_thread

ROUNDING = 1e-10
"""Size of a residual, relative to the states, that is rounding."""
BY_CHANCE = 1e-4
"""Probability with which one test takes an input without effect for one that has some."""
COARSER = 4
"""Rows of which the mean is taken, again and again, to see slow effects."""
PAST = 8
"""Rows whose inputs may have an effect on readings that do not show the whole state."""
FED_BACK = 0.1
"""Independence of the last `PAST` rows below which an input may be that of a controller."""
RESTS, NEARLY = 1e-9, 1e-2
"""Ranges of a channel, relative to its largest value, that are rounding, and that are small."""
DIGITS = 3
"""Steps in which a channel was written that a small range of one at rest has at most."""


def require_effects(trajectories: Sequence[Trajectory], channels: Channels = NUMBERED) -> None:
    """NotIdentifiableError for inputs that changed the states by no more than chance does.

    From one row to the next, from one mean of 4, 16, ... rows to the next, where a slow effect in noise
    shows, and by the inputs of `PAST` rows, whose effect on few readings takes its time. Inputs that
    cannot be told apart are left to others.
    """
    data = steps_of(trajectories)
    y = data.actions
    with one_thread():
        if examine_steps(data, linalg.svd(data.after, full_matrices=False)[2][:1].T).faults:
            return
        none = {*range(y.shape[1] if len(y) > y.shape[1] + LEFT else 0)}
        for coarse in coarsened(trajectories):
            if not none:
                break
            none -= _with_effect(steps_of(coarse), none)
        modes = linalg.svd(data.after, full_matrices=False)[2][:PAST].T
        known = [_with_past(z @ modes, a) for z, a in trajectories if len(a) > 2 * PAST]
        lags = [j + i * y.shape[1] for j in none for i in range(PAST)]
        if none and known:
            none -= {j % y.shape[1] for j in _with_effect(steps_of(known), lags)}
    if none:
        own = sorted(none)
        names = [channels.input(j) for j in own]
        moves, means = y.std(axis=0)[own].tolist(), y.mean(axis=0)[own].tolist()
        raise NotIdentifiableError(no_effect(names, moves, means))


def require_motion(trajectories: Sequence[Trajectory], channels: Channels = NUMBERED) -> None:
    """NotIdentifiableError where no state moves by more than rounding.

    That is double precision, or, of inputs that hardly move either, the last digits that were written.
    """
    states, inputs = (np.concatenate(own) for own in zip(*trajectories, strict=True))
    moved, pushed = (_ranges(own) for own in (states, inputs))
    digits = [np.diff(np.unique(x)).min(initial=np.inf) for x in states.T]
    written = np.ptp(states, axis=0) <= DIGITS * np.array(digits)
    still = bool((pushed <= NEARLY).all())
    if not ((moved <= RESTS) | (still & written & (moved <= NEARLY))).all():
        return
    own = [channels.input(int(j)) for j in np.flatnonzero(pushed > NEARLY)]
    other = f", although {listed(own)} moved" if own else ", nor an input by more than 1 %"
    raise NotIdentifiableError(
        f"in all of the log the plant stands still: no state moves by more than {moved.max():.1g} of "
        f"its size, which is rounding{other}; log an experiment in which the inputs move the states"
    )


def _ranges(columns: Array) -> Array:
    """That of each column, relative to its largest magnitude."""
    size = np.abs(columns).max(axis=0)
    return np.asarray(np.ptp(columns, axis=0) / np.where(size > 0.0, size, 1.0))


def fed_back(trajectories: Sequence[Trajectory]) -> list[int]:
    """The inputs that the states and inputs of the last `PAST` rows tell, as those of a controller.

    With an integral part, at a constant set point, it has but noise that tells them from the state.
    """
    n_a, before, inputs = trajectories[0][1].shape[1], list[Array](), list[Array]()
    for states, a in (_with_past(z, a) for z, a in trajectories if len(a) > PAST):
        before.append(np.hstack([states[:-1], a[:, n_a:]]))
        inputs.append(a[:, :n_a])
    if not before:
        return []
    known = np.concatenate(before)
    with one_thread():
        steps = Samples(known, np.concatenate(inputs), known)
        own = examine_steps(steps, np.eye(known.shape[1], 1)).independence
    return [int(j) for j in np.flatnonzero(own < FED_BACK)]


def coarsened(trajectories: Sequence[Trajectory]) -> Iterator[list[Trajectory]]:
    """The trajectories, and those of means of 4, 16, ... rows, as long as two means are left.

    The inputs of a mean are those from its middle to that of the next one.
    """
    coarse, half = list(trajectories), COARSER // 2
    while coarse:
        yield coarse
        finer, coarse = coarse, []
        for z, a in finer:
            if (count := len(z) // COARSER) >= 2:
                inputs = a[half : half + COARSER * (count - 1)].reshape(count - 1, COARSER, -1)
                rows = z[: COARSER * count].reshape(count, COARSER, -1)
                coarse.append((rows.mean(axis=1), inputs.mean(axis=1)))


def _with_past(z: Array, a: Array) -> Trajectory:
    """The last `PAST` states and inputs as those of each row."""
    z, a = (np.hstack([x[PAST - 1 - i : len(x) - i] for i in range(PAST)]) for x in (z, a))
    return z, a


def _with_effect(data: Samples, asked: Iterable[int]) -> set[int]:
    """Inputs of which z_{k+1} tells more than noise would: Hotelling's test of a column of B."""
    from scipy import special  # here, as no training needs it

    before, after, y = (
        part - part.mean(axis=0) for part in (data.before, data.after, data.actions)
    )
    y = scaled(y)[0]
    steps, n_a = y.shape
    _, values, modes = linalg.svd(after, full_matrices=False)
    most = min(numerical_rank(values, *after.shape), (steps - n_a - 1) // 4)
    found = set[int]()
    for n in sorted({min(2**i, most) for i in range(2, 2 + max(most, 0).bit_length())}):
        for j in {*asked} - found if n > 0 else ():
            known = np.hstack([before @ modes[:n].T, np.delete(y, j, axis=1)])
            left = np.column_stack([y[:, j], after @ modes[:n].T])
            left -= known @ linalg.lstsq(known, left)[0]
            columns, sizes, _ = linalg.svd(left[:, 1:], full_matrices=False)
            columns = columns[:, sizes > ROUNDING * values[0]]
            told, r = float(linalg.norm(columns.T @ left[:, 0])) ** 2, columns.shape[1]
            chance = special.betaincinv(r / 2, (steps - 1 - n - n_a - r) / 2, 1.0 - BY_CHANCE)
            if r and told > chance * float(linalg.norm(left[:, 0])) ** 2:
                found.add(j)
    return found


def no_effect(names: Sequence[str], moves: Sequence[float], means: Sequence[float]) -> str:
    """Message about inputs of whose effect the data show nothing; moves: standard deviations."""
    pairs = list(zip(moves, means, strict=True))[:SHOWN]
    own = ", ".join(f"{move:.2g} about {mean:.4g}" for move, mean in pairs)
    it = "it" if len(names) == 1 else "them"
    return (
        f"beside their noise the states show no effect of {listed(names)}, which moved by {own}: move "
        f"{it} more, give an --input-delay of more than ten rows, or leave {it} out of --inputs"
    )


def delay_text(
    found: DelayStudy, channels: Channels = NUMBERED, sample_time: float | None = None
) -> str:
    """One sentence on what is better than the delays in use; empty if nothing is."""
    best, used = found.best, found.used
    if best == used:
        return ""
    if found.beside:
        names = listed([channels.input(j) for j, n in enumerate(best) if n != used[j]])
        return (
            f"the data fit {found.gain:.3g} times better with {names} of their own row as well, not "
            "of the row before alone, as where rows are means over time or are read after the "
            "inputs have changed: log what is read as they change, or give "
            f"--input-delay={_value(best)}, with which a model in innovation form has both"
        )
    moves = dict.fromkeys(np.subtract(best, used).tolist())
    parts = []
    for move in moves:
        own = [j for j in range(len(best)) if best[j] - used[j] == move]
        names = listed([channels.input(j) for j in own]) if len(moves) > 1 else "the inputs"
        if move:
            way = "earlier" if move < 0 else "later"
            least = "at least " if any(best[j] in found.at_end for j in own) else ""
            rows = "one row" if abs(move) == 1 else f"{abs(move)} rows"
            parts.append(f"{names} {least}{rows} {way}")
    why = []
    if max(best) > 0:
        times = "" if sample_time is None else f" of {max(best) * sample_time:.3g} s"
        why.append(f"the plant has a dead time{times}, or the log is ahead of it")
    if min(best) < 0:
        why.append("a row has the input that led to its state, logged late")
    fit = f"the data fit {found.gain:.3g} times better with {' and '.join(parts)}, so "
    if found.alike or found.at_end:
        others = " or ".join(map(_value, found.alike[:3]))
        unclear = (
            f"the data do not tell {_value(best)} and {others} apart: log more steps or less noise"
            if found.alike
            else "more are not tried in a log of this length: log more steps"
        )
        return (
            f"{fit}{' and '.join(why)}; how many rows is not clear, as {unclear}, or give the "
            f"number that is known, as --input-delay={_value(best)}"
        )
    return f"{fit}{' and '.join(why)}: give --input-delay={_value(best)}"


def _value(delays: Delays) -> str:
    """Delays as --input-delay takes them."""
    return ",".join(map(str, delays[:1] if len({*delays}) == 1 else delays))
