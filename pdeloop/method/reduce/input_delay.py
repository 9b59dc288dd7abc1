# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Whether logged inputs act when the log says so: held-out errors with shifted inputs.

With a delay of n steps the input of row k - n acts from z_k to z_{k+1}: n > 0 is a dead time, or a log
whose inputs are early, and n < 0 a log whose inputs are late. For each n

    z_{k+1} - z_k = c + C_0 z_k + C_1 z_{k-1} + B a_{k-n}

is fitted to parts of the data, each channel in units of its variation, and E_i is the squared error of
channel i on the other parts. Of N steps, another n than 0 has a log-likelihood that is higher by
(N / 2) sum_i log(E_i(0) / E_i(n)), the error variances being those of the held-out parts. The
delay of each input on its own follows by a search along single inputs.

Where inputs are fed back, a_{k+1} knows z_{k+1}. So n < 0 counts only for an input a_k whose prediction
from its own past z_{k+n} does not improve (Granger), while the change to z_{k+n+1} does: the effect of
an input that is logged late is in the states before its row, but not in those before it acted. One that
follows from z_{k+n+1} alone is fed back. Where both delays act, and the later one is of such an input,
rows are means over their time.

References
----------
Ljung, "System Identification: Theory for the User", 2nd ed., section 16.3 (delays). Granger,
Econometrica 37(3), 1969.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import linalg

from pdeloop.messages.arrays import Array
from pdeloop.method.reduce.identifiability import DEPENDENT
from pdeloop.method.reduce.reduced_model import Trajectory, distinct
from pdeloop.process.one_thread import one_thread

EARLIEST, LATEST = -10, 10
"""Delays that are tried, and twice as many while the best is the first or the last of them."""
MODES = 8
"""Leading modes of larger states that are predicted."""
FOLDS = 4
"""Groups of parts of the data that are held out one after the other."""
EVIDENCE = 10.0
"""Log-likelihood by which another delay must be better."""
ADDED = 0.3
"""Share of the log-likelihood gained by another delay that the inputs as used may add to it."""
LOWER = 0.84
"""Squared error, relative to that of the delay before, up to which another one matters."""
MOST_INPUTS = 16
"""Inputs of which each has a delay of its own, at most; more have one in common."""
OWN_PAST = 4
"""Steps of their own past from which inputs are predicted."""
ROUNDED = 1e-13
"""Squared error, relative to the variation, that is rounding."""
_RIDGE = 1e-13

Delays = tuple[int, ...]
Flags = NDArray[np.bool_]


@dataclass(frozen=True)
class DelayStudy:
    """The delay of each input that fits the data best.

    best: 0 of each where no other one is better beyond chance; error: of single steps with `best`,
    relative to that with the delays in use, the root of the mean square over channels; alike: other
    delays that the data do not tell apart from `best`, each with a likelihood within EVIDENCE of it;
    at_end: those of `best` beyond which none was tried; beside: whether the inputs as used act as well.
    """

    best: Delays
    used: Delays
    gain: float = 1.0
    alike: tuple[Delays, ...] = ()
    at_end: Delays = ()
    beside: bool = False


def shifted(trajectories: Sequence[Trajectory], delays: Delays) -> list[Trajectory]:
    """Trajectories with a_{k-n} in the place of a_k, n being the delay of each input.

    Shorter by the rows without such inputs. ValueError if nothing is left.

    >>> z, a = np.arange(4.0)[:, None], np.arange(3.0)[:, None]
    >>> [part.ravel().tolist() for part in shifted([(z, a)], (1,))[0]]
    [[1.0, 2.0, 3.0], [0.0, 1.0]]
    >>> [part.ravel().tolist() for part in shifted([(z, a)], (-1,))[0]]
    [[0.0, 1.0, 2.0], [1.0, 2.0]]
    """
    late, early = max(0, *delays), -min(0, *delays)
    found = []
    for z, a in trajectories:
        steps = len(a) - late - early
        if steps > 0:
            columns = [a[late - n : late - n + steps, j] for j, n in enumerate(delays)]
            found.append((z[late : late + steps + 1], np.stack(columns, axis=1)))
    if not found:
        raise ValueError(
            f"no trajectory has more steps than the inputs are shifted by, {late + early}: give a "
            "longer log, or a smaller --input-delay"
        )
    return found


