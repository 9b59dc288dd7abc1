# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Scalar functions over an array, compiled: the nonlinearity of an equation, and a check."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numba import carray, types  # type: ignore[attr-defined, unused-ignore]
from numba.extending import register_jitable
from numpy.typing import NDArray

from pdeloop.jit.cache import cached_njit
from pdeloop.jit.native import MachineCode


class NotCompiledError(ValueError):
    """A scalar function has no machine code; the cause is what Numba raised."""


LOOPS: dict[Callable[[float], float], MachineCode] = {}


@cached_njit()
def all_finite(values: NDArray[np.float64]) -> bool:
    """True if an array holds neither NaN nor infinity."""
    finite = True
    for value in values.flat:
        finite &= math.isfinite(value)
    return finite


def pointwise_loop(function: Callable[[float], float]) -> int:
    """Address of the machine code of u[i] = function(u[i]), a void (*)(double *, intp).

    It is the same one for the same function. NotCompiledError where Numba cannot compile the function
    for a float64, or it returns something else.
    """
    # A plain function in the closure keeps the key on disk the same in every process; a dispatcher
    # would not.
    scalar = register_jitable(error_model="numpy")(function)

    def loop(data: Any, count: int) -> None:
        u = carray(data, count)
        for i in range(count):
            u[i] = scalar(u[i])

    code = MachineCode(loop, types.void(types.CPointer(types.float64), types.intp), function)  # type: ignore[no-untyped-call]
    try:
        return LOOPS.setdefault(function, code)()
    except Exception as error:  # Numba lets some of its own pass, like an AttributeError
        raise NotCompiledError(
            f"{function.__qualname__} must be a scalar function that Numba can compile for a float64"
        ) from error
