# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The functions of Python's `math` for the complex step, which `math` itself does not have.

A number u + i h with a tiny h carries a value and a derivative: f(u + i h) = f(u) + i h f'(u). Numba
compiles the functions of `math` for real numbers only, so a nonlinearity is compiled anew with these in
their place, also in the compiled functions that it calls.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from types import BuiltinFunctionType, CellType, FunctionType, ModuleType
from typing import Any

import numba
from numba.core.dispatcher import Dispatcher

Real = Callable[[float], float]

_ROOT_PI = math.sqrt(math.pi)

PAIRS: dict[str, tuple[Real, Real]] = {
    "sin": (math.sin, lambda u: math.cos(u)),
    "cos": (math.cos, lambda u: -math.sin(u)),
    "tan": (math.tan, lambda u: 1.0 + math.tan(u) ** 2),
    "asin": (math.asin, lambda u: 1.0 / math.sqrt(1.0 - u * u)),
    "acos": (math.acos, lambda u: -1.0 / math.sqrt(1.0 - u * u)),
    "atan": (math.atan, lambda u: 1.0 / (1.0 + u * u)),
    "sinh": (math.sinh, lambda u: math.cosh(u)),
    "cosh": (math.cosh, lambda u: math.sinh(u)),
    "tanh": (math.tanh, lambda u: 1.0 - math.tanh(u) ** 2),
    "asinh": (math.asinh, lambda u: 1.0 / math.sqrt(1.0 + u * u)),
    "acosh": (math.acosh, lambda u: 1.0 / math.sqrt(u * u - 1.0)),
    "atanh": (math.atanh, lambda u: 1.0 / (1.0 - u * u)),
    "exp": (math.exp, lambda u: math.exp(u)),
    "expm1": (math.expm1, lambda u: math.exp(u)),
    "log": (math.log, lambda u: 1.0 / u),
    "log1p": (math.log1p, lambda u: 1.0 / (1.0 + u)),
    "log10": (math.log10, lambda u: 1.0 / (u * math.log(10.0))),
    "log2": (math.log2, lambda u: 1.0 / (u * math.log(2.0))),
    "sqrt": (math.sqrt, lambda u: 0.5 / math.sqrt(u)),
    "erf": (math.erf, lambda u: 2.0 / _ROOT_PI * math.exp(-u * u)),
    "erfc": (math.erfc, lambda u: -2.0 / _ROOT_PI * math.exp(-u * u)),
}
"""Functions of `math` with their derivatives."""


def _dual(value: Real, slope: Real) -> Any:
    f, df = numba.njit(error_model="numpy")(_called(value)), numba.njit(error_model="numpy")(slope)

    @numba.njit(error_model="numpy")
    def dual(u: Any) -> complex:
        known = complex(u)
        return complex(f(known.real), df(known.real) * known.imag)

    return dual


def _called(function: Real) -> Real:
    """A built-in function as one that Numba compiles."""
    return lambda u: function(u)


@numba.njit(error_model="numpy")
def _power(u: Any, exponent: Any) -> complex:
    base, power = complex(u), complex(exponent)
    x, y = base.real, power.real
    slope = y * x ** (y - 1.0) * base.imag
    if power.imag != 0.0:
        slope += math.log(x) * x**y * power.imag
    return complex(x**y, slope)


def dual_math() -> dict[str, Any]:
    """The functions by name, compiled when they are called first."""
    return {name: _dual(*pair) for name, pair in PAIRS.items()} | {"pow": _power}


def on_duals(function: Callable[..., Any]) -> Callable[..., Any]:
    """A copy of a Python function, with the functions of `math` that it calls replaced by those here.

    The function itself where it calls none.
    """
    replaced: Callable[..., Any] = _replaced(function, dual_math(), {})
    return replaced


def _replaced(function: Any, duals: dict[str, Any], done: dict[int, Any]) -> Any:
    if id(function) in done:
        return done[id(function)]
    done[id(function)] = function  # one that calls itself
    used = {*function.__code__.co_names, *function.__code__.co_freevars}
    own = {name: function.__globals__[name] for name in used if name in function.__globals__}
    cells = function.__closure__ or ()
    enclosed = zip(function.__code__.co_freevars, cells, strict=True)
    values = {**own, **{name: cell.cell_contents for name, cell in enclosed}}
    new = {name: _value(value, duals, done) for name, value in values.items()}
    if all(new[name] is value for name, value in values.items()):
        return function
    names = {**function.__globals__, **{name: new[name] for name in own}}
    closure = tuple(CellType(new[name]) for name in function.__code__.co_freevars)
    changed = FunctionType(
        function.__code__, names, function.__name__, function.__defaults__, closure or None
    )
    done[id(function)] = changed
    return changed


def _value(value: Any, duals: dict[str, Any], done: dict[int, Any]) -> Any:
    """The substitute for a name's value."""
    if value is math:
        module = ModuleType("math")
        vars(module).update({**vars(math), **duals})
        return module
    if isinstance(value, BuiltinFunctionType):
        name = str(value.__name__)
        return duals.get(name, value) if getattr(math, name, None) is value else value
    if isinstance(value, Dispatcher):
        inner = _replaced(value.py_func, duals, done)
        return value if inner is value.py_func else numba.njit(error_model="numpy")(inner)
    return value