def study_delays(
    trajectories: Sequence[tuple[ArrayLike, ArrayLike]], used: Delays = ()
) -> DelayStudy:
    """The delays of the inputs that predict held-out steps of trajectories, as logged, best.

    used: the delay of each input that others are compared with; 0 by default.
    """
    known = distinct(trajectories)
    n_a = known[0][1].shape[1]
    used = used or (0,) * n_a
    longest = max(len(a) for _, a in known)
    most = longest // 8
    ends = min(max(EARLIEST, -most), *used), max(min(LATEST, most), *used)
    found = DelayStudy(used, used)
    with one_thread():
        while data := _Regression.of(known, range(ends[0], ends[1] + 1)):
            found = _best(data, used)
            wider = (
                min(ends[0], max(2 * ends[0], -most)) if ends[0] in found.best else ends[0],
                max(ends[1], min(2 * ends[1], most)) if ends[1] in found.best else ends[1],
            )
            if wider == ends:
                break
            ends = wider
    at_end = tuple(n for n in set(found.best) - set(used) if n in ends)
    return replace(found, at_end=at_end)


def _best(data: _Regression, used: Delays) -> DelayStudy:
    """The best delays among the lags of a regression."""
    n_a, free = data.n_a, {n: data.free(n) for n in data.lags if n < min(0, *used)}
    common = [n for n in data.lags if n not in free or (free[n][0].all() and free[n][1].any())]
    best = used
    while True:
        others: list[Delays] = [(n,) * n_a for n in common]
        if 1 < n_a <= MOST_INPUTS:
            others += [
                (*best[:j], n, *best[j + 1 :])
                for j in range(n_a)
                for n in data.lags
                if n not in free or (free[n][0][j] and free[n][1][j])
            ]
        better = max(others, key=data.likelihood)
        if not data.is_better(better, best):
            break
        best = better
    # All steps together, of which each was.
    if best == used or not data.is_better(best, used) or data.acts_as_well(used, best):
        told = free.get(-1, np.zeros((2, n_a), dtype=bool))
        early = tuple(n - int(n == 0 and told[0][j] and told[1][j]) for j, n in enumerate(used))
        both = (*used, *early)
        if early != used and data.is_better(both, used):
            return DelayStudy(early, used, data.gain(both, used), beside=True)
        return DelayStudy(used, used)
    near = data.likelihood(best) - EVIDENCE
    alike = tuple(other for other in others if other != best and data.likelihood(other) > near)
    return DelayStudy(best, used, data.gain(best, used), alike)


