# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A model in innovation form from measurements: predictor-based subspace identification.

    x_{k+1} = A x_k + B a_k + G e_k,        y_k = U (C x_k + e_k)

U holds the first r POD modes of the measurements z_k, at most as many as the order n. The innovations
e_k are the part of a measurement that the past does not predict, so the model is its own steady-state
filter.

1. A vector ARX of p steps, by ridge regression whose weight generalised cross-validation chooses,

       U^T z_k = sum_{i <= p} X_i [a_{k-i}; U^T z_{k-i}] + e_k,

   has as coefficients the Markov parameters X_i = C (A - G C)^{i-1} [B G] of the predictor.
2. They give the prediction of the next p measurements from the last p steps. Its leading n directions
   over the data, by a singular value decomposition, are the state, with the second moment I.
3. C, and A and B, by least squares on these states. G is the gain of the Kalman filter with the
   covariances of both residuals; its Riccati equation makes it stable.

p and n are those of the least error in predicting held-out measurements one step ahead. With noise and
short steps that hardly depends on the poles, so for logs it is the geometric mean with the error of
simulations, from the x_0 of least squares (`held_out_errors`).

References
----------
Chiuso, "The role of vector autoregressive modeling in predictor-based subspace identification",
Automatica 43(6), 2007 (1 to 3). Golub, Heath, Wahba, Technometrics 21(2), 1979 (generalised
cross-validation).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from math import isqrt

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import linalg

from pdeloop.messages.arrays import Array
from pdeloop.method.reduce.channels import NUMBERED, Channels
from pdeloop.method.reduce.identifiability import NotIdentifiableError, examine_steps
from pdeloop.method.reduce.reduced_model import (
    Samples,
    Trajectory,
    distinct,
    leading_modes,
    pieces,
    steps_of,
    turns,
)
from pdeloop.process.one_thread import one_thread

_SUBSPACE_TOLERANCE = 1.02
"""Multiple of the least held-out error up to which a lower order is chosen."""

PASTS = (1, 2, 3, 4, 6, 8)
"""Steps p of the vector ARX that are tried."""
LONGER = (12, 16)
"""Those that are tried as well for more than `MANY` states, or where no order is given.

Waves that hardly decay need many states, and a long past to tell them from noise."""
ORDERS = (2, 4, 6, 8, 12, 16, 24, 32, 48, 64, 96)
"""Orders that are tried where none is given."""
PASTS_OF_LOGS, ORDERS_OF_LOGS = (1, 2, 4, 8, 16, 32, 48), (1, 2, 3, 4, 5, 6, 8, 12)
"""Those that are tried with simulations."""
WIDEST = 256
"""Unknowns in a row of the vector ARX of more than 8 steps, at most."""
MANY = 48
"""The order above which `LONGER` pasts are tried."""
FOLDS = 4
"""Parts of the trajectories, each held out once."""
ENOUGH, LONG = 50_000, 200
"""Steps in all that tell sizes apart, and those of a part that are taken anyway."""
RESOLVED = 1e-10
"""Least singular value of the prediction from the past, relative to the largest."""
SEPARATE = 1e-3
"""Part of a column, relative to it, beyond those before it from which on sums of squares will do."""
LEAST = 1e-8
"""Least variance of an innovation, relative to that of the measurement."""


