"""A type for numba of LANES float32 that the processor computes with at once, and what is done with it.

It is LLVM's vector type, so it runs everywhere; registers of 16 floats (AVX-512) hold one, those of 8 (AVX2) one of
half the lanes, those of 4 (NEON) half of such a one. Buffers are flat arrays of float32, places in them are counted in
floats.
"""

import operator
from collections.abc import Callable
from typing import Any

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic, models, overload, register_model

from pnu.kernels.panels import LANES

FLOAT, INT = ir.FloatType(), ir.IntType(32)
VECTOR, INTEGERS = ir.VectorType(FLOAT, LANES), ir.VectorType(INT, LANES)
FLAGS = ("nnan", "ninf", "nsz", "arcp", "contract")
ALIGNED = 4  # bytes: a vector may begin at any float


class Vector(types.Type):
    """LANES numbers, as numba's compiler knows them."""

    def __init__(self) -> None:
        super().__init__(name=f"float32x{LANES}")


vector = Vector()


@register_model(Vector)
class _VectorModel(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, VECTOR)


def constant(value: float) -> ir.Constant:
    """The same number in all lanes."""
    return ir.Constant(VECTOR, [float(np.float32(value))] * LANES)


def pointer(context: Any, builder: Any, kind: Any, array: Any) -> Any:
    """To the first number of an array."""
    return context.make_array(kind)(context, builder, array).data


def load_at(builder: Any, base: Any, offset: Any) -> Any:
    """The vector that begins so many numbers after a pointer."""
    place = builder.bitcast(builder.gep(base, [offset]), VECTOR.as_pointer())
    return builder.load(place, align=ALIGNED)


def store_at(builder: Any, base: Any, offset: Any, value: Any) -> None:
    """Write a vector there."""
    place = builder.bitcast(builder.gep(base, [offset]), VECTOR.as_pointer())
    builder.store(value, place, align=ALIGNED)


def spread(builder: Any, number: Any) -> Any:
    """A number in all lanes."""
    undefined = ir.Constant(VECTOR, ir.Undefined)
    first = builder.insert_element(undefined, number, ir.Constant(INT, 0))
    return builder.shuffle_vector(first, undefined, ir.Constant(INTEGERS, [0] * LANES))


def call(builder: Any, name: str, *values: Any) -> Any:
    """LLVM's function of vectors by its name."""
    kind = ir.FunctionType(VECTOR, [value.type for value in values])
    function = cgutils.get_or_insert_function(builder.module, kind, f"llvm.{name}.v{LANES}f32")
    return builder.call(function, values)


def greater(builder: Any, a: Any, b: Any) -> Any:
    """Lane by lane the greater number."""
    return builder.select(builder.fcmp_ordered(">", a, b, flags=FLAGS), a, b)


@intrinsic
def load_vector(typing: Any, buffer: Any, place: Any) -> Any:
    """buffer[place : place + LANES]."""

    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        return load_at(builder, pointer(context, builder, signature.args[0], values[0]), values[1])

    return vector(buffer, types.intp), generate


@intrinsic
def store_vector(typing: Any, buffer: Any, place: Any, value: Any) -> Any:
    """buffer[place : place + LANES] = value."""

    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        store_at(builder, pointer(context, builder, signature.args[0], values[0]), values[1], values[2])
        return context.get_dummy_value()

    return types.void(buffer, types.intp, value), generate


@intrinsic
def full(typing: Any, number: Any) -> Any:
    """A float32 in all lanes."""

    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        return spread(builder, values[0])

    return vector(types.float32), generate


def _of_two(operation: Callable[[Any, Any, Any], Any]) -> Any:
    @intrinsic
    def function(typing: Any, a: Any, b: Any) -> Any:
        def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
            return operation(builder, *values)

        return vector(vector, vector), generate

    return function


def _operator(sign: Any, function: Any) -> None:
    @overload(sign, strict=False)
    def of_vectors(a: Any, b: Any) -> Any:
        if isinstance(a, Vector) and isinstance(b, Vector):
            return lambda a, b: function(a, b)
        return None


_operator(operator.add, _of_two(lambda builder, a, b: builder.fadd(a, b, flags=FLAGS)))
_operator(operator.sub, _of_two(lambda builder, a, b: builder.fsub(a, b, flags=FLAGS)))
_operator(operator.mul, _of_two(lambda builder, a, b: builder.fmul(a, b, flags=FLAGS)))
_operator(operator.truediv, _of_two(lambda builder, a, b: builder.fdiv(a, b, flags=FLAGS)))
largest = _of_two(greater)


@intrinsic
def fused(typing: Any, a: Any, b: Any, c: Any) -> Any:
    """a * b + c, rounded once where the processor can."""

    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        return call(builder, "fmuladd", *values)

    return vector(vector, vector, vector), generate


@intrinsic
def root(typing: Any, a: Any) -> Any:
    """Square root."""

    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        return call(builder, "sqrt", *values)

    return vector(vector), generate


@intrinsic
def where(typing: Any, a: Any, b: Any, yes: Any, no: Any) -> Any:
    """Lane by lane: yes where a <= b, else no."""

    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        a, b, yes, no = values
        return builder.select(builder.fcmp_ordered("<=", a, b), yes, no)

    return vector(vector, vector, vector, vector), generate


@intrinsic
def sum_of_lanes(typing: Any, a: Any) -> Any:
    """Sum of the lanes, a float32."""

    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        kind = ir.FunctionType(FLOAT, [FLOAT, VECTOR])
        name = f"llvm.vector.reduce.fadd.v{LANES}f32"
        function = cgutils.get_or_insert_function(builder.module, kind, name)
        return builder.call(function, [ir.Constant(FLOAT, -0.0), values[0]], fastmath=("reassoc",))

    return types.float32(vector), generate


def _polynomial() -> list[float]:
    """Of degree 5, equal to 2^x on -1/2 to 1/2 to 2e-7 of it, as near as float32 is."""
    x = 0.5 * np.cos(np.pi * (np.arange(400) + 0.5) / 400)
    fitted = np.polynomial.chebyshev.Chebyshev.fit(x, 2**x, 5, domain=[-0.5, 0.5])
    return [float(c) for c in fitted.convert(kind=np.polynomial.Polynomial).coef]


@intrinsic
def power_of_two(typing: Any, x: Any) -> Any:
    """2^x for x up to 127; what is below 2^-126 becomes that."""

    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        x = greater(builder, values[0], constant(-126))
        whole = call(builder, "nearbyint", x)
        rest = builder.fsub(x, whole, flags=FLAGS)
        *lower, power = (constant(c) for c in _polynomial())
        for c in reversed(lower):
            power = call(builder, "fmuladd", power, rest, c)
        bias, bits = (ir.Constant(INTEGERS, [value] * LANES) for value in (127, 23))  # of an exponent in float32
        exponent = builder.shl(builder.add(builder.fptosi(whole, INTEGERS), bias), bits)
        return builder.fmul(power, builder.bitcast(exponent, VECTOR), flags=FLAGS)

    return vector(vector), generate