@dataclass(frozen=True, eq=False)
class _Regression:
    """Moments of the regressors 1, z_k, z_{k-1} and the inputs of all lags, and of what they predict.

    of_x (F, r, r), of_xy (F, r, c), of_yy (F, c), counts (F,): of each fold; n: channels.
    """

    of_x: Array
    of_xy: Array
    of_yy: Array
    counts: NDArray[np.int64]
    n: int
    n_a: int
    lags: range

    @staticmethod
    def of(known: Sequence[Trajectory], lags: range) -> _Regression | None:
        """None where there are too few steps to hold some out."""
        states = np.concatenate([z for z, _ in known])
        mean, unit = states.mean(axis=0), states.std(axis=0)
        moving = unit > 1e-12 * np.abs(states).max()
        if not moving.any():
            return None
        scale = 1.0 / unit[moving]
        if len(scale) > MODES:
            scaled = (states - mean)[:, moving] * scale
            V = scale[:, None] * linalg.svd(scaled, full_matrices=False)[2][:MODES].T
        else:
            V = np.diag(scale)
        inputs = np.concatenate([a for _, a in known])
        middle, width = inputs.mean(axis=0), inputs.std(axis=0)
        width[width == 0.0] = 1.0
        first, last = max(1, lags[-1], OWN_PAST), max(0, -lags[0])
        rows: list[tuple[int, Array, Array]] = []
        for z, a in known:
            s, u = (z - mean)[:, moving] @ V, (a - middle) / width
            k = np.arange(first, len(a) - last)
            X = np.hstack([np.ones((len(k), 1)), s[k], s[k - 1], *(u[k - n] for n in lags)])
            y = s[k + 1] - s[k]
            pieces = np.array_split(np.arange(len(k)), 2 * FOLDS)
            rows += [(i % FOLDS, X[own], y[own]) for i, own in enumerate(pieces) if len(own)]
        if {fold for fold, _, _ in rows} != {*range(FOLDS)}:
            return None
        r, c = rows[0][1].shape[1], rows[0][2].shape[1]
        if sum(len(X) for _, X, _ in rows) < 2 * (1 + 2 * c + (1 + OWN_PAST) * inputs.shape[1]):
            return None
        moments = np.zeros((FOLDS, r, r)), np.zeros((FOLDS, r, c)), np.zeros((FOLDS, c))
        counts = np.zeros(FOLDS, dtype=np.int64)
        for fold, X, y in rows:
            moments[0][fold] += X.T @ X
            moments[1][fold] += X.T @ y
            moments[2][fold] += np.sum(y * y, axis=0)
            counts[fold] += len(X)
        return _Regression(*moments, counts, c, inputs.shape[1], lags)

    def _inputs(self, delays: Iterable[int], own: Iterable[int]) -> list[int]:
        begin = 1 + 2 * self.n
        return [begin + self.n_a * (n - self.lags[0]) + j for n, j in zip(delays, own, strict=True)]

    @cached_property
    def _known(self) -> dict[Delays, Array]:
        return {}

    def errors(self, delays: Delays) -> Array:
        """Squared errors of each held-out fold and channel, (F, c); delays: once or twice n_a."""
        if delays not in self._known:
            inputs = self._inputs(delays, [j % self.n_a for j in range(len(delays))])
            columns = [*range(1 + 2 * self.n), *dict.fromkeys(inputs)]
            self._known[delays] = self._held_out(columns, self.of_xy, self.of_yy)
        return self._known[delays]

    def _held_out(self, columns: list[int], of_xy: Array, of_yy: Array) -> Array:
        of_x, of_xy = self.of_x[:, columns][:, :, columns], of_xy[:, columns]
        found: Array = np.empty_like(of_yy)
        for fold in range(FOLDS):
            own = of_x.sum(axis=0) - of_x[fold]
            own += _RIDGE * np.trace(own) * np.eye(len(own))
            W = linalg.solve(own, of_xy.sum(axis=0) - of_xy[fold], assume_a="pos")
            found[fold] = of_yy[fold] + np.sum(W * (of_x[fold] @ W - 2.0 * of_xy[fold]), axis=0)
        floored: Array = np.maximum(found, ROUNDED * self.counts[:, None])
        return floored

    def likelihood(self, delays: Delays) -> float:
        """The log-likelihood of the held-out steps, but for a constant."""
        return self._log(self.errors(delays))

    def _log(self, errors: Array) -> float:
        return -0.5 * float(self.counts.sum() * np.sum(np.log(errors.sum(axis=0))))

    def is_better(self, delays: Delays, than: Delays) -> bool:
        """Whether other delays are, beyond chance, and in no fold worse."""
        own, other = self.errors(delays), self.errors(than)
        return (
            self.likelihood(delays) > self.likelihood(than) + EVIDENCE
            and bool(np.all(np.sum(np.log(own / other), axis=1) <= 0.0))
            and self.gain(delays, than) ** 2 * LOWER >= 1.0
        )

    def acts_as_well(self, used: Delays, later: Delays) -> bool:
        """Whether inputs that are said to act later than used improve the prediction as used, too.

        Of a plant with dead time they do not. Where a few modes are predicted, an earlier input tells
        of what moves the others, and may predict better than the one that acts.
        """
        columns = [*range(1 + 2 * self.n), *self._inputs(later, range(self.n_a))]
        for j in range(self.n_a):
            late = range(later[j] + 1, used[j] + 1)
            others = [used[j]] if later[j] > used[j] else late
            columns += self._inputs(others, [j] * len(others))
        both = self._log(self._held_out(columns, self.of_xy, self.of_yy)) - self.likelihood(later)
        return both > max(EVIDENCE, ADDED * (self.likelihood(later) - self.likelihood(used)))

    def gain(self, delays: Delays, than: Delays) -> float:
        """The ratio of the errors, the root of its mean square over channels."""
        own, other = (self.errors(one).sum(axis=0) for one in (delays, than))
        return float(np.sqrt(np.mean(other / own)))

    def free(self, n: int) -> tuple[Flags, Flags]:
        """Of each input: whether z_{k+n}, from which a_k acts with a delay n < 0, tells nothing of it.

        That is, does not improve its prediction from a_{k-1}, a_{k-2}, ... And whether it does beside
        z_{k+n+1}: such an input has caused the change between the two, whereas one that is fed back
        follows from z_{k+n+1} alone, and one that is held from its own past.
        """
        inputs, at = range(self.n_a), n + 1
        now = self._inputs([at] * self.n_a, inputs)
        past = [
            column
            for lag in range(at + 1, min(at + OWN_PAST, self.lags[-1]) + 1)
            for column in self._inputs([lag] * self.n_a, inputs)
        ]
        of_y, of_yy = self.of_x[:, :, now], np.stack([self.of_x[:, j, j] for j in now], axis=1)
        enough = max(EVIDENCE / (0.5 * float(self.counts.sum())), -float(np.log(LOWER)))

        def improves(known: list[int]) -> Flags:
            columns = [0, *known, *range(1 + self.n, 1 + 2 * self.n)]
            without = self._held_out([0, *known], of_y, of_yy).sum(axis=0)
            with_it = self._held_out(columns, of_y, of_yy).sum(axis=0)
            with_it = np.maximum(with_it, DEPENDENT**2 * of_yy.sum(axis=0))  # less is rounding
            return np.asarray(np.log(without / with_it) > enough)

        after = [*range(1, 1 + self.n)]
        return ~improves(past), improves(after) & improves([*past, *after])
