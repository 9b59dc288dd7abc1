"""Words of memory that several threads share, inside compiled functions."""

from typing import Any

from llvmlite import ir
from numba import types

from loop_interfaces.jit.simd import intrinsic

WORD = ir.IntType(64)


def place(builder: Any, address: Any) -> Any:
    """The pointer to the word at an address."""
    return builder.inttoptr(address, WORD.as_pointer())


@intrinsic
def load_acquire(typing_context: Any, address: Any) -> Any:
    """The word at an address; what was written before it was is seen, too."""

    def build(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.load_atomic(place(builder, args[0]), "acquire", 8)

    return types.intp(types.intp), build


@intrinsic
def store_release(typing_context: Any, address: Any, word: Any) -> Any:
    """Write the word at an address; who sees it sees what was written before."""

    def build(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        builder.store_atomic(args[1], place(builder, args[0]), "release", 8)
        return context.get_dummy_value()

    return types.void(types.intp, types.intp), build
