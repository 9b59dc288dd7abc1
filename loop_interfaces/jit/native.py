"""Machine code by its address, inside compiled functions: what a C library or Numba's cfunc offers."""

from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba import types

from loop_interfaces.jit.simd import intrinsic

__all__ = ["MachineCode", "call_c"]

WORD = ir.IntType(64)
STATUS = ir.IntType(32)


@intrinsic
def call_c(typing_context: Any, address: Any, arguments: Any) -> Any:
    """Call an int (*)(intptr_t, ...) with a tuple of integers or addresses; of a void one the result
    has no meaning.
    """

    def build(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        address, given = args
        words = [builder.extract_value(given, i) for i in range(len(arguments))]
        kind = ir.FunctionType(STATUS, [WORD] * len(words))
        status = builder.call(builder.inttoptr(address, kind.as_pointer()), words)
        return builder.sext(status, WORD)

    return types.int64(types.intp, types.UniTuple(types.intp, len(arguments))), build  # type: ignore[no-untyped-call]


class MachineCode:
    """One of Numba's cfuncs that is loaded, or compiled, when it is first asked for."""

    def __init__(self, compile_it: Callable[[], Any]) -> None:
        self._compile = compile_it
        self._code: Any = None

    def __call__(self) -> tuple[int, bool]:
        """Its address, and whether it was compiled by this call."""
        if self._code is not None:
            return self._code.address, False
        self._code = self._compile()
        return self._code.address, not self._code.cache_hits
