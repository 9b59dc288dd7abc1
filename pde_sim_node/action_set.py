# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Actions that actuators can take: bounds from below and above for each, and a mean of zero."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from loop_interfaces.arrays import Array, float_array

_HALVINGS = 200
"""More than the bits of a float64 and its exponent need."""


class ActionSet:
    """The actions a with low <= a <= high, and sum a_j = 0 if asked for.

    Parameters
    ----------
    n_a : int
        Actuators.
    low, high : number or (n_a,)
        Bounds; infinite where there are none.
    zero_mean : bool
        Whether the actions of a step have mean zero.

    Raises
    ------
    ValueError
        A bound does not fit, or no action is allowed.
    """

    def __init__(self, n_a: int, low: ArrayLike, high: ArrayLike, zero_mean: bool) -> None:
        self.low, self.high = (
            _bound(name, values, n_a) for name, values in (("low", low), ("high", high))
        )
        self.zero_mean = bool(zero_mean)
        if not (self.low <= self.high).all():
            raise ValueError("action_low must be at most action_high for each actuator")
        if zero_mean and not self.low.sum() <= 0.0 <= self.high.sum():
            raise ValueError("no action between action_low and action_high has mean zero")

    @property
    def everything(self) -> bool:
        """True if every action is in it."""
        return not (self.zero_mean or np.isfinite([self.low, self.high]).any())

    def project(self, actions: Array) -> Array:
        """The nearest actions of the set, (M, n_a).

        Examples
        --------
        >>> ActionSet(3, -1.0, 1.0, True).project(np.array([[0.0, 0.5, 5.0]])).round(9)
        array([[-0.75, -0.25,  1.  ]])
        """
        if not self.zero_mean:
            clipped: Array = np.clip(actions, self.low, self.high)
            return clipped
        return np.stack([self._balanced(a) for a in actions])

    def _balanced(self, a: Array) -> Array:
        """clip(a - s) with the shift s for which its sum is zero; the sum falls with s."""
        shift = float(a.mean())
        if ((a - shift >= self.low) & (a - shift <= self.high)).all():
            free: Array = a - shift
            return free
        width = float(np.abs(a).max()) + float(np.abs([self.low, self.high]).max(initial=0.0))
        below, above = -width, width
        for _ in range(_HALVINGS):
            shift = 0.5 * (below + above)
            if shift in (below, above):
                break
            if np.clip(a - shift, self.low, self.high).sum() > 0.0:
                below = shift
            else:
                above = shift
        balanced: Array = np.clip(a - shift, self.low, self.high)
        return balanced


def _bound(side: str, values: ArrayLike, n_a: int) -> Array:
    bound = float_array(f"action_{side}", values)
    if bound.shape not in ((), (n_a,)) or np.isnan(bound).any():
        raise ValueError(f"action_{side} must be a number or {n_a} numbers, got {values!r}")
    return np.broadcast_to(bound, n_a).copy()