@dataclass(frozen=True, eq=False)
class InnovationModel:
    """A (n, n), B (n, n_a), C (r, n), G (n, r) and U (n_z, r), whose columns are orthonormal.

    innovations (r, r): covariance of e; past: p; error: of predicting held-out measurements one step
    ahead, relative to their changes in a step, NaN where past and order were given; d (n,), or None:
    the constant term, x_{k+1} = A x_k + B a_k + d + G e_k, of a model about the means of the data;
    tried: p, n, error and, with simulations, that of simulations, of those among which it was chosen.
    """

    A: Array
    B: Array
    C: Array
    G: Array
    U: Array
    innovations: Array
    past: int
    error: float = np.nan
    d: Array | None = None
    tried: tuple[tuple[float, ...], ...] = ()

    @property
    def drift(self) -> Array:
        """d, or zeros."""
        return np.zeros(len(self.A)) if self.d is None else self.d

    def replay(self, v: Array, actions: Array, foremost: int) -> tuple[Array, Array]:
        """The likeliest x_0 (n,) of measurements v_k = U^T z_k (m, r), and their innovations (m, r).

        x_0 ~ N(0, I), as states are scaled, of the foremost measurements.
        """
        L, d = linalg.cholesky(self.innovations, lower=True), self.drift
        x, moved = np.zeros(len(self.A)), np.eye(len(self.A))
        rows, wanted = [np.eye(len(self.A))], [np.zeros(len(self.A))]
        for measured, a in zip(v[:foremost], actions, strict=False):
            rows.append(linalg.solve_triangular(L, self.C @ moved, lower=True))
            wanted.append(linalg.solve_triangular(L, measured - self.C @ x, lower=True))
            x = self.A @ x + self.B @ a + self.G @ (measured - self.C @ x) + d
            moved = self.A @ moved - self.G @ (self.C @ moved)
        first: Array = linalg.lstsq(np.vstack(rows), np.concatenate(wanted))[0]
        known = actions[: len(v) - 1] @ self.B.T + v[:-1] @ self.G.T + d
        with np.errstate(over="ignore", invalid="ignore"):
            x = driven(self.A - self.G @ self.C, known, first[:, None])[:, :, 0]
            return first, v - x @ self.C.T


def subspace_model(
    trajectories: Sequence[tuple[ArrayLike, ArrayLike]],
    *,
    order: int = 0,
    past: int = 0,
    channels: Channels = NUMBERED,
    constant: bool = False,
    simulations: bool = False,
) -> InnovationModel:
    """Identify a model in innovation form.

    trajectories: (measurements (N + 1, n_z), actions (N, n_a)) each, a_k held from z_k to z_{k+1};
    order: n, or less where the data do not determine as many; past: p; 0: those of the least error on
    held-out data, or, with `simulations`, of the least geometric mean with that of simulations;
    channels: names in error messages; constant: identify it about the means, from which its constant
    term follows: degrees and per cent of a machine at rest are then no mode that never decays.
    ValueError for shapes that do not fit, NaN or infinity, or data that do not determine a model.
    """
    data = steps_of(trajectories)
    known = distinct(trajectories)
    means = np.zeros(data.after.shape[1]), np.zeros(data.actions.shape[1])
    if constant:
        means = data.after.mean(axis=0), data.actions.mean(axis=0)
        known = [(z - means[0], a - means[1]) for z, a in known]
    with one_thread():
        few, affine = 0 < order <= MANY, constant and simulations
        pasts: Sequence[int] = (past,) if past else PASTS if few else PASTS + LONGER
        free = simulations and not past
        if free:
            pasts = PASTS_OF_LOGS
        # The data may not determine as many states as were asked for.
        asked_for: list[tuple[int, ...]] = [(n,) for n in range(order, 0, -1)]
        for asked in asked_for or [ORDERS_OF_LOGS if simulations else ORDERS]:
            tried = [(p, n) for p in pasts for n in asked if _determined(p, n, known)]
            if free:
                tried = [(p, n) for p, n in tried if _narrow(p, n, known)]
            if tried:
                break
        else:
            tried = [(past, order)] if past and order else []
        if not tried:
            n_a = data.actions.shape[1]
            raise NotIdentifiableError(
                f"{len(data.actions)} steps do not determine a model with {n_a} inputs in innovation "
                f"form: expected more than {n_a + 1} after the first ones of every part, while a "
                "quarter is held out; take a longer horizon, or add a log"
            )
        if len(tried) == 1:
            (p, n), errors = tried[0], np.full((1, 1), np.nan)
        else:
            p, n, errors = _choose(tried, known, simulations, affine)
        error = float(errors[tried.index((p, n)), 0])
        predictor = _predictor(known, p, n, channels, affine, n)
        found = _fitted(predictor, n, channels, error, constant=constant)
        table = tuple((*sizes, *own) for sizes, own in zip(tried, errors.tolist(), strict=True))
        found = replace(found, tried=table)
        if found.d is None:
            return found
        # The state of the mean measurement is the least one.
        x = linalg.pinv(found.C) @ (found.U.T @ means[0])
        return replace(found, d=found.d + x - found.A @ x - found.B @ means[1])


