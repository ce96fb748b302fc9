"""Eight numbers at a time: the words in which kernels speak to a processor's vector unit.

A compiler can make such loops itself, but where arrays might overlap, as all that a caller owns might, it asks so first
in every loop, and it has remainders to take care of. Here there is nothing to ask: eight neighbours are read, worked
on, and written. ``add`` rounds once where the processor has such an instruction; a kernel is compiled for one
processor, so wherever the same words stand the same bits come out.

Without the compiler (``NUMBA_DISABLE_JIT=1``) the functions below run as they stand.
"""

import math
from collections.abc import Callable
from typing import Any, Final

import numpy as np
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import lower_builtin, models, register_model, type_callable
from numba.np.arrayobj import make_array
from numpy.typing import NDArray

EIGHT: Final = 8

Array = NDArray[np.float64]
Eight = NDArray[np.float64]
"""Shape (8,)."""
Place = int | tuple[int, int]
"""Of the first of eight neighbours, in an array of one dimension or, row and column, of two."""


def zeros(*shape: int) -> Array:
    """An array that begins where a line of the processor's cache does, so that no eight lie across two of them."""
    room = np.zeros(math.prod(shape) + EIGHT)
    begin = -room.ctypes.data // room.itemsize % EIGHT
    return room[begin : begin + math.prod(shape)].reshape(shape)


def load(array: Array, place: Place) -> Eight:
    """The eight numbers from ``place`` on."""
    row, column = place if isinstance(place, tuple) else (..., place)
    eight: Eight = array[row, column : column + EIGHT].copy()
    return eight


def store(array: Array, place: Place, eight: Eight) -> None:
    """Write eight numbers from ``place`` on."""
    row, column = place if isinstance(place, tuple) else (..., place)
    array[row, column : column + EIGHT] = eight


def repeated(value: float) -> Eight:
    """Eight times the same."""
    return np.full(EIGHT, value)


def add(eight: Eight, factor: float | Eight, other: Eight) -> Eight:
    """``eight`` and ``factor`` times ``other``."""
    return eight + factor * other


def scaled(factor: float | Eight, eight: Eight) -> Eight:
    """``factor`` times ``eight``."""
    return factor * eight


class _Type(types.Type):
    def __init__(self) -> None:
        super().__init__(name="Eight")


_EIGHT: Final = _Type()
_LANES: Final = ir.VectorType(ir.DoubleType(), EIGHT)


@register_model(_Type)
class _Model(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, _LANES)


def _load(context: Any, builder: Any, signature: Any, args: Any) -> Any:
    eight = builder.load(_pointer(context, builder, signature, args))
    eight.align = 8  # of one number: rows begin anywhere
    return eight


def _store(context: Any, builder: Any, signature: Any, args: Any) -> Any:
    builder.store(args[2], _pointer(context, builder, signature, args)).align = 8
    return context.get_dummy_value()


def _repeated(context: Any, builder: Any, signature: Any, args: Any) -> Any:
    return _wide(builder, args[0])


def _add(context: Any, builder: Any, signature: Any, args: Any) -> Any:
    kind = ir.FunctionType(_LANES, [_LANES] * 3)
    function = cgutils.get_or_insert_function(builder.module, kind, "llvm.fmuladd.v8f64")
    return builder.call(function, [_wide(builder, args[1]), args[2], args[0]])


def _scaled(context: Any, builder: Any, signature: Any, args: Any) -> Any:
    return builder.fmul(_wide(builder, args[0]), args[1])


def _pointer(context: Any, builder: Any, signature: Any, args: Any) -> Any:
    """Where the array and the place, the first two arguments, say."""
    kind, place = signature.args[:2]
    is_pair = isinstance(place, types.BaseTuple)
    parts = cgutils.unpack_tuple(builder, args[1]) if is_pair else [args[1]]
    indices = [
        context.cast(builder, part, of, types.intp)
        for part, of in zip(parts, place.types if is_pair else [place], strict=True)
    ]
    array = make_array(kind)(context, builder, args[0])
    return builder.bitcast(cgutils.get_item_pointer(context, builder, kind, array, indices), _LANES.as_pointer())


def _wide(builder: Any, value: Any) -> Any:
    """A number eight times; eight numbers as they are."""
    if value.type == _LANES:
        return value
    one = builder.insert_element(ir.Constant(_LANES, ir.Undefined), value, ir.IntType(32)(0))
    return builder.shuffle_vector(one, one, ir.Constant(ir.VectorType(ir.IntType(32), EIGHT), [0] * EIGHT))


def _compile(function: Callable[..., object], typer: Callable[..., types.Type], code: Callable[..., Any]) -> None:
    """Tell the compiler what kind of value the function returns, and its instructions."""
    type_callable(function)(lambda _: typer)
    lower_builtin(function, *[types.Any] * len(typer.__code__.co_varnames))(code)


_compile(load, lambda array, place: _EIGHT, _load)
_compile(store, lambda array, place, eight: types.void, _store)
_compile(repeated, lambda value: _EIGHT, _repeated)
_compile(add, lambda eight, factor, other: _EIGHT, _add)
_compile(scaled, lambda factor, eight: _EIGHT, _scaled)
