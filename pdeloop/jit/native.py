# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Machine code by its address, inside compiled functions, and words that threads share.

The machine code is what a C library or Numba's cfunc offers.
"""

import ctypes
from collections.abc import Callable
from types import ModuleType
from typing import Any

import numba
import numpy as np
from llvmlite import ir
from numba import types

from pdeloop.jit.cache import jit, kept_on_disk, named_by_sources
from pdeloop.jit.simd import intrinsic, read_word

CLOCK = np.dtype(
    [
        ("gettime", np.int64),  # address of clock_gettime
        ("timespec", np.int64),  # address of one
    ]
)
CLOCK_MONOTONIC = 1

WORD = ir.IntType(64)
STATUS = ir.IntType(32)


@intrinsic
def call_c(typing_context: Any, address: Any, arguments: Any) -> Any:
    """Call an int (*)(intptr_t, ...) with a tuple of integers or addresses.

    The result of a void function has no meaning.
    """

    def build(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        address, given = args
        words = [builder.extract_value(given, i) for i in range(len(arguments))]
        kind = ir.FunctionType(STATUS, [WORD] * len(words))
        status = builder.call(builder.inttoptr(address, kind.as_pointer()), words)
        return builder.sext(status, WORD)

    return types.int64(types.intp, types.UniTuple(types.intp, len(arguments))), build  # type: ignore[no-untyped-call]


@intrinsic
def load_acquire(typing_context: Any, address: Any) -> Any:
    """The word at an address, with acquire semantics: writes before it are visible as well."""

    def build(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.load_atomic(builder.inttoptr(args[0], WORD.as_pointer()), "acquire", 8)

    return types.intp(types.intp), build


@intrinsic
def store_release(typing_context: Any, address: Any, word: Any) -> Any:
    """Write the word at an address; a thread that reads it also sees earlier writes."""

    def build(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        builder.store_atomic(args[1], builder.inttoptr(args[0], WORD.as_pointer()), "release", 8)
        return context.get_dummy_value()

    return types.void(types.intp, types.intp), build


class MachineCode:
    """A C function that is loaded from disk, or compiled, when its address is first asked for.

    signature: its types, for numba.cfunc; sources: the modules, or functions of them, that it
    calls: when one of them changes, it is compiled anew.
    """

    def __init__(
        self,
        function: Callable[..., Any],
        signature: Any,
        *sources: ModuleType | Callable[..., Any],
    ) -> None:
        self._function, self._signature, self._sources = function, signature, sources
        self._code: Any = None

    def __call__(self) -> int:
        """Its address."""
        if self._code is None:
            function = named_by_sources(self._function, *self._sources)
            compiled = numba.cfunc(self._signature, cache=True)
            self._code = kept_on_disk(lambda: compiled(function))
        address: int = self._code.address
        return address


def pointer_to(record: np.dtype[Any]) -> Any:
    """The type of the address of such a record in a signature."""
    return types.CPointer(numba.from_dtype(record))  # type: ignore[no-untyped-call]


def address_of(function: Any) -> int:
    """Address of a function of a ctypes library."""
    address = ctypes.cast(function, ctypes.c_void_p).value
    assert address is not None
    return address


@jit
def monotonic_ns(clock: Any) -> int:
    """Nanoseconds on the clock of time.monotonic_ns. clock: an entry of CLOCK."""
    call_c(clock.gettime, (CLOCK_MONOTONIC, clock.timespec))
    nanoseconds: int = 1_000_000_000 * read_word(clock.timespec, 0) + read_word(clock.timespec, 1)
    return nanoseconds


class MonotonicClock:
    """The arguments of `monotonic_ns`. record: an entry of CLOCK, valid as long as this object."""

    def __init__(self, record: Any) -> None:
        self._timespec = np.zeros(2, np.int64)
        record["gettime"] = address_of(ctypes.CDLL(None).clock_gettime)
        record["timespec"] = self._timespec.ctypes.data
