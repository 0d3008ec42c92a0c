"""Vector of `LANES` numbers for numba kernels: one row of a tile at a time, in registers.

numba leaves vectorising to LLVM, which gives up on loops with calls, selections or state that outlives the loop.
Here each operation is emitted as one LLVM vector instruction instead. LLVM maps it to the instructions of the
processor: AVX-512, AVX2, SSE or NEON. Elements are float32 or float64.

Compilation of the kernels.

1. A kernel is a short parallel loop over workers (`parallel_jit`).
2. Each worker runs one serial function (`worker_jit`), because the parallel compiler is slow on long bodies.
3. The serial function is made of small functions (`jit`). These are always inlined: the reference counts of arrays
   passed between threads would cost more than the work.
4. The cache (`kernel_cache`) keeps only the functions that Python calls. They contain the others.

Of all flags that allow the compiler to reorder or assume, only fused multiply-add is set: results are reproducible.
"""

import operator
from collections.abc import Callable
from typing import Any

import numba.extending
from llvmlite import ir
from numba import njit, types
from numba.core import cgutils
from numba.core.base import BaseContext as TargetContext
from numba.core.datamodel.manager import DataModelManager
from numba.core.typing.context import BaseContext as TypingContext
from numba.core.typing.templates import Signature
from numba.extending import models, overload, register_model

from pipelines.splat.kernel_cache import kernel

LANES = 16

# Any, because numba adds the typing context as a first argument, which kernels do not pass.
intrinsic: Any = numba.extending.intrinsic

# Value of the type `LanesType` in a kernel; where numba asks for an implementation, the type of the value: it wants
# the same annotations there and in the implementation.
Lanes = Any
_ArrayType = Any  # `types.Array` of floats, one-dimensional and contiguous

_INDEX = ir.IntType(32)


class LanesType(types.Type):
    """Numba type of a vector of `LANES` elements."""

    def __init__(self, element: types.Float) -> None:
        self.element = element
        super().__init__(name=f"Lanes({element})")


@register_model(LanesType)
class _LanesModel(models.PrimitiveModel):
    def __init__(self, manager: DataModelManager, numba_type: LanesType) -> None:
        element = manager.lookup(numba_type.element).get_value_type()
        super().__init__(manager, numba_type, ir.VectorType(element, LANES))


def _row_pointer(
    context: TargetContext, builder: ir.IRBuilder, array_type: _ArrayType, array: ir.Value, index: ir.Value
) -> ir.Value:
    start = builder.gep(context.make_array(array_type)(context, builder, array).data, [index])
    vector = ir.VectorType(context.get_value_type(array_type.dtype), LANES)
    return builder.bitcast(start, vector.as_pointer())


