"""Scalar functions over an array, compiled: the nonlinearity of an equation, and a check."""

import math
import re
from collections.abc import Callable
from typing import Any

import numba
import numpy as np
from numba import carray, types  # type: ignore[attr-defined, unused-ignore]
from numba.core.errors import NumbaError
from numba.extending import register_jitable
from numpy.typing import NDArray

from loop_interfaces.jit.cache import cached_njit
from loop_interfaces.jit.native import MachineCode

LOOPS: dict[Callable[[float], float], MachineCode] = {}


@cached_njit()
def all_finite(values: NDArray[np.float64]) -> bool:
    """Whether an array holds neither NaN nor infinity."""
    finite = True
    for value in values.flat:
        finite &= math.isfinite(value)
    return finite


def pointwise_loop(function: Callable[[float], float]) -> int:
    """Address of the machine code of u[i] = function(u[i]), a void (*)(double *, intp).

    It is the same one for the same function.

    Raises
    ------
    ValueError
        Numba cannot compile the function for a float64, or it returns something else.
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
    except NumbaError as error:
        raise ValueError(
            f"the nonlinearity {function.__qualname__} must be a scalar function u -> g(u) "
            f"that Numba can compile for a float64: {reason(function)}"
        ) from error


def reason(function: Callable[[float], float]) -> str:
    """Why Numba cannot compile a function by itself, in one line, with the line of the source."""
    alone: Any = numba.njit(function)
    try:
        alone.compile((types.float64,))
    except NumbaError as error:
        text = str(error).partition("\n")[2] or str(error)  # after "Failed in nopython mode ..."
        words = re.split(r"\n\s*(?:There are|File |During)", text)[0].replace(">>>", "").split()
        code = function.__code__
        line = getattr(getattr(error, "loc", None), "line", code.co_firstlineno)
        return f"{code.co_filename}, line {line}: {' '.join(words)}"
    (signature,) = alone.nopython_signatures
    return f"it returns {signature.return_type}, expected a float64"
