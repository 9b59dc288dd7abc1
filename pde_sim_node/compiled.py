"""How functions are compiled, and when a compiled one on disk is out of date.

Numba keeps compiled functions beside the source (or in the user's cache folder where that cannot be
written) and takes them for current while the file that holds the function is unchanged. What the
function calls from other files does not count. So what is kept on disk here closes over a
`fingerprint` of all the sources it is made of: closed-over values are part of Numba's key.
"""

import hashlib
import inspect
from collections.abc import Callable
from types import FunctionType, ModuleType
from typing import Any, TypeVar

import numba
from numba import carray, types  # type: ignore[attr-defined, unused-ignore]
from numba.core.errors import NumbaError
from numba.extending import register_jitable

__all__ = ["cache_misses", "fingerprint", "jit", "kept", "pointwise_loop"]

F = TypeVar("F", bound=Callable[..., Any])


def jit(function: F) -> F:
    """Compile as a part of a function that is `kept`."""
    compiled: F = numba.njit(function)
    return compiled


def kept(function: F) -> F:
    """Compile, keep on disk, and run without the interpreter's lock."""
    compiled: F = numba.njit(function, cache=True, nogil=True)
    return compiled


def cache_misses(*functions: Any) -> int:
    """How often one of these had to be compiled in this process, as it was not on disk."""
    return sum(sum(function.stats.cache_misses.values()) for function in functions)


def fingerprint(*sources: ModuleType | Callable[..., Any]) -> str:
    """A digest of source texts; of a function's whole module, which it may use."""
    digest = hashlib.sha256()
    for source in sources:
        module = inspect.getmodule(source) or source
        try:
            text = inspect.getsource(module)
        except (OSError, TypeError):  # typed into an interpreter: the code itself is all there is
            text = (
                repr(source.__code__.co_code) if isinstance(source, FunctionType) else repr(source)
            )
        digest.update(text.encode())
    return digest.hexdigest()


LOOPS: dict[Callable[[float], float], Any] = {}


def pointwise_loop(function: Callable[[float], float]) -> tuple[Any, bool]:
    """Machine code of u[i] = function(u[i]) over an array, as Numba's cfunc of (double *, intp).

    Returns
    -------
    The cfunc, the same one for the same function, and whether it was compiled by this call.

    Raises
    ------
    ValueError
        Numba cannot compile the function for a float64, or it returns something else.
    """
    if function in LOOPS:
        return LOOPS[function], False
    # A plain function in the closure keeps the key on disk the same in every process; a dispatcher
    # would not.
    scalar = register_jitable(error_model="numpy")(function)
    try:
        loop = compile_loop(scalar, fingerprint(function))
    except NumbaError as error:
        reason = str(error).strip().splitlines()[-1]
        raise ValueError(
            f"the nonlinearity {function.__qualname__} must be a scalar function u -> g(u) "
            f"that Numba can compile for a float64: {reason}"
        ) from error
    LOOPS[function] = loop
    return loop, not loop.cache_hits


def compile_loop(scalar: Callable[[float], float], sources: str) -> Any:
    signature = types.void(types.CPointer(types.float64), types.intp)  # type: ignore[no-untyped-call]

    @numba.cfunc(signature, cache=True)
    def loop(data: Any, count: int) -> None:
        sources  # noqa: B018  # closed over to be part of the key on disk
        u = carray(data, count)
        for i in range(count):
            u[i] = scalar(u[i])

    return loop