def _determined(p: int, n: int, known: Sequence[Trajectory]) -> bool:
    """True if p steps can show n states, and three quarters of the data have samples enough."""
    n_z, n_a = known[0][0].shape[1], known[0][1].shape[1]
    parts = _parts(known)
    held = max(sum(max(len(a) - p, 0) for _, a in parts[i::FOLDS]) for i in range(FOLDS))
    samples = sum(max(len(a) - p, 0) for _, a in parts) - held
    return bool(n <= p * min(n, n_z) and n + n_a < samples)


def _narrow(p: int, n: int, known: Sequence[Trajectory]) -> bool:
    """True if the vector ARX has few unknowns in a row, beside the steps, or a short past."""
    n_z, n_a = known[0][0].shape[1], known[0][1].shape[1]
    steps = sum(len(a) for _, a in known)
    return p <= max(PASTS) or p * (min(n, n_z) + n_a) <= min(WIDEST, steps // 4)


def _choose(
    tried: Sequence[tuple[int, int]], known: Sequence[Trajectory], simulations: bool, affine: bool
) -> tuple[int, int, Array]:
    """p and n with the least error on parts that were held out, and the errors of all, (K, 1 or 2)."""
    parts, units = _parts(known), units_of(known)
    most = max(ENOUGH // len(parts), LONG)
    parts = [(z[: most + 1], a[:most]) for z, a in parts]
    # Of each fold: squared errors, and what they are relative to.
    sums = np.zeros((2, min(len(parts), FOLDS), len(tried), 1 + simulations))
    for fold, (others, own) in enumerate(turns(parts, FOLDS)):
        made, predictor = (0, 0), None
        for i, (p, n) in enumerate(tried):
            if not np.isfinite(sums[0, :, i]).all():
                continue
            # More states than there are readings have one predictor in common, one after the other.
            size = p, min(n, parts[0][0].shape[1])
            try:
                if size != made or predictor is None:
                    made, most = size, max(other for own_p, other in tried if own_p == p)
                    predictor = _predictor(others, *size, NUMBERED, affine, most)
                model = _fitted(predictor, n, NUMBERED, np.nan, check=False, constant=affine)
            except (linalg.LinAlgError, ValueError):
                sums[0, fold, i] = np.inf
                continue
            for z, a in own:
                sums[:, fold, i, 0] += _missed(model, z, a)
                if simulations:
                    sums[:, fold, i, 1] += free_errors(model, z, a, units)[:, 1]
    totals, changes = sums.sum(axis=1)
    errors = _relative(totals, changes)
    if not np.isfinite(errors[:, 0]).any():
        return (*tried[0], np.full(errors.shape, np.nan))

    def least(score: Array, tolerance: float) -> int:
        good = [i for i in range(len(tried)) if score[i] <= tolerance * score.min()]
        lowest = min(tried[i][1] for i in good)
        return min((i for i in good if tried[i][1] == lowest), key=lambda i: float(score[i]))

    best = least(errors[:, 0], _SUBSPACE_TOLERANCE)
    if simulations:
        score = np.prod(errors, axis=1)
        other = least(score, _SUBSPACE_TOLERANCE**2)
        each = np.prod(_relative(*sums), axis=2)
        best = other if (each[:, other] < each[:, best]).all() else best
    return (*tried[best], errors)


def _relative(wrong: Array, moved: Array) -> Array:
    """The root of squared errors relative to others, infinite where these are 0."""
    ratios = np.divide(wrong, moved, out=np.full(wrong.shape, np.inf), where=moved > 0.0)
    found: Array = np.sqrt(ratios)
    return found


def _parts(known: Sequence[Trajectory]) -> list[Trajectory]:
    """At least as many as there are folds, of one trajectory its quarters."""
    return list(known) if len(known) >= FOLDS else pieces(known, FOLDS)


def _missed(model: InnovationModel, z: Array, a: Array) -> tuple[float, float]:
    """Sums of squares of the filter's one-step errors, and of the changes in a step."""
    # The first steps tell the state: a filter of data without noise may take long to forget another.
    begin = min(max(PASTS), len(a) // 2)
    y = z @ model.U
    outside = z - y @ model.U.T
    _, e = model.replay(y, a, max(begin, 1))
    with np.errstate(over="ignore", invalid="ignore"):
        wrong = float(np.sum(e[begin + 1 :] ** 2) + np.sum(outside[begin + 1 :] ** 2))
    moved = float(np.sum(np.diff(z[begin:], axis=0) ** 2))
    return (wrong, moved) if np.isfinite(wrong) else (np.inf, moved)


def units_of(trajectories: Sequence[Trajectory]) -> Array:
    """The standard deviation of each number of the measurements, 1 of those that never change."""
    spread = np.concatenate([z for z, _ in trajectories]).std(axis=0)
    return np.where(spread > 0.0, spread, 1.0)


def free_errors(model: InnovationModel, z: Array, a: Array, units: Array) -> Array:
    """Squares of the errors of single steps and of a simulation, and of the changes and variation.

    (2, 2), each number of z in units of its own. Errors begin with the x_0 of least squares, and are
    divided by the share of the numbers that it leaves free.
    """
    v, C = z @ model.U, model.U @ model.C / units[:, None]
    inputs = a @ model.B.T + model.drift
    seen = z / units
    wrong = [
        _from_any_start(A, C, own, seen)
        for A, own in (
            (model.A - model.G @ model.C, inputs + v[:-1] @ model.G.T),
            (model.A, inputs),
        )
    ]
    about = seen - seen.mean(axis=0)
    return np.array([wrong, [np.sum(np.diff(seen, axis=0) ** 2), np.sum(about**2)]])


def held_out_errors(
    fit: Callable[[list[Trajectory]], InnovationModel], trajectories: Sequence[Trajectory]
) -> Array:
    """Relative errors of steps and of simulations of each held-out fold, and of all, (F + 1, 2)."""
    units, sums = units_of(trajectories), list[Array]()
    for others, own in turns(_parts(trajectories), FOLDS):
        model = fit(others)
        sums.append(np.sum([free_errors(model, z, a, units) for z, a in own], axis=0))
    wrong, moved = np.moveaxis(np.array([*sums, np.sum(sums, axis=0)]), 1, 0)
    return _relative(wrong, moved)


def _from_any_start(A: Array, C: Array, inputs: Array, y: Array) -> float:
    """The least sum |y_k - C x_k|^2 over x_0, of x_{k+1} = A x_k + inputs_k."""
    n, size = len(A), y.size
    with np.errstate(over="ignore", invalid="ignore"):
        seen = C @ driven(A, inputs, np.eye(n, n + 1))
        seen[:, :, n] -= y
    if size <= n or not np.isfinite(seen).all():
        return np.inf
    R = _triangle(seen.reshape(size, n + 1))
    left = R[:, n] - R[:, :n] @ linalg.lstsq(R[:, :n], R[:, n])[0]
    return float(left @ left) * size / (size - n)


def driven(A: Array, w: Array, x_0: Array) -> Array:
    """x_0 .. x_N of x_{k+1} = A x_k + w_k, (N + 1, n, c), where w acts on the last column of x.

    All blocks of about sqrt(N) steps go on at once, from 0, and then one begins where another ended.
    """
    count, (n, c) = len(w), x_0.shape
    size = isqrt(count) + 1
    blocks = count // size + 1
    padded = np.zeros((blocks * size, n))
    padded[:count] = w
    inputs = padded.reshape(blocks, size, n)
    powers, own = np.empty((size + 1, n, n)), np.zeros((size + 1, blocks, n))
    powers[0] = np.eye(n)
    for k in range(size):
        powers[k + 1] = A @ powers[k]
        own[k + 1] = own[k] @ A.T + inputs[:, k]
    begin = np.empty((blocks, n, c))
    begin[0] = x_0
    for i in range(blocks - 1):
        begin[i + 1] = powers[size] @ begin[i]
        begin[i + 1, :, -1] += own[size, i]
    free = powers[:size].reshape(size * n, n) @ begin.transpose(1, 0, 2).reshape(n, blocks * c)
    x = free.reshape(size, n, blocks, c).transpose(2, 0, 1, 3)
    x[..., -1] += own[:size].transpose(1, 0, 2)
    found: Array = x.reshape(blocks * size, n, c)[: count + 1]
    return found


def _triangle(X: Array) -> Array:
    """R of X = Q R, from sums of products where these lose few digits, or else block by block."""
    sums = X.T @ X
    scale = np.sqrt(sums.diagonal())
    scale[scale == 0.0] = 1.0
    try:
        R = linalg.cholesky(sums / scale / scale[:, None])
    except (linalg.LinAlgError, ValueError):  # dependent columns, or numbers that overflow
        R = np.zeros((1, 1))
    if R.diagonal().min() > SEPARATE:
        found: Array = R * scale
        return found
    size = 4 * X.shape[1]
    count = len(X) // size
    if count < 2:
        return np.asarray(np.linalg.qr(X, mode="r"))
    # Blocks of rows fit a cache.
    parts = np.asarray(np.linalg.qr(X[: count * size].reshape(count, size, -1), mode="r"))
    return _triangle(np.vstack([parts.reshape(-1, X.shape[1]), X[count * size :]]))


@dataclass(frozen=True, eq=False)
class _Predictor:
    """The vector ARX of p steps of trajectories, and the states that its past gives.

    y (N, r): what is predicted; inputs (N, n_a); last (N,): which are the last of a trajectory; past
    (N, d): p steps before each; rows (p r, d) predict the next p measurements, with the directions and
    singular values over the data; most: states that are asked for, at most.
    """

    p: int
    U: Array
    y: Array
    inputs: Array
    last: NDArray[np.bool_]
    past: Array
    rows: Array
    directions: Array
    values: Array
    most: int

    def kept(self, n: int) -> int:
        """States of a model of n: at least r, and no more than are determined."""
        known = int(np.count_nonzero(self.values > RESOLVED * self.values[0]))
        return max(int(self.U.shape[1]), min(n, known))

    def states(self, n: int) -> Array:
        """The leading ones, of second moment I, (N, kept)."""
        kept = self.kept(n)
        found: Array = self.past @ (self.rows.T @ (self.directions[:, :kept] / self.values[:kept]))
        return found

    @cached_property
    def triangles(self) -> tuple[Array, Array]:
        """R of [s_k 1 y_k], and of [s_k 1 a_k y_k s_{k+1}] without the last of each trajectory."""
        s, y, last = self.states(self.most), self.y, self.last
        one = np.ones((len(y), 1))
        every = np.hstack([s, one, y])
        steps = np.hstack([every[~last, : -y.shape[1]], self.inputs, y[~last], s[1:][~last[:-1]]])
        return _triangle(every), _triangle(steps)


def _predictor(
    known: Sequence[Trajectory], p: int, r: int, channels: Channels, affine: bool, most: int
) -> _Predictor:
    """The predictor of at most r modes of the measurements, for at most `most` states."""
    after = np.concatenate([z[1:] for z, _ in known])
    values = linalg.svdvals(after)
    floor = max(after.shape) * np.finfo(np.float64).eps * values[0]
    r = min(r, int(np.count_nonzero(values > floor)))
    U, _ = leading_modes(after, max(r, 1), channels)
    regressors, targets, firsts = [], [], []
    for z, a in known:
        if len(a) < p:
            continue
        w = np.hstack([a, z[:-1] @ U])
        windows = np.lib.stride_tricks.sliding_window_view(w, p, axis=0)
        regressors.append(windows.transpose(0, 2, 1).reshape(len(windows), -1))
        targets.append(z[p:] @ U)
        firsts.append(a[p:])
    if not regressors:
        raise ValueError(f"no trajectory has {p} steps")
    past, y = np.concatenate(regressors), np.concatenate(targets)
    unit = np.sqrt(np.mean(past**2, axis=0))
    unit[unit == 0.0] = 1.0
    about = y
    if affine:
        past, about = past - past.mean(axis=0), y - y.mean(axis=0)
    R, d = _triangle(np.hstack([past, about])), past.shape[1]
    markov = _ridge(R[:, :d] / unit, R[:, d:], len(y)).T / unit
    rows = _future(markov, p)
    directions, values, _ = linalg.svd(rows @ R[:, :d].T / np.sqrt(len(y)), full_matrices=False)
    last = np.zeros(len(past), dtype=bool)
    last[np.cumsum([len(rows) for rows in regressors]) - 1] = True
    inputs = np.concatenate(firsts)
    return _Predictor(p, U, y, inputs, last, past, rows, directions, values, most)


def _fitted(
    predictor: _Predictor,
    n: int,
    channels: Channels,
    error: float,
    *,
    check: bool = True,
    constant: bool = False,
) -> InnovationModel:
    """The model of n states. Call it with one LAPACK thread."""
    y, last, inputs = predictor.y, predictor.last, predictor.inputs
    if len(y) <= n:
        raise ValueError(f"{len(y)} samples do not determine {n} states")
    kept, (count, n_a), r = predictor.kept(n), inputs.shape, y.shape[1]
    if check:
        states = predictor.states(n)
        steps = Samples(states[~last], inputs, states[1:][~last[:-1]])
        examine_steps(steps, np.eye(kept), channels).require()
    every, both = predictor.triangles
    most = every.shape[1] - 1 - r
    # What begins or ends away from the mean drifts on average, so the means are not enough.
    one = [most] * constant
    own = [*range(kept), *one]
    C = linalg.lstsq(every[:, own], every[:, most + 1 :])[0].T
    known_ = [*range(kept), *range(most + 1, most + 1 + n_a), *one]
    after = both[:, most + 1 + n_a + r :][:, :kept]
    joint = linalg.lstsq(both[:, known_], after)[0].T
    e = both[:, most + 1 + n_a :][:, :r] - both[:, own] @ C.T
    w = after - both[:, known_] @ joint.T
    A, B, d = joint[:, :kept], joint[:, kept : kept + n_a], None
    if constant:
        C, shift = C[:, :kept], linalg.pinv(C[:, :kept]) @ C[:, kept]
        d = joint[:, -1] + shift - A @ shift
    V, W, S = e.T @ e / count, w.T @ w / count, w.T @ e / count
    level = LEAST * float(np.trace(y.T @ y)) / len(y) / r
    V[np.diag_indices(r)] += level
    W[np.diag_indices(kept)] += LEAST
    try:
        P = linalg.solve_discrete_are(A.T, C.T, W, V, s=S)
    except (linalg.LinAlgError, ValueError) as failed:
        raise NotIdentifiableError(
            f"the measurements do not determine a stable filter of order {kept} ({failed}): take a "
            "lower order, or excite more"
        ) from failed
    innovations = C @ P @ C.T + V
    G = linalg.solve(innovations, (A @ P @ C.T + S).T, assume_a="pos").T
    return InnovationModel(A, B, C, G, predictor.U, innovations, predictor.p, error, d)


def _ridge(X: Array, y: Array, count: int) -> Array:
    """Ridge regression (d, r) of least generalised cross-validation, from triangles of `count` rows."""
    left, s, right = linalg.svd(X, full_matrices=False)
    projected = left.T @ y
    outside = float(np.sum(y * y) - np.sum(projected * projected))
    least, chosen = np.inf, 0.0
    for weight in s[0] ** 2 * np.logspace(-14, 0, 29):
        shrunk = weight / (s * s + weight)
        free = count - float(np.sum(1.0 - shrunk))
        if free <= 0.0:
            continue
        error = (max(outside, 0.0) + float(np.sum((shrunk[:, None] * projected) ** 2))) / free**2
        if error < least:
            least, chosen = error, weight
    found: Array = right.T @ ((s / (s * s + chosen))[:, None] * projected)
    return found


def _future(markov: Array, p: int) -> Array:
    """The coefficients (p r, d) of the past in the next p measurements."""
    r, width = markov.shape
    block = width // p
    rows = np.zeros((p * r, width))
    for j in range(p):
        rows[j * r : (j + 1) * r, j * block :] = markov[:, : (p - j) * block]
    return rows
