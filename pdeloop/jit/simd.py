# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Eight float64 side by side, inside compiled functions.

Numba leaves vectorisation to the compiler, which gives up on the butterflies of an FFT. A value of
type `lanes` states it: eight numbers that are added, subtracted and multiplied at once. LLVM maps
it to the vector registers there are (one of AVX-512, two of AVX2, four of SSE2 or NEON). Each lane
is plain IEEE arithmetic as it is written, neither contracted nor reordered, so a result does not
depend on the width of the registers. A product that is added with one rounding is written so (`fma`).

Memory is an address and an offset in float64 from it, unchecked: a Numba array is seven numbers to
pass, and a dozen calls for every stage of an internal step cost as much as the arithmetic.
"""

import operator
from collections.abc import Callable, Sequence
from typing import Any

from llvmlite import ir
from numba import types
from numba.core.cgutils import get_or_insert_function
from numba.core.datamodel import models
from numba.extending import intrinsic as numba_intrinsic
from numba.extending import overload, register_jitable, register_model

WIDTH = 8
NUMBER = ir.DoubleType()
VECTOR = ir.VectorType(NUMBER, WIDTH)
WORD = ir.IntType(64)


@register_jitable  # type: ignore[untyped-decorator, unused-ignore]
def whole_lanes(n: int) -> int:
    """The least multiple of WIDTH that is at least n, also inside compiled functions."""
    return -(-n // WIDTH) * WIDTH


class Lanes(types.Type):
    """Numba's type of eight float64."""

    def __init__(self) -> None:
        super().__init__(name=f"Lanes({WIDTH})")


lanes = Lanes()
eight_lanes = types.UniTuple(lanes, WIDTH)  # type: ignore[no-untyped-call]


@register_model(Lanes)
class LanesModel(models.PrimitiveModel):
    """Data model of `Lanes`: an LLVM vector."""

    def __init__(self, manager: Any, fe_type: Any) -> None:
        super().__init__(manager, fe_type, VECTOR)  # type: ignore[no-untyped-call]


def intrinsic(function: Callable[..., Any]) -> Callable[..., Any]:
    """Numba's decorator; the result is called without the first argument, the typing context."""
    return numba_intrinsic(function)


def pointer(builder: Any, address: Any, offset: Any, kind: Any = NUMBER) -> Any:
    """The pointer to the number `offset` behind an address, as one to `kind`."""
    numbers = builder.inttoptr(address, NUMBER.as_pointer())
    return builder.bitcast(builder.gep(numbers, [offset], inbounds=True), kind.as_pointer())


def shuffle(builder: Any, a: Any, b: Any, order: Sequence[int]) -> Any:
    """The lanes of a followed by b, in this order."""
    mask = ir.Constant(ir.VectorType(ir.IntType(32), len(order)), list(order))
    return builder.shuffle_vector(a, b, mask)