@intrinsic
def load(typing_context: TypingContext, array: _ArrayType, index: types.Integer) -> Any:
    """Load `array[index : index + LANES]` of a contiguous 1-D array; not checked."""

    def generate(
        context: TargetContext, builder: ir.IRBuilder, signature: Signature, args: list[ir.Value]
    ) -> ir.Value:
        pointer = _row_pointer(context, builder, array, args[0], args[1])
        return builder.load(pointer, align=array.dtype.bitwidth // 8)

    return LanesType(array.dtype)(array, types.intp), generate


@intrinsic
def store(typing_context: TypingContext, array: _ArrayType, index: types.Integer, lanes: LanesType) -> Any:
    """Store `array[index : index + LANES] = lanes` in a contiguous 1-D array; not checked."""

    def generate(
        context: TargetContext, builder: ir.IRBuilder, signature: Signature, args: list[ir.Value]
    ) -> ir.Value:
        pointer = _row_pointer(context, builder, array, args[0], args[1])
        builder.store(args[2], pointer, align=array.dtype.bitwidth // 8)
        return context.get_dummy_value()

    return types.void(array, types.intp, lanes), generate


@intrinsic
def splat(typing_context: TypingContext, number: types.Float) -> Any:
    """Return the same number in every lane."""

    def generate(
        context: TargetContext, builder: ir.IRBuilder, signature: Signature, args: list[ir.Value]
    ) -> ir.Value:
        vector = context.get_value_type(signature.return_type)
        undefined = ir.Constant(vector, ir.Undefined)
        first = builder.insert_element(undefined, args[0], _INDEX(0))
        return builder.shuffle_vector(first, undefined, ir.Constant(ir.VectorType(_INDEX, LANES), [0] * LANES))

    return LanesType(number)(number), generate


@intrinsic
def where_greater(
    typing_context: TypingContext, a: LanesType, b: LanesType, chosen: LanesType, otherwise: LanesType
) -> Any:
    """Return `chosen` in the lanes where a > b, `otherwise` in the others."""

    def generate(
        context: TargetContext, builder: ir.IRBuilder, signature: Signature, args: list[ir.Value]
    ) -> ir.Value:
        return builder.select(builder.fcmp_ordered(">", args[0], args[1]), args[2], args[3])

    return chosen(a, a, chosen, chosen), generate


@intrinsic
def any_positive(typing_context: TypingContext, lanes: LanesType) -> Any:
    """Return whether any lane is above zero."""

    def generate(
        context: TargetContext, builder: ir.IRBuilder, signature: Signature, args: list[ir.Value]
    ) -> ir.Value:
        positive = builder.fcmp_ordered(">", args[0], ir.Constant(args[0].type, None))
        bits = builder.bitcast(positive, ir.IntType(LANES))
        return builder.icmp_unsigned("!=", bits, ir.IntType(LANES)(0))

    return types.boolean(lanes), generate


def _fold(builder: ir.IRBuilder, a: ir.Value, b: ir.Value, low: list[int], high: list[int]) -> ir.Value:
    """Return the sum of two shuffles of the vectors a and b."""
    halves = (
        builder.shuffle_vector(a, b, ir.Constant(ir.VectorType(_INDEX, len(mask)), mask)) for mask in (low, high)
    )
    return builder.fadd(*halves)


@intrinsic
def store_totals(
    typing_context: TypingContext,
    array: _ArrayType,
    index: types.Integer,
    a: LanesType,
    b: LanesType,
    c: LanesType,
    d: LanesType,
) -> Any:
    """Store `array[index : index + 4] = a.sum(), b.sum(), c.sum(), d.sum()`, always added in the same order.

    The four sums share their shuffles: within each group of four lanes first, then across the groups.
    """
    fours = range(0, LANES, 4)
    pairs = [[k + step for k in fours for step in (s, LANES + s, 1 + s, LANES + 1 + s)] for s in (0, 2)]
    quads = [[k + step for k in fours for step in (s, 1 + s, LANES + s, LANES + 1 + s)] for s in (0, 2)]

    def generate(
        context: TargetContext, builder: ir.IRBuilder, signature: Signature, args: list[ir.Value]
    ) -> ir.Value:
        first = _fold(builder, args[2], args[3], *pairs)
        second = _fold(builder, args[4], args[5], *pairs)
        totals = _fold(builder, first, second, *quads)
        width = LANES
        while width > 4:
            width //= 2
            totals = _fold(builder, totals, totals, list(range(width)), list(range(width, 2 * width)))
        start = builder.gep(context.make_array(array)(context, builder, args[0]).data, [args[1]])
        pointer = builder.bitcast(start, totals.type.as_pointer())
        builder.store(totals, pointer, align=array.dtype.bitwidth // 8)
        return context.get_dummy_value()

    return types.void(array, types.intp, a, a, a, a), generate


def _define_operator(function: Callable[[float, float], float], instruction: str) -> None:
    @intrinsic
    def apply(typing_context: TypingContext, a: LanesType, b: LanesType) -> Any:
        def generate(
            context: TargetContext, builder: ir.IRBuilder, signature: Signature, args: list[ir.Value]
        ) -> ir.Value:
            return getattr(builder, instruction)(*args)

        return a(a, a), generate

    @overload(function)
    def resolve(a: Lanes, b: Lanes) -> Callable[[Lanes, Lanes], Lanes] | None:
        def implementation(a: Lanes, b: Lanes) -> Lanes:
            return apply(a, b)

        return implementation if isinstance(a, LanesType) and a == b else None


_define_operator(operator.add, "fadd")
_define_operator(operator.sub, "fsub")
_define_operator(operator.mul, "fmul")
_define_operator(operator.truediv, "fdiv")


@intrinsic
def _libm_exp(typing_context: TypingContext, lanes: LanesType) -> Any:
    def generate(
        context: TargetContext, builder: ir.IRBuilder, signature: Signature, args: list[ir.Value]
    ) -> ir.Value:
        kind = ir.FunctionType(args[0].type, [args[0].type])
        name = f"llvm.exp.v{LANES}f{lanes.element.bitwidth}"
        return builder.call(cgutils.get_or_insert_function(builder.module, kind, name), args)

    return lanes(lanes), generate


def exp(x: Lanes) -> Lanes:
    """Return e^x in kernels: in float32 to 3e-6 relative for −5.56 ≤ x ≤ 0, and anything, even NaN, elsewhere."""
    raise NotImplementedError("only inside numba kernels")


@overload(exp, jit_options={"fastmath": {"contract"}})
def _resolve_exp(x: Lanes) -> Callable[[Lanes], Lanes]:
    def libm(x: Lanes) -> Lanes:
        return _libm_exp(x)

    def polynomial(x: Lanes) -> Lanes:
        # The minimax polynomial of e^(x/8), to the eighth power, needs neither bit operations nor tables.
        y = splat(types.float32(1.788867319255094e-07))
        y = y * x + splat(types.float32(9.716052147757105e-06))
        y = y * x + splat(types.float32(0.00032419492951124107))
        y = y * x + splat(types.float32(0.007810715288641697))
        y = y * x + splat(types.float32(0.1249990996032212))
        y = y * x + splat(types.float32(0.9999999238550866))
        y = y * y
        y = y * y
        return y * y

    return libm if x.element.bitwidth == 64 else polynomial


_OPTIONS: dict[str, Any] = {"error_model": "numpy", "fastmath": {"contract"}}

jit: Any = njit(forceinline=True, **_OPTIONS)
worker_jit: Any = njit(**_OPTIONS)
kernel_jit: Any = kernel(**_OPTIONS)
parallel_jit: Any = kernel(parallel=True, **_OPTIONS)
