# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""What data say about a model: stable or not, residuals, and the fit of simulations.

The magnitude |lambda| of the largest pole has the standard error of a jackknife: with |lambda|_i from
the data without their i-th of g parts in time,

    se^2 = (g - 1) / g sum_i (|lambda|_i - mean)^2,

and an interval of Student's t with g - 1 degrees of freedom. The residuals e_k = z_k - z_{k|k-1} of a
good model are white and not explained by inputs that are already known. Of N residuals of a channel
with correlations rho_1 .. rho_m in time, N sum rho^2 is then chi-square with m degrees of freedom (Box
and Pierce), and so is N R^2 of the regression on the inputs of m steps, with m n_a.

    FIT_i = 100 (1 - |z_i - z_i simulated| / |z_i - mean z_i|)

References
----------
Ljung, "System Identification: Theory for the User", 2nd ed., sections 16.5 and 16.6 (residuals).
Quenouille, Biometrika 43, 1956, and Kuensch, Annals of Statistics 17(3), 1989 (jackknife).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike
from scipy import linalg, special

from pdeloop.messages.arrays import Array
from pdeloop.messages.model_rows import ModelRows
from pdeloop.method.models.base import FieldModel, Measured, predicted
from pdeloop.method.reduce.channels import Channels, listed
from pdeloop.method.reduce.reduced_model import ReducedModel, Trajectory
from pdeloop.method.reduce.subspace import InnovationModel, driven
from pdeloop.process.one_thread import one_thread

PARTS = 10
"""Parts of the data of which each is left out once."""
CONFIDENCE = 0.95
LAGS = 10
"""Steps in which residuals are correlated with others and with inputs."""
LEVEL = 0.01
"""Rate at which the residuals of a right model are called correlated."""
ROUNDED = 1e-6
"""Residuals of this size relative to the variation of the data are rounding."""
LEAST = 4
"""Residuals for each correlation, at least."""
SLOW = 10.0
"""Time constants of a slow mode that the longest trajectory has, at most."""
EVIDENCE = 20.0
"""Log-likelihood of the effects on such a mode from which on they count."""
MOST = 1e7
"""Numbers from which on the information in the data on all of a model is not computed."""
FIRST = 8
"""Measurements from which a filter finds the state."""


Model: TypeAlias = ReducedModel | ModelRows | FieldModel


@dataclass(frozen=True, eq=False)
class Residuals:
    """Residuals of single steps: which are correlated, beyond chance.

    count: N; in_time: channels with the largest |rho|; with_inputs: channels with the R^2 of earlier
    inputs; rounding: whether there is nothing else in them; modes: whether channels are
    modes; size: standard deviation relative to that
    of the measurements; driven: whether they are enough to be compared with earlier inputs.
    """

    count: int
    in_time: tuple[tuple[int, float], ...] = ()
    with_inputs: tuple[tuple[int, float], ...] = ()
    rounding: bool = False
    modes: bool = False
    size: float = 0.0
    driven: bool = False

    @property
    def white(self) -> bool:
        """Whether none were found to be correlated."""
        return not (self.in_time or self.with_inputs)

    def summary(self) -> dict[str, Any]:
        """As data; `white` is None where nothing could be tested."""
        white = self.white if self.count else None
        return {"count": self.count, "white": white, "relative_size": self.size}

    def text(self, channels: Channels) -> str:
        """One line."""
        if self.rounding:
            return "residuals: rounding"
        share = f"residuals: {100 * self.size:.2g} % of the variation"
        found = []
        for what, own in (("in time", self.in_time), ("with earlier inputs", self.with_inputs)):
            if own:
                names = listed(
                    [f"mode {i + 1}" if self.modes else channels.state(i) for i, _ in own]
                )
                found.append(f"{what} ({names}, up to {max(value for _, value in own):.2f})")
        if not found:
            inputs = "not correlated with" if self.driven else "too few for a test against"
            return f"{share}, white, and {inputs} earlier inputs"
        return (
            f"{share}, correlated {' and '.join(found)}, as with noise on the measurements, a "
            "disturbance that is not in the log, missing states or nonlinearity"
        )


