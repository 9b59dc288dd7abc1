# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The actions that actuators can take, and those of an exploration.

    P(a) = argmin |x - a|,    low <= x <= high,  sum x_j = 0 if asked for
         = clip(a - s, low, high),

with s = 0, or the shift with which the sum is zero. A plant applies P(a) of a requested action a. The
derivative of P is 1 for each actuator that is not at a bound and 0 for the others; with a mean of zero
that of the former is less their mean.

With rate limits the bounds of a step are narrower, P after the action applied before,

    max(low, a_{k-1} - rate) <= x <= min(high, a_{k-1} + rate),

and a_{-1} is the middle between two bounds, otherwise the point nearest to 0 that m is by default.

Explorations are drawn around an operating point within the bounds, P(m + D x) with x ~ N(0, v I): m is
the middle between two bounds, and otherwise the point nearest to 0 that is two standard deviations from
the bound. D is the size of each actuator's standard deviation relative to the largest: unless given, a
quarter of half the range between two bounds, and sqrt(0.1) otherwise; about a given m it is half the
distance from the nearest bound where that is less, but no less than half of that.

References
----------
Kiwiel, "Breakpoint searching algorithms for the continuous quadratic knapsack problem", Mathematical
Programming 112, 2008.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from pdeloop.messages.arrays import Array, float_array
from pdeloop.messages.spec import ParameterError

NO_BOUND = 1e300
"""Magnitude that stands for no bound in the parameter `action_bounds`."""
EXPLORED = 0.25
"""Standard deviation of exploratory actions as a share of the half range between two bounds."""
UNBOUNDED_VARIANCE = 0.1
"""Variance of exploratory actions of an actuator without two bounds."""
_BALANCED = 1e-13
"""Mean of actions, relative to the largest, that rounding explains."""