def reader(kind: Any, result: Any, align: int) -> Any:
    """Intrinsic that loads `kind` at an offset."""

    @intrinsic
    def read_at(typing_context: Any, address: Any, offset: Any) -> Any:
        def build(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            return builder.load(pointer(builder, args[0], args[1], kind), align=align)

        return result(types.intp, types.intp), build

    return read_at


def writer(kind: Any, value: Any, align: int) -> Any:
    """Intrinsic that stores `kind` at an offset."""

    @intrinsic
    def write_at(typing_context: Any, address: Any, offset: Any, given: Any) -> Any:
        def build(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            builder.store(args[2], pointer(builder, args[0], args[1], kind), align=align)
            return context.get_dummy_value()

        return types.void(types.intp, types.intp, value), build

    return write_at


read, write = reader(NUMBER, types.float64, 8), writer(NUMBER, types.float64, 8)
load, store = reader(VECTOR, lanes, 8), writer(VECTOR, lanes, 8)
read_word, write_word = reader(WORD, types.int64, 8), writer(WORD, types.int64, 8)
# In a message numbers begin on a multiple of four bytes only.
load_unaligned, store_unaligned = reader(NUMBER, types.float64, 1), writer(NUMBER, types.float64, 1)
load_lanes_unaligned, store_lanes_unaligned = reader(VECTOR, lanes, 1), writer(VECTOR, lanes, 1)
load_word_unaligned = reader(WORD, types.int64, 1)
store_word_unaligned = writer(WORD, types.int64, 1)


@intrinsic
def lane_sum(typing_context: Any, value: Any) -> Any:
    """The sum of the lanes, from the first to the last."""

    def build(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        index = ir.IntType(32)
        found = [builder.extract_element(args[0], ir.Constant(index, i)) for i in range(WIDTH)]
        total = found[0]
        for number in found[1:]:
            total = builder.fadd(total, number)
        return total

    return types.float64(lanes), build


@intrinsic
def splat(typing_context: Any, number: Any) -> Any:
    """Lanes that are all equal to one number."""

    def build(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        empty = ir.Constant(VECTOR, ir.Undefined)
        first = builder.insert_element(empty, args[0], ir.Constant(ir.IntType(32), 0))
        return shuffle(builder, first, first, [0] * WIDTH)

    return lanes(types.float64), build


@intrinsic
def backwards(typing_context: Any, below: Any, above: Any) -> Any:
    """Select from sixteen consecutive numbers the ninth, the eighth, ..., the second."""

    def build(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return shuffle(builder, args[0], args[1], range(WIDTH, 0, -1))

    return lanes(lanes, lanes), build


@intrinsic
def transpose(typing_context: Any, rows: Any) -> Any:
    """Eight lanes that are the rows of a matrix, as its columns."""

    def build(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        # Shuffles in the shapes that AVX has instructions for: the even or odd numbers of two
        # vectors, alternating, and the even or odd pairs of one and then of the other.
        even, odd = [0, 8, 2, 10, 4, 12, 6, 14], [1, 9, 3, 11, 5, 13, 7, 15]
        even_pairs, odd_pairs = [0, 1, 4, 5, 8, 9, 12, 13], [2, 3, 6, 7, 10, 11, 14, 15]
        rows = [builder.extract_value(args[0], i) for i in range(WIDTH)]
        columns: list[Any] = [None] * WIDTH
        for first, numbers in enumerate((even, odd)):
            a, b, c, d = (shuffle(builder, rows[i], rows[i + 1], numbers) for i in (0, 2, 4, 6))
            for second, pairs in enumerate((even_pairs, odd_pairs)):
                ab, cd = shuffle(builder, a, b, pairs), shuffle(builder, c, d, pairs)
                columns[first + 2 * second] = shuffle(builder, ab, cd, even_pairs)
                columns[first + 2 * second + 4] = shuffle(builder, ab, cd, odd_pairs)
        return context.make_tuple(builder, signature.return_type, columns)

    return eight_lanes(eight_lanes), build


def fused(builder: Any, a: Any, b: Any, c: Any) -> Any:
    """The value a * b + c by LLVM's intrinsic."""
    kind = ir.FunctionType(VECTOR, [VECTOR] * 3)
    name = f"llvm.fma.v{WIDTH}f64"
    function = get_or_insert_function(builder.module, kind, name)  # type: ignore[no-untyped-call]
    return builder.call(function, [a, b, c])


@intrinsic
def fma(typing_context: Any, a: Any, b: Any, c: Any) -> Any:
    """a * b + c with one rounding on every machine, so that all agree.

    By an instruction of its own or, slowly, by the C library.
    """

    def build(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return fused(builder, *args)

    return lanes(lanes, lanes, lanes), build


@intrinsic
def minus_product(typing_context: Any, a: Any, b: Any, c: Any) -> Any:
    """c - a * b with one rounding."""

    def build(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        a, b, c = args
        return fused(builder, builder.fneg(a), b, c)

    return lanes(lanes, lanes, lanes), build


@intrinsic
def clamp(typing_context: Any, value: Any, bound: Any) -> Any:
    """Each lane, but no further from 0 than a lane of `bound`; NaN stays."""

    def build(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        value, bound = args
        for limit, beyond in ((builder.fneg(bound), "<"), (bound, ">")):
            outside = builder.fcmp_ordered(beyond, value, limit)
            value = builder.select(outside, limit, value)
        return value

    return lanes(lanes, lanes), build


@intrinsic
def where_equal(typing_context: Any, a: Any, b: Any, value: Any) -> Any:
    """The lanes of `value` where a and b are equal, 0 elsewhere."""

    def build(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        a, b, value = args
        return builder.select(builder.fcmp_ordered("==", a, b), value, ir.Constant(VECTOR, None))

    return lanes(lanes, lanes, lanes), build


def define(operation: Callable[[Any, Any], Any], instruction: str) -> None:
    """Let an operator on lanes be one instruction."""

    @intrinsic
    def lanewise(typing_context: Any, a: Any, b: Any) -> Any:
        def build(context: Any, builder: Any, signature: Any, args: Any) -> Any:
            return getattr(builder, instruction)(*args)

        return lanes(lanes, lanes), build

    # Numba compares this signature with the lambda's, which cannot have annotations.
    @overload(operation)
    def operate(a, b):  # type: ignore[no-untyped-def]
        if isinstance(a, Lanes) and isinstance(b, Lanes):
            return lambda a, b: lanewise(a, b)
        return None


define(operator.add, "fadd")
define(operator.sub, "fsub")
define(operator.mul, "fmul")