def largest_pole(
    A: Array, trajectories: Sequence[Trajectory], refit: Callable[[list[Trajectory]], Array]
) -> tuple[float, float, float]:
    """|lambda| of the largest pole of A, and the ends of its interval; NaN where there is none.

    refit: A from trajectories.
    """
    size = _radius(A)
    found = []
    for i in range(PARTS):
        edges = [(len(a) * i // PARTS, len(a) * (i + 1) // PARTS) for _, a in trajectories]
        others = []
        for (z, a), (begin, end) in zip(trajectories, edges, strict=True):
            others += [(z[: begin + 1], a[:begin])] * (begin > 0) + [(z[end:], a[end:])]
        others = [part for part in others if len(part[1])]
        try:
            found.append(_radius(refit(others)))
        except (ValueError, linalg.LinAlgError):
            return size, np.nan, np.nan
    error = np.sqrt((PARTS - 1) * np.var(found))
    reach = float(special.stdtrit(PARTS - 1, 0.5 + CONFIDENCE / 2) * error)
    return size, size - reach, size + reach


def uncertain_effects(model: InnovationModel, trajectories: Sequence[Trajectory]) -> Array:
    """Half of a 95 % interval of the effect of each input in `LAGS` steps, relative to it, (n_a,).

    From the information in the innovations on A, B and d, each number of the state in units of its
    variation; nothing where data are few or far too many for that. Source: Ljung, *System
    Identification*, 2nd ed., 1999, section 9.4.
    """
    A, C, F, (n, n_a) = model.A, model.C, model.A - model.G @ model.C, model.B.shape
    every, width = np.concatenate([z for z, _ in trajectories]), n * (n + n_a + 1)
    if width * len(every) * len(C) > MOST:
        return np.zeros(0)
    parts = []
    for z, a in trajectories:
        v = z[:-1] @ model.U
        begin = linalg.pinv(C) @ v[0][:, None]
        x = driven(F, a @ model.B.T + model.drift + v @ model.G.T, begin)[:-1, :, 0]
        causes = np.hstack([x, a, np.ones((len(x), 1))]).T
        moved = [np.outer(cause, own) for cause in causes for own in np.eye(n)]
        by = [driven(F, w, np.zeros((n, 1)))[:-1, :, 0] @ C.T for w in moved]
        parts.append(np.stack([v - x @ C.T, *by], axis=2)[FIRST:])
    seen = np.concatenate(parts)
    if len(seen) <= width:
        return np.zeros(0)
    S = np.cov(seen[..., 0].T).reshape(len(C), len(C))
    root = linalg.cholesky(S + ROUNDED * max(np.trace(S), 1e-300) * np.eye(len(C)), lower=True)
    J = linalg.solve_triangular(
        root, seen[..., 1:].transpose(1, 0, 2).reshape(len(C), -1), lower=True
    )
    J = J.reshape(-1, width)
    unit = np.where(np.ptp(every, axis=0) > 0.0, every.std(axis=0), np.inf)[:, None]

    def effects(change: Array) -> Array:
        by_x, by_a, _ = np.split(change.reshape(-1, n), (n, n + n_a))
        x = np.zeros_like(model.B)
        for _ in range(LAGS):
            x = (A + by_x.T) @ x + model.B + by_a.T
        return np.asarray(model.U @ C @ x / unit)

    size = np.maximum(linalg.norm(J, axis=0), 1e-300)
    covariance = linalg.pinvh((J / size).T @ (J / size), rtol=ROUNDED**2) / np.outer(size, size)
    known, small = effects(np.zeros(width)), 1e-6
    D = np.stack([(effects(small * own) - known) / small for own in np.eye(width)], axis=2)
    variance = np.einsum("ijp,pq,ijq->j", D, covariance, D)
    with np.errstate(divide="ignore", invalid="ignore"):
        found = special.ndtri(0.5 + CONFIDENCE / 2) * np.sqrt(variance) / linalg.norm(known, axis=0)
    return np.asarray(found)


def without_insignificant_effects(
    model: InnovationModel, trajectories: Sequence[Trajectory]
) -> InnovationModel:
    """The same, without effects of inputs on slow modes that are not significant: likelihood ratio.

    A disturbance that is not in the log is a mode that hardly decays in it. Chance in the effect w^T B
    on that mode is 1 / (1 - lambda) times as large in the gain, by which a law counts on moving it.
    Of all B with w^T B = 0 the likeliest is tried, for white inputs that with the least tr dB^T W dB,
    where W is the information of the filter's innovations on x_0. Source: Ljung, *System
    Identification*, 2nd ed., 1999, chapter 16.
    """
    A, C, S = model.A, model.C, model.innovations
    poles, left, right = linalg.eig(A, left=True, right=True)
    longest = max(len(a) for _, a in trajectories)
    slow = np.flatnonzero((np.abs(poles - 1.0) < SLOW / longest) & (poles.imag == 0.0))
    if not slow.size:
        return model
    mean = np.concatenate([a for _, a in trajectories]).mean(axis=0)
    middle = linalg.pinv(C) @ (np.concatenate([z for z, _ in trajectories]) @ model.U).mean(axis=0)
    seen = linalg.solve_discrete_lyapunov((A - model.G @ C).T, C.T @ linalg.solve(S, C))
    known = _negative_log_likelihood(model, trajectories)
    for w, v, pole in zip(left.T.real[slow], right.T.real[slow], poles.real[slow], strict=True):
        way = linalg.lstsq(seen, w)[0]
        change = np.outer(way / (w @ way), w @ model.B)
        grown = max(pole - 1.0 + 0.1 / longest, 0.0)  # what no input moves has to decay
        lost = grown * np.outer(v, w) / (w @ v)
        d = model.drift + change @ mean + lost @ middle
        other = replace(model, A=model.A - lost, B=model.B - change, d=d)
        if _negative_log_likelihood(other, trajectories) < known + EVIDENCE:
            model = other
    return model


def _negative_log_likelihood(model: InnovationModel, trajectories: Sequence[Trajectory]) -> float:
    """Minus the log-likelihood of the innovations, but for a constant."""
    A, B, C, G, total = model.A, model.B, model.C, model.G, 0.0
    for z, a in trajectories:
        v = z[:-1] @ model.U
        x = driven(A - G @ C, a @ B.T + model.drift + v @ G.T, linalg.pinv(C) @ v[0][:, None])
        e = (v - x[:-1, :, 0] @ C.T)[FIRST:]
        total += 0.5 * float(np.sum(e * linalg.solve(model.innovations, e.T).T))
    return total


def stability(low: float, high: float) -> str:
    """Yes, no, or undecided.

    >>> stability(0.9, 0.99), stability(1.01, 1.1), stability(0.9, 1.1)
    ('yes', 'no', 'undecided')
    """
    return "yes" if high < 1.0 else "no" if low > 1.0 else "undecided"


def _radius(A: Array) -> float:
    return float(np.abs(np.linalg.eigvals(A)).max())


def residuals(model: Model, trajectories: Sequence[Trajectory]) -> Residuals:
    """Test the residuals of the model's predictions of the next measurement.

    Channels are the numbers of z, or the directions that the model predicts if these are fewer.
    Those from which a filter finds the state do not count.
    """
    states = np.concatenate([z for z, _ in trajectories])
    skipped, basis = 0, np.eye(states.shape[1])
    if isinstance(model, ReducedModel | ModelRows):
        skipped = _beginning(model)
        if len(model.U) > model.U.shape[1]:
            with one_thread():
                basis = linalg.orth(model.U)
    parts, inputs = [], []
    for z, a in trajectories:
        e = ((z[1:] - predicted_next(model, z, a)[:-1]) @ basis)[skipped:]
        if len(e) <= 2 * LAGS:
            continue
        u = a - a.mean(axis=0)
        k = np.arange(max(skipped, LAGS), len(a))
        parts.append((e, k - skipped))
        inputs.append(np.hstack([u[k - lag] for lag in range(LAGS + 1)]))
    if not parts:
        return Residuals(0)
    every = np.concatenate([e for e, _ in parts])
    variation = float(np.sum((states - states.mean(axis=0)) ** 2)) / len(states)
    size = float(np.sqrt(np.sum(every**2) / len(every) / max(variation, 1e-300)))
    if size < ROUNDED:
        return Residuals(len(every), rounding=True, size=size)
    level, n = LEVEL / basis.shape[1], len(every)
    centred = [e - every.mean(axis=0) for e, _ in parts]
    total = np.maximum(sum(np.sum(e**2, axis=0) for e in centred), 1e-300)
    rho = np.stack(
        [
            sum(np.sum(e[lag:] * e[:-lag], axis=0) for e in centred) / total
            for lag in range(1, LAGS + 1)
        ]
    )
    in_time = np.flatnonzero(n * np.sum(rho**2, axis=0) > special.chdtri(LAGS, level))
    X, y = (
        np.concatenate(inputs),
        np.concatenate([e[k] for e, (_, k) in zip(centred, parts, strict=True)]),
    )
    share = np.zeros(basis.shape[1])
    columns = X.shape[1]
    driven = len(X) > LEAST * columns
    if driven:
        left = y - X @ linalg.lstsq(X, y)[0]
        share = 1.0 - np.sum(left**2, axis=0) / np.maximum(np.sum(y**2, axis=0), 1e-300)
    moved = np.flatnonzero(len(X) * share > special.chdtri(columns, level))
    return Residuals(
        n,
        tuple((int(i), float(np.abs(rho[:, i]).max())) for i in in_time),
        tuple((int(i), float(share[i])) for i in moved),
        modes=basis.shape[1] < len(basis),
        size=size,
        driven=driven,
    )


def predicted_next(model: Model, z: Array, a: Array) -> Array:
    """z_{k+1|k} for z_k (N + 1, n_z) and a_k (N, n_a); the last one is not used, (N + 1, n_z)."""
    if not isinstance(model, ReducedModel | ModelRows):
        found = model.step(z[: len(a)], a)
        return np.vstack([found, found[-1:]])
    estimated = _estimates(model, z, a, len(a))
    d = 0.0 if model.d is None else model.d
    ahead = estimated @ model.A.T + a @ model.B.T + d
    found = ahead @ _seen(model).T
    return np.vstack([found, found[-1:]])


def simulated(model: Model, z: Array, a: Array) -> Array:
    """The measurements that the model simulates under recorded actions, (N + 1, n_z).

    A filter finds the state from the first measurements; without one, s_0 = U^T z_0.
    """
    if not isinstance(model, ReducedModel | ModelRows):
        found = np.full((len(a) + 1, z.shape[1]), np.inf)  # from where it diverges on
        (states,) = predicted(model, [Measured(z[: len(a) + 1], a)])
        found[: len(states)] = states
        return found
    taken = min(_beginning(model), len(a) // 4)
    s = _estimates(model, z, a, taken + 1)
    d = 0.0 if model.d is None else model.d
    with np.errstate(over="ignore", invalid="ignore"):
        x = driven(model.A, a[taken:] @ model.B.T + d, s[-1:].T)[1:, :, 0]
        return np.asarray(np.vstack([s, x]) @ _seen(model).T)


def _estimates(model: ReducedModel | ModelRows, z: Array, a: Array, count: int) -> Array:
    """The estimates x_k of the model's state after the measurement z_k, k < count, (count, n_s)."""
    s, d = z[:count] @ model.U, 0.0 if model.d is None else model.d
    L = getattr(model, "L", None)
    if L is None:
        return np.asarray(s)
    steps = s[: len(a)] @ (model.A @ L).T + a[:count] @ model.B.T + d
    p = driven(model.A - model.A @ L, steps, s[:1].T)[:count, :, 0]
    return np.asarray(p + (s - p) @ L.T)


def _beginning(model: ReducedModel | ModelRows) -> int:
    """Measurements from which a filter finds the state, with the last inputs of a dead time."""
    if getattr(model, "L", None) is None:
        return 0
    return max(FIRST, int(np.count_nonzero(~model.U.any(axis=0))))


def _seen(model: ReducedModel | ModelRows) -> Array:
    return model.measurement if isinstance(model, ModelRows) else model.U


def fit_percent(
    model: Model,
    trajectories: Sequence[tuple[ArrayLike, ArrayLike]],
    first: int = 0,
) -> Array:
    """FIT of each number of z, in per cent, over trajectories, (n_z,).

    100: exact; 0: as good as the mean.
    """
    known: list[Any] = [(np.asarray(z), np.asarray(a)) for z, a in trajectories]
    mean = np.concatenate([z for z, _ in known]).mean(axis=0)
    wrong = np.sum([np.sum((z - simulated(model, z, a)) ** 2, 0) for z, a in known], 0)
    moved = np.sum([np.sum((z - mean) ** 2, axis=0) for z, _ in known], axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(100.0 * (1.0 - np.sqrt(wrong / np.where(moved > 0.0, moved, np.nan))))