class ActionSet:
    """The actions a with low <= a <= high, and sum a_j = 0 if asked for.

    Parameters
    ----------
    n_a : int
        Actuators; 0: any number of them, with bounds in common.
    low, high : number or (n_a,)
        Bounds; infinite, or None, where there are none.
    zero_mean : bool
        Whether the actions of a step have mean zero.
    limit : float
        Magnitude at which all actions saturate besides; 0 for none.
    rate : number or (n_a,)
        Largest change of an action from one step to the next; infinite, or None, where there is none.
    exploration_mean : (n_a,) array, optional
        m, the operating point; in place of the one above.
    exploration_scale : (n_a,) array, optional
        Standard deviations of exploratory actions; in place of those above.

    Attributes
    ----------
    low, high : (n_a,) array, or () for any number
        The bounds, those of the limit included.
    rate : (n_a,) array, or () for any number
        The rate limits.
    rated : bool
        Whether there are any.
    start : (n_a,) array, or ()
        a_{-1}.
    bounded : bool
        Whether there is an action that is not in it.
    signed : (n,) array
        What signatures are of (`pdeloop.messages.protocol`): the parameters `action_limit`,
        `action_bounds`, `exploration_mean` and `exploration_scale`.
    exploration_mean, exploration_scale : (n_a,) array, or () for any number
        m, and the diagonal of D.
    exploration_variance : float
        v unless another one is asked for.

    Raises
    ------
    ValueError
        A bound or the operating point does not fit, or no action is allowed.
    """

    def __init__(
        self,
        n_a: int = 0,
        low: ArrayLike | None = -np.inf,
        high: ArrayLike | None = np.inf,
        zero_mean: bool = False,
        *,
        limit: float = 0.0,
        rate: ArrayLike | None = np.inf,
        exploration_mean: ArrayLike = (),
        exploration_scale: ArrayLike = (),
    ) -> None:
        own = [_bound(name, values, n_a) for name, values in (("low", low), ("high", high))]
        self.rate = _bound("rate", rate, n_a)
        self.rated = bool(np.isfinite(self.rate).any())
        if not (self.rate > 0.0).all():
            raise ValueError(f"action_rate must be positive, got {self.rate.tolist()}")
        if self.rated and limit:
            raise ValueError(
                "action_rate goes with bounds, not with action_limit: give action_low and action_high"
            )
        self.zero_mean, reach = bool(zero_mean), limit or np.inf
        self.low, self.high = np.maximum(own[0], -reach), np.minimum(own[1], reach)
        if not (self.low <= self.high).all():
            told = f", and within action_limit, {limit:g}" if limit else ""
            raise ValueError(f"action_low must be at most action_high for each actuator{told}")
        if (fixed := np.flatnonzero(self.low == self.high)).size:
            which = f" of actuator {fixed[0] + 1}" if self.low.ndim else ""
            raise ValueError(
                f"action_low and action_high{which} are both {self.low.flat[fixed[0]]:g}, so it has "
                "nothing to choose: give it a range, or leave it out of the actions (n_a)"
            )
        if zero_mean and not self.low.sum() < 0.0 < self.high.sum():
            count = "only one" if self.low.sum() <= 0.0 <= self.high.sum() else "no"
            raise ValueError(f"{count} action between action_low and action_high has mean zero")
        self.bounds: list[float] = []
        """The parameter `action_bounds`."""
        if zero_mean or self.rated or np.isfinite(own).any():
            least, most, rates = (
                np.clip(part, -NO_BOUND, NO_BOUND).ravel().tolist() for part in (*own, self.rate)
            )
            self.bounds = [*least, *most, float(self.zero_mean), *rates * self.rated]
        self.bounded = bool(zero_mean or self.rated or np.isfinite([self.low, self.high]).any())
        mean = float_array("exploration_mean", exploration_mean)
        if mean.size and not (mean.shape == (n_a,) and np.allclose(self.project(mean), mean)):
            raise ValueError(
                f"exploration_mean must be {n_a} numbers that are an admissible action, got "
                f"{mean.tolist()}"
            )
        scale = float_array("exploration_scale", exploration_scale)
        if scale.size and not (scale.shape == (n_a,) and (scale > 0.0).all()):
            raise ValueError(
                f"exploration_scale must be {n_a} positive numbers, got {scale.tolist()}"
            )
        self.signed = np.array([limit, *self.bounds, *mean, *scale])
        self.exploration_variance, self.exploration_scale = (
            UNBOUNDED_VARIANCE,
            np.ones_like(self.low),
        )
        self.start = np.zeros_like(self.low)
        self.exploration_mean = mean if mean.size else self.start
        self._moved = bool(self.bounds or mean.size or scale.size)
        if self.bounds or scale.size:
            self._set_exploration(mean, scale)

    @staticmethod
    def of(values: Mapping[str, Any]) -> ActionSet:
        """The set of `action_limit`, `action_bounds`, `exploration_mean` and `exploration_scale`.

        Examples
        --------
        >>> both = {"n_a": 2, "action_limit": 3.0, "action_bounds": [0.0, -1.0, 4.0, 2.0, 0.0]}
        >>> ActionSet.of(both).project(np.array([[9.0, -9.0]]))
        array([[ 3., -1.]])
        """
        n_a, bounds = values["n_a"], np.array(values.get("action_bounds") or [])
        others: dict[str, Any] = {
            "limit": values["action_limit"],
            **{name: values.get(name) or [] for name in ("exploration_mean", "exploration_scale")},
        }
        try:
            if not bounds.size:
                return ActionSet(n_a, **others)
            sizes = (2 * n_a + 1, 3 * n_a + 1)
            if bounds.size not in sizes or bounds[2 * n_a] not in (0.0, 1.0):
                raise ValueError(
                    f"expected {n_a} lower bounds, {n_a} upper bounds, and 1 where actions have mean "
                    f"zero, else 0, then {n_a} rate limits or nothing; got {bounds.size} numbers"
                )
            own = np.where(np.abs(bounds) < NO_BOUND, bounds, np.copysign(np.inf, bounds))
            low, high, rate = own[:n_a], own[n_a : 2 * n_a], own[2 * n_a + 1 :]
            others["rate"] = rate if rate.size else np.inf
            return ActionSet(n_a, low, high, bool(bounds[2 * n_a]), **others)
        except ValueError as error:
            told = re.match("exploration_[a-z]+", str(error))
            name = told[0] if told else "action_bounds"
            raise ParameterError(f"parameter '{name}': {error}") from error

    def inside(self, a: Array) -> Array:
        """The operating point next to an action (n_a,) about which little of an exploration is clipped.

        The action itself if it is a standard deviation from its bounds; else two of them from there.

        Examples
        --------
        >>> ActionSet(3, 0.0, 8.0).inside(np.array([0.0, 1.5, 9.0]))
        array([2. , 1.5, 6. ])
        """
        own = np.sqrt(self.exploration_variance) * self.exploration_scale
        near = np.minimum(a - self.low, self.high - a) < own
        moved = np.clip(a, self.low + 2.0 * own, self.high - 2.0 * own)
        return self.project(np.where(near, moved, a))

    def _set_exploration(self, mean: Array, scale: Array) -> None:
        two, most = np.isfinite(self.high - self.low), np.sqrt(UNBOUNDED_VARIANCE)
        with np.errstate(invalid="ignore"):
            own = np.where(two, 0.5 * EXPLORED * (self.high - self.low), most)
            middle = np.where(two, 0.5 * (self.low + self.high), 0.0)
        self.start = self._inside(middle, own)
        if scale.size:
            own = scale
        elif mean.size:
            free = np.minimum(mean - self.low, self.high - mean)
            own = np.clip(0.5 * free, 0.5 * own, own)
        if not mean.size:
            self.exploration_mean = self._inside(middle, own)
        if two.any() or scale.size:
            self.exploration_variance = float(own.max()) ** 2
        self.exploration_scale = own / max(float(own.max()), 1e-300)

    def _inside(self, middle: Array, own: Array) -> Array:
        """The point next to the middle that is two standard deviations from all bounds."""
        inside: Array = np.clip(middle, self.low + 2.0 * own, self.high - 2.0 * own)
        return self.project(inside) if inside.ndim else inside * (not self.zero_mean)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, ActionSet) and np.array_equal(self.signed, other.signed)

    def __hash__(self) -> int:
        return hash(self.signed.tobytes())

    def __repr__(self) -> str:
        mean = ", zero_mean=True" if self.zero_mean else ""
        return f"{type(self).__name__}(low={self.low.tolist()}, high={self.high.tolist()}{mean})"

    def project(
        self, actions: Array, out: Array | None = None, *, after: Array | None = None
    ) -> Array:
        """The nearest actions of the set; what is in it already is left as it is, to the bit.

        Parameters
        ----------
        actions : (..., n_a)
            Each is projected by itself, with the same bits in any batch. One that is not finite gives
            one that is not.
        out : array, optional
            Where the result is written, also `actions` itself; a new array, or `actions` where every
            action is in the set, without it.
        after : (..., n_a) array, optional
            The actions applied in the step before, of which rate limits are; none apply without it.

        Examples
        --------
        >>> ActionSet(3, -1.0, 1.0, True).project(np.array([[0.0, 0.5, 5.0]])).round(9)
        array([[-0.75, -0.25,  1.  ]])
        """
        if not self.bounded:
            if out is None or out is actions:
                return actions
            out[...] = actions
            return out
        low, high = self.within(after)
        moved = actions - self._shifts(actions, low, high) if self.zero_mean else actions
        clipped: Array = np.clip(moved, low, high, out=out)
        return clipped

    def applied(self, requested: Array) -> Array:
        """The actions (T, ..., n_a) that are applied for requested ones of the steps of an episode.

        Examples
        --------
        >>> ActionSet(1, rate=0.5).applied(np.array([[2.0], [2.0], [-1.0]])).ravel()
        array([0.5, 1. , 0.5])
        """
        if not self.rated:
            return self.project(requested)
        found, held = np.empty_like(requested), self.start
        for k, actions in enumerate(requested):
            held = found[k] = self.project(actions, after=held)
        return found

    def within(self, after: Array | None) -> tuple[Array, Array]:
        """Lowest and highest actions of a step, after those applied before."""
        if after is None or not self.rated:
            return self.low, self.high
        return np.maximum(self.low, after - self.rate), np.minimum(self.high, after + self.rate)

    def pull_back(
        self, requested: Array, y: Array, after: Array | None = None
    ) -> tuple[Array, Array]:
        """The transposed derivatives of `project` by requested actions and by `after`, times y.

        All are (..., n_a); after: as for `project`. At a bound the derivative is that from inside, at a
        rate limit that from the side to which -y points.

        Examples
        --------
        >>> ActionSet(high=1.0).pull_back(np.array([0.5, 5.0]), np.array([3.0, 3.0]))[0]
        array([3., 0.])
        """
        if not self.bounded:
            return y, np.zeros_like(y)
        low, high = self.within(after)
        moved = requested - self._shifts(requested, low, high) if self.zero_mean else requested
        below = (moved < low) | (moved == low) & (low > self.low) & (y > 0.0)
        above = (moved > high) | (moved == high) & (high < self.high) & (y < 0.0)
        free = ~(below | above | np.isnan(moved))
        pulled: Array = y * free
        if self.zero_mean:
            count = np.maximum(free.sum(axis=-1, keepdims=True), 1)
            mean = pulled.sum(axis=-1, keepdims=True) / count
            pulled, y = pulled - free * mean, y - mean
        slow = (below & (low > self.low)) | (above & (high < self.high))
        return pulled, y * slow

    def held_back(self, applied: Array) -> NDArray[np.bool_]:
        """Which of the actions (T, ..., n_a) of an episode are at a bound, or at their rate limit."""
        before = np.concatenate(
            [np.broadcast_to(self.start, (1, *applied.shape[1:])), applied[:-1]]
        )
        low, high = self.within(before)
        return (applied <= low) | (applied >= high)

    def limits(self, n_a: int) -> dict[str, Array]:
        """low and high, and with rate limits rate and start, a_{-1}, (n_a,) each."""
        names = ["low", "high", *["rate", "start"] * self.rated]
        return {name: np.broadcast_to(getattr(self, name), n_a).copy() for name in names}

    def free(self, n_a: int) -> Array:
        """Orthonormal directions (n_a, n) in which actions can move: all, or those of mean zero.

        Examples
        --------
        >>> ActionSet(2, zero_mean=True).free(2).round(3).tolist()
        [[0.707], [-0.707]]
        """
        if not self.zero_mean:
            return np.eye(n_a)
        # Helmert's contrasts: one actuator against the mean of those before it.
        rows = np.tril(np.ones((n_a, n_a)), -1)[1:] - np.diag(np.arange(1.0, n_a), 1)[:-1]
        found: Array = (rows / np.linalg.norm(rows, axis=1, keepdims=True)).T
        return found

    def explored(self, draws: Array) -> Array:
        """The exploratory actions P(m + D x) of draws x of N(0, v I), (..., n_a).

        Examples
        --------
        >>> heater = ActionSet(low=0.0, high=4.0)
        >>> heater.explored(np.array([-1.0, 0.0, 9.0])), heater.exploration_variance
        (array([1., 2., 4.]), 0.25)
        """
        return self.project(
            self.exploration_mean + self.exploration_scale * draws if self._moved else draws
        )

    def _shifts(self, actions: Array, low: Array, high: Array) -> Array:
        """s of each action, (..., 1), between these bounds."""
        rows = np.ascontiguousarray(actions).reshape(-1, actions.shape[-1])
        low, high = (np.broadcast_to(x, actions.shape).reshape(rows.shape) for x in (low, high))
        with np.errstate(invalid="ignore"):
            shifts = rows.mean(axis=1)
            size = np.abs(rows).max(axis=1)
            if self.rated:  # small actions may come from large ones
                width = high - low
                size = np.maximum(size, np.where(np.isfinite(width), width, 0.0).max(axis=1))
            shifts[np.abs(shifts) <= _BALANCED * size] = 0.0
            moved = rows - shifts[:, None]
            whole = ((moved >= low) & (moved <= high)).all(axis=1)
        for m in np.flatnonzero(~whole):
            shifts[m] = self._balance(rows[m], low[m], high[m])
        found: Array = shifts.reshape(*actions.shape[:-1], 1)
        return found

    def _balance(self, a: Array, low: Array, high: Array) -> float:
        """s of one action: between two breakpoints the sum falls with it, linearly."""
        if not np.isfinite(a).all():
            return np.nan
        breaks = np.sort(np.concatenate([a - low, a - high]))
        breaks = breaks[np.isfinite(breaks)]
        sums = np.clip(a - breaks[:, None], low, high).sum(axis=1)
        last = int(np.count_nonzero(sums > 0.0))  # sums fall: the zero is between last - 1 and last
        if last in (0, len(breaks)):
            between = breaks[0] - 1.0 if last == 0 else breaks[-1] + 1.0
        else:
            between = 0.5 * (breaks[last - 1] + breaks[last])
        held: Array = np.clip(a - between, low, high)
        free = (held > low) & (held < high)
        if not free.any():
            return float(between)
        return float((a[free].sum() + held[~free].sum()) / np.count_nonzero(free))


def _bound(side: str, given: ArrayLike | None, n_a: int) -> Array:
    values = given if given is not None else -np.inf if side == "low" else np.inf
    bound = float_array(f"action_{side}", values)
    if bound.shape not in ((), (n_a,)) or np.isnan(bound).any():
        raise ValueError(f"action_{side} must be a number or {n_a} numbers, got {values!r}")
    return np.broadcast_to(bound, n_a).copy() if n_a else bound.copy()


ANY_ACTION = ActionSet()
"""Every action is admissible."""
