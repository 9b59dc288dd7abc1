# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Checks of the plant's arguments: the value, or a ValueError that says what is expected."""

import math
import numbers
import operator
from collections.abc import Callable, Sequence
from typing import TypeAlias

import numpy as np

from pde_sim_node.equations import Equation, LinearEquation
from pdeloop.messages.arrays import Array, float_array

MAX_INTERNAL_STEPS = 10**7
"""Most internal steps of one sampling time; more would be a mistake in a unit and take for ever."""


def grid_points(equation: Equation, n_z: int) -> int:
    """Grid points of each component of a state of size n_z."""
    components = len(equation.components)
    if components > 1 and not isinstance(equation, LinearEquation):
        raise ValueError(
            f"{equation.name} has {components} components, which only a LinearEquation may have"
        )
    if n_z % (2 * components) or n_z < 8 * components:
        near = max(8 * components, n_z + -n_z % (2 * components))
        raise ValueError(
            f"n_z must be {components} times an even number of grid points, 8 or more, for the "
            f"components {', '.join(equation.components)} of {equation.name}, got {n_z}: take {near}"
        )
    return n_z // components


def whole(name: str, value: int, minimum: int) -> int:
    """A whole number of at least `minimum`; ValueError otherwise."""
    try:
        number = operator.index(value)
    except TypeError:
        raise ValueError(f"{name} must be a whole number, got {value!r}") from None
    if number < minimum:
        raise ValueError(f"{name} must be at least {minimum}, got {number}")
    return number


def positive(name: str, value: float) -> float:
    """A positive, finite number; ValueError otherwise."""
    number = value if isinstance(value, numbers.Real) and not isinstance(value, bool) else math.nan
    if not 0 < number < math.inf:
        raise ValueError(f"{name} must be positive and finite, got {value!r}")
    return float(number)


Coefficient: TypeAlias = float | Sequence[float] | Array | Callable[..., Array]
"""A number, the values at the points of a grid, or a function of x, or x and y, that gives them."""


def values_at(name: str, given: Coefficient, x: Array, *further: Array) -> Array:
    """A coefficient at points, in the shape of x; ValueError if it does not have as many finite values.

    x, further: coordinates of the points, all of one shape; values may also come in a row.

    >>> values_at("growth", lambda x: 1.0 - x, np.array([0.0, 0.5]))
    array([1. , 0.5])
    """
    places = (x, *further)
    values = float_array(name, given(*map(np.copy, places)) if callable(given) else given)
    if values.shape == (x.size,):
        values = values.reshape(x.shape)
    if values.shape not in ((), x.shape) or not np.isfinite(values).all():
        raise ValueError(
            f"{name} must be a finite number, {x.size} of them or a function of "
            f"{' and '.join('xyz'[: len(places)])} that gives as many, "
            f"got {'NaN or infinity' if values.shape in ((), x.shape) else f'shape {values.shape}'}"
        )
    return np.broadcast_to(values, x.shape).copy()


def internal_steps(sample_time: float, integration_time: float) -> int:
    """Internal steps of a sampling time; by rounding, as 0.01 // 0.00001 is 999."""
    ratio = sample_time / integration_time
    if not ratio <= MAX_INTERNAL_STEPS:
        raise ValueError(
            f"sample_time must be at most {MAX_INTERNAL_STEPS} times integration_time, got "
            f"{sample_time!r} and {integration_time!r}"
        )
    steps = round(ratio)
    if steps < 1 or abs(ratio - steps) > 1e-9 * ratio:
        near = max(steps, 1)
        raise ValueError(
            f"sample_time must be a whole multiple of integration_time, got {sample_time!r} and "
            f"{integration_time!r}: take an integration_time of {sample_time / near:.12g}"
        )
    return steps
