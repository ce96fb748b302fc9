"""Records and their arrays as NumPy arrays in the same memory."""

import ctypes
from functools import cache
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from skyless.core.native.records import Array, Made

_CACHE_LINE: Final = 64


def view(array: Any) -> NDArray[Any]:  # noqa: ANN401 - ctypes' arrays have no common type
    """A record, or an array of numbers or records, as a NumPy array in the same memory."""
    element: Any = type(array)
    shape: list[int] = []
    while issubclass(element, ctypes.Array):
        shape.append(element._length_)
        element = element._type_
    return np.frombuffer(array, _dtype(element)).reshape(shape)


@cache
def _dtype(element: type) -> np.dtype[Any]:
    """Cached, as creating the fields of a record takes NumPy longer than viewing its memory."""
    return np.dtype(element)


def records(made: type[Made], array: NDArray[np.void]) -> Array[Made]:
    """The records of a NumPy array of their type, shape (n,), in the same memory."""
    return (made * len(array)).from_buffer(array.data)


def aligned(made: type[Made]) -> Made:
    """A zeroed record at the start of a cache line. Pages that are never touched use no memory."""
    memory = np.zeros(ctypes.sizeof(made) + _CACHE_LINE, np.uint8)
    begin = -memory.ctypes.data % _CACHE_LINE
    return made.from_buffer(memory[begin : begin + ctypes.sizeof(made)].data)
