# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Whether one linear model holds in all of a log, and what explains best that it does not.

Steps are explained by linear regressions on the last states and inputs. Anything else counts if it
lowers the squares that are missed in parts that were held out: what a linear plant has beside these
rows, as noise and hidden states, is correlated in time and fits much by chance.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations_with_replacement

import numpy as np
from scipy import linalg

from pdeloop.log_effects import coarsened
from pdeloop.messages.arrays import Array
from pdeloop.method.reduce.channels import NUMBERED, Channels, listed
from pdeloop.method.reduce.reduced_model import Trajectory
from pdeloop.process.one_thread import one_thread

ROUNDED = 1e-6
"""Residuals of this size relative to the variation of the data are rounding."""
TINY = 1e-12
"""Variation of a channel relative to its size that is none."""
LEAST = 4
"""Residuals for each regressor, at least."""
CHANGED = 2.0
"""Residuals of one model relative to those of one before a row and another after it, as squares, from
which on the plant changed there."""
PLACES = 20
"""Rows at which this is looked for, beside the beginnings of trajectories."""
BENT = 1.3
"""Residuals of a linear model relative to those of one with more, as squares of parts that were held
out, from which on it counts."""
FOLDS = 4
"""Groups of two parts of the data that are held out one after the other."""
MODES = 4
"""Leading modes of the state in products."""
KNOTS = 0.1, 0.25, 0.5, 0.75, 0.9
"""Quantiles of an input between which its effect is linear."""
RATES = 2.0 ** -np.arange(0.5, 6.5, 0.5)
"""Rates of an actuator that are tried, in the largest change of its input."""
REACHED = 0.05
"""Share of the rows in which an actuator has come to its input."""
PAST = 4, 8
"""Rows of states and inputs beside which a rate counts: valves that follow late need no limit."""


@dataclass(frozen=True)
class Misfit:
    """Something that a linear model does not describe; ratio: of squares that it misses for that."""

    state: int
    inputs: tuple[int, ...]
    ratio: float
    text: str


@dataclass(frozen=True, eq=False)
class _Rows:
    """Steps: regressors (N, r), which begin with the constant 1, and the states after them (N, n_z).

    s (N, n_z), u (N, n_a): scaled states, and inputs, of their row; first: the row of the first one.
    """

    known: Array
    after: Array
    s: Array
    u: Array
    first: int

    @staticmethod
    def of(trajectories: Sequence[Trajectory], states: int = 2, inputs: int = 2) -> _Rows:
        """Steps with so many rows of states and of inputs as regressors."""
        of_z, of_u = (np.concatenate(own) for own in zip(*trajectories, strict=True))
        z_unit, u_unit = (
            np.where(x.std(0) > TINY * np.abs(x).max(0), x.std(0), np.inf) for x in (of_z, of_u)
        )
        first, parts = max(states, inputs) - 1, []
        for z, a in trajectories:
            s, u = (z - of_z.mean(axis=0)) / z_unit, (a - of_u.mean(axis=0)) / u_unit
            lags = [
                x[first - i : len(a) - i] for x, n in ((s, states), (u, inputs)) for i in range(n)
            ]
            parts += [
                (np.hstack(lags), z[first + 1 : len(a) + 1], s[first : len(a)], a[first:])
            ] * (len(a) > first)
        if not parts:
            return _Rows(of_z[:0], of_z[:0], of_z[:0], of_u[:0], first)
        known, after, s, u = (np.concatenate(own) for own in zip(*parts, strict=True))
        return _Rows(np.hstack([np.ones((len(known), 1)), known]), after, s, u, first)

    def enough(self, more: int) -> bool:
        """Whether there are enough steps for so many further regressors."""
        return bool(len(self.known) >= LEAST * (self.known.shape[1] + more))

    def missed(self, *more: Array) -> Array:
        """Squares that are missed of each state in each part held out, with further regressors."""
        columns, after, found = np.hstack([self.known, *more]), self.after, []
        pieces = np.array_split(np.arange(len(after)), 2 * FOLDS)
        for i in range(FOLDS):
            own = np.r_[pieces[i], pieces[i + FOLDS]]
            W = linalg.lstsq(np.delete(columns, own, 0), np.delete(after, own, 0), cond=1e-10)[0]
            found.append(np.sum((after[own] - columns[own] @ W) ** 2, axis=0))
        size = np.maximum(after.std(axis=0), ROUNDED * np.abs(after).max(axis=0))
        return np.asarray(np.maximum(found, len(after) / FOLDS * (ROUNDED * size) ** 2 + 1e-300))


