# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
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
from pde_sim_node.equations.base import in_one_line, located

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

    It is the same one for the same function. ValueError where Numba cannot compile the function for
    a float64, or it returns something else.
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
        why = reason(function)
        if why is None:
            raise
        raise ValueError(
            f"the nonlinearity {function.__qualname__} must be a scalar function u -> g(u) "
            f"that Numba can compile for a float64: {why}"
        ) from error


def reason(function: Callable[[float], float]) -> str | None:
    """Why Numba cannot compile a function by itself, in one line, with the line of the source."""
    alone: Any = numba.njit(function)
    code = function.__code__
    try:
        alone.compile((types.float64,))
    except NumbaError as error:
        text = str(error).partition("\n")[2] or str(error)  # after "Failed in nopython mode ..."
        words = re.split(r"\n\s*(?:There are|File |During)", text)[0].replace(">>>", "").split()
        line = getattr(getattr(error, "loc", None), "line", code.co_firstlineno)
        return f"{code.co_filename}, line {line}: {' '.join(words)}"
    except Exception as error:  # without a place, which Python may know
        try:
            function(0.5)
        except Exception as own:
            if code.co_filename in located(own):
                return located(own)
        return f"{code.co_filename}, line {code.co_firstlineno}: {in_one_line(error)}"
    (signature,) = alone.nopython_signatures
    if signature.return_type == types.float64:
        return None
    return f"it returns {signature.return_type}, expected a float64"
