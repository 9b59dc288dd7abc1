# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""From an equation to the solver's step: its operators, checked, and errors in its author's words."""

import re
from collections.abc import Callable
from typing import Any

import numba
import numpy as np
from numba import types
from numba.core.errors import NumbaError

from pde_sim_node.equations import Equation, Field, LinearEquation, Spectrum
from pde_sim_node.equations.base import result_of
from pdeloop.messages.own_code import in_one_line, located
from pdeloop.solver.exact import exact_step
from pdeloop.solver.kernel import etdrk4_step
from pdeloop.solver.memory import StepSettings
from pdeloop.solver.pointwise import NotCompiledError
from pdeloop.solver.workers import ParallelStep


def compiled_step(equation: Equation, k: Field, **settings: Any) -> ParallelStep:
    """The step z_{k+1} = f(z_k, a_k) of an equation: exact in time if it is linear, else ETDRK4.

    k: wavenumbers 2 pi j / L, (n_x//2 + 1,); settings: the other fields of `StepSettings`. ValueError
    for operators of the wrong shape or that are not finite. It is compiled by `load`.
    """
    linear = isinstance(equation, LinearEquation)
    step = StepSettings(
        linear_operator=operator(equation, "linear_operator", k),
        multiplier=np.zeros(len(k)) if linear else operator(equation, "multiplier", k),
        nonlinearity=equation.nonlinearity,
        actuated=equation.actuated,
        **settings,
    )
    return exact_step(step) if linear else etdrk4_step(step)


def load(step: ParallelStep, equation: Equation) -> None:
    """Load the machine code of an equation's step; ValueError where its nonlinearity has none."""
    try:
        step.load()
    except NotCompiledError as error:
        function = equation.nonlinearity
        why = reason(function)
        if why is None:
            raise
        raise ValueError(
            f"the nonlinearity {function.__qualname__} must be a scalar function u -> g(u) "
            f"that Numba can compile for a float64: {why}"
        ) from error


def operator(equation: Equation, name: str, k: Field) -> Spectrum:
    """L(k) or m(k), the equation's method of that name; ValueError for a wrong shape or NaN."""
    values = result_of(getattr(equation, name), k)
    components = len(equation.components)
    shape = k.shape if components == 1 else (*k.shape, components, components)
    if not isinstance(values, np.ndarray) or values.dtype.kind not in "iufc":
        got = repr(values)
    elif values.shape != shape:
        got = f"shape {values.shape}"
    elif not np.isfinite(values).all():
        got = "NaN or infinity"
    else:
        return values
    raise ValueError(
        f"{name} of the equation must return an array of {' x '.join(map(str, shape))} "
        f"finite numbers for k of shape {k.shape}, got {got}"
    )


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