def _ratio(without: Array, every: Array) -> tuple[int, float]:
    """The state that more regressors explain best, and how much better, in all and in most parts."""
    ratio = np.minimum(without.sum(axis=0) / every.sum(axis=0), np.median(without / every, axis=0))
    return int(ratio.argmax()), float(ratio.max())


def structural_break(trajectories: Sequence[Trajectory]) -> tuple[int, int, float] | None:
    """Where the states begin to follow the inputs otherwise: trajectory, its step, ratio of squares.

    Residuals of steps by regressions on two rows, of all data and of those before and after a step
    (Chow, Econometrica 28(3), 1960), of the state for which that matters most.
    """
    rows, sizes = _Rows.of(trajectories), [max(len(a) - 1, 0) for _, a in trajectories]
    steps = [(i, k) for i, count in enumerate(sizes) for k in range(1, count + 1)]
    width = rows.known.shape[1]
    if len(steps) < 4 * LEAST * width:
        return None
    mean, unit = rows.after.mean(axis=0), rows.after.std(axis=0)
    unit[unit <= TINY * np.abs(mean)] = np.inf
    known = np.hstack([rows.known, (rows.after - mean) / unit])
    begins = np.cumsum(sizes)[:-1]
    places = np.unique(np.r_[begins, np.arange(1, PLACES) * len(steps) // PLACES])
    squares = [part.T @ part for part in np.split(known, places)]
    before, total = np.cumsum(squares, axis=0), np.sum(squares, axis=0)

    def missed(G: Array) -> Array:
        own = linalg.lstsq(G[:width, :width], G[:width, width:], cond=1e-10)[0]
        return np.asarray(np.diag(G)[width:] - np.sum(G[:width, width:] * own, axis=0))

    least, one, best = ROUNDED * np.diag(total)[width:], missed(total), (0, 0, CHANGED)
    for place, G in zip(places, before, strict=False):
        if min(place, len(steps) - place) > LEAST * width:
            two = np.maximum(missed(G) + missed(total - G), least)
            with np.errstate(divide="ignore", invalid="ignore"):
                ratio = (
                    float(np.nanmax(one / two)) * (len(steps) - 2 * width) / (len(steps) - width)
                )
            if ratio > best[2]:
                best = *steps[place], ratio
    return None if best[2] == CHANGED else best


def products(trajectories: Sequence[Trajectory], channels: Channels = NUMBERED) -> Misfit | None:
    """Powers and products of leading modes and inputs, where these explain the steps better.

    Steps from one row to the next, and from one mean of 4, 16, ... rows, beside which noise is small.
    """
    best = None
    for parts in coarsened(trajectories):
        if not (rows := _Rows.of(parts)).enough(0):
            break
        linear = rows.missed()
        with one_thread():
            s = rows.s @ linalg.svd(rows.s, full_matrices=False)[2][:MODES].T
        u = (rows.u - rows.u.mean(axis=0)) / np.maximum(rows.u.std(axis=0), 1e-300)
        mixed, terms = [s * u[:, j : j + 1] for j in range(u.shape[1])], list[Array]()
        for factors in ((s, s), (u, u)), ((s, s, s),):
            terms += [
                np.prod([x[:, i] for x, i in zip(kind, own, strict=True)], axis=0)
                for kind in factors
                for own in combinations_with_replacement(range(kind[0].shape[1]), len(kind))
            ]
            if not rows.enough(len(terms) + s.shape[1] * u.shape[1]):
                break
            alone = np.column_stack(terms)
            every = rows.missed(alone, *mixed)
            i, ratio = _ratio(linear, every)
            if ratio <= (best.ratio if best else BENT):
                continue
            fewer = [
                _ratio(rows.missed(alone, *mixed[:j], *mixed[j + 1 :])[:, [i]], every[:, [i]])[1]
                for j in range(len(mixed))
            ]
            own = [j for j, lost in enumerate(fewer) if lost > BENT]
            if not own and _ratio(rows.missed(alone)[:, [i]], every[:, [i]])[1] > BENT:
                own = [int(np.argmax(fewer))]
            kind = "powers and products of states and inputs"
            like = "where an outflow goes with the root of a level or heat is radiated"
            if own:
                kind = f"products of a state and {listed([channels.input(j) for j in own])}"
                like = "where a flow carries heat or a valve opens a path"
            text = (
                f"{channels.state(i)} follows {kind} (a linear model misses {ratio:.3g} times the "
                f"squares of one with them), as {like}: poles and gains change with the point, and a "
                "linear law holds near its target alone; identify from rows near it, or by the model "
                "of the whole field, which has products (with a --target)"
            )
            best = Misfit(i, tuple(own), ratio, text)
    return best


def disproportionate(
    trajectories: Sequence[Trajectory], channels: Channels = NUMBERED
) -> Misfit | None:
    """A piecewise linear effect of an input; inputs of few values do not tell."""
    rows, best = _Rows.of(trajectories), None
    if not rows.enough(len(KNOTS)):
        return None
    linear = rows.missed()
    for j, a in enumerate(rows.u.T):
        if len(np.unique(a)) < 2 * len(KNOTS):
            continue
        knots = np.unique(np.quantile(a, KNOTS))
        bends = np.maximum(a[:, None] - knots, 0.0) / a.std()
        i, ratio = _ratio(linear, rows.missed(bends))
        if ratio > (best.ratio if best else BENT):
            columns = np.hstack([rows.known, bends])
            own = linalg.lstsq(columns, rows.after[:, i], cond=1e-10)[0] / a.std()
            of_input = rows.known.shape[1] - 2 * rows.u.shape[1] + j
            sizes = np.r_[own[of_input], own[rows.known.shape[1] :]].cumsum().tolist()
            ends = np.r_[a.min(), knots, a.max()].tolist()
            pieces = sorted(
                zip(sizes, ends, ends[1:], strict=False), key=lambda piece: abs(piece[0])
            )
            (least, low, high), *_, (most, *other) = pieces
            text = (
                f"{channels.state(i)} does not follow {channels.input(j)} in proportion (a linear "
                f"model misses {ratio:.3g} times the squares of a piecewise linear one): in a step "
                f"it moves by {most:.2g} per unit between {other[0]:.4g} and {other[1]:.4g}, and by "
                f"{least:.2g} between {low:.4g} and {high:.4g}, as where an actuator saturates or has "
                "a dead band: log what it applies or identify from rows in which it follows"
            )
            best = Misfit(i, (j,), ratio, text)
    return best


def rate_limited(
    trajectories: Sequence[Trajectory], channels: Channels = NUMBERED
) -> Misfit | None:
    """An actuator that follows its logged input at a limited rate: that which explains most."""
    rows = _Rows.of(trajectories, *PAST)
    if not rows.enough(2):
        return None
    rates = np.max(
        [np.abs(np.diff(a, axis=0)).max(axis=0, initial=0.0) for _, a in trajectories], axis=0
    )
    rates = RATES[:, None] * rates
    parts = []
    for _, a in trajectories:
        v = np.repeat(a[:, None], len(RATES), axis=1)
        for k in range(1, len(a)):
            v[k] = v[k - 1] + np.clip(a[k] - v[k - 1], -rates, rates)
        parts.append(np.stack([v[rows.first :], v[rows.first - 1 : -1]]))
    applied = np.concatenate([own for own in parts if own.shape[1]], axis=1)
    there = (np.abs(applied[0] - rows.u[:, None]) < ROUNDED * rates).mean(axis=0) > REACHED
    Q = linalg.qr(rows.known, mode="economic")[0]
    left = rows.after - Q @ (Q.T @ rows.after)
    squares, gained = np.maximum(np.sum(left**2, axis=0), 1e-300), np.zeros(rates.shape)
    for i, j in np.argwhere(there & (rates > 0.0)).tolist():
        own = applied[:, :, i, j].T - applied[:, :, i, j].mean()
        own -= Q @ (Q.T @ own)
        if np.abs(own).max() > ROUNDED * rates[i, j]:
            gained[i, j] = (np.sum((linalg.orth(own).T @ left) ** 2, axis=0) / squares).max()
    rate, j = divmod(int(gained.argmax()), gained.shape[1])
    i, ratio = _ratio(rows.missed(), rows.missed(applied[:, :, rate, j].T))
    if ratio <= BENT:
        return None
    text = (
        f"{channels.state(i)} follows {channels.input(j)} as through an actuator that moves by "
        f"about {rates[rate, j]:.2g} in a row at most (a linear model misses {ratio:.3g} times the "
        "squares): log where the actuator is, not where it should be, or give it smaller steps"
    )
    return Misfit(i, (j,), ratio, text)
