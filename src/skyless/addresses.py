"""Arrays by their addresses: compiled code takes one table of them faster than it looks at dozens of arrays."""

import ctypes
import math
from collections.abc import Callable, Iterable
from typing import Any, Final

import numpy as np
from numba import types
from numba.core import cgutils
from numba.extending import lower_builtin, type_callable
from numba.np.arrayobj import make_array, populate_array
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Table = NDArray[np.int64]
"""Shape (arrays, 4): each array's address and its up to three dimensions."""

MOST_DIMENSIONS: Final = 3


class Addresses:
    """Where arrays are, which it keeps alive. A copy or a pickle of it is None: its arrays would be others."""

    __slots__ = ("arrays", "table")

    def __init__(self, arrays: Iterable[Floats | Integers]) -> None:
        """Arrays of float64 and int64, all contiguous, that are not resized.

        Raises:
            ValueError: one is not contiguous or of another type.
        """
        self.arrays = tuple(arrays)
        for array in self.arrays:
            if not array.flags.c_contiguous or array.dtype not in (np.float64, np.int64):
                raise ValueError(f"an array of {array.dtype}, strides {array.strides}, is nothing for compiled code")
        rows = [[a.ctypes.data, *a.shape, *[0] * (MOST_DIMENSIONS - a.ndim)] for a in self.arrays]
        self.table: Table = np.array(rows, np.int64)

    def __reduce__(self) -> tuple[type[None], tuple[()]]:
        return type(None), ()


def vector(table: Table, row: int) -> Floats:
    """The array in a row of the table, of one dimension."""
    return _array(table, row, np.float64, 1)


def matrix(table: Table, row: int) -> Floats:
    """The same of two."""
    return _array(table, row, np.float64, 2)


def integers(table: Table, row: int) -> Integers:
    """Integers in one dimension."""
    return _array(table, row, np.int64, 1)


def integer_matrix(table: Table, row: int) -> Integers:
    """In two."""
    return _array(table, row, np.int64, 2)


def integer_blocks(table: Table, row: int) -> Integers:
    """In three."""
    return _array(table, row, np.int64, 3)


def _array(table: Table, row: int, kind: type, dimensions: int) -> NDArray[Any]:
    """What stands at an address, without the compiler."""
    address, *shape = table[row, : 1 + dimensions].tolist()
    numbers = (ctypes.c_byte * (8 * math.prod(shape))).from_address(address)
    return np.frombuffer(numbers, kind).reshape(shape)


def _compile(function: Callable[..., object], kind: types.Type, dimensions: int) -> None:
    """Tell the compiler of which kind the array is, and its instructions."""
    array = types.Array(kind, dimensions, "C")

    def code(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        table = make_array(signature.args[0])(context, builder, args[0])
        row = context.cast(builder, args[1], signature.args[1], types.intp)
        places = [[row, context.get_constant(types.intp, column)] for column in range(1 + dimensions)]
        pointers = [cgutils.get_item_pointer(context, builder, signature.args[0], table, place) for place in places]
        address, *shape = [builder.load(pointer) for pointer in pointers]
        item, strides = context.get_constant(types.intp, 8), [context.get_constant(types.intp, 8)]
        for size in reversed(shape[1:]):
            strides.insert(0, builder.mul(strides[0], size))
        made, data = make_array(array)(context, builder), context.get_data_type(kind).as_pointer()
        populate_array(made, builder.inttoptr(address, data), shape, strides, item, None)
        return made._getvalue()

    type_callable(function)(lambda _: lambda table, row: array)
    lower_builtin(function, types.Any, types.Any)(code)


_compile(vector, types.float64, 1)
_compile(matrix, types.float64, 2)
_compile(integers, types.int64, 1)
_compile(integer_matrix, types.int64, 2)
_compile(integer_blocks, types.int64, 3)
