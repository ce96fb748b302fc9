"""The one door to the compiler, so that kernels stay typed Python functions.

With ``NUMBA_DISABLE_JIT=1`` every kernel runs as plain Python and gives the same values to rounding.
"""

from collections.abc import Callable
from typing import Any, TypeVar, cast

from numba import njit

Function = TypeVar("Function", bound=Callable[..., Any])


def kernel(function: Function) -> Function:
    """Compile a scalar function over arrays that its caller owns; the result is cached beside the source.

    ``error_model="numpy"`` makes a division by zero an infinity instead of an exception, as in NumPy.
    Fast-math stays off: streaming and batch must give identical bits.
    """
    return cast("Function", njit(cache=True, error_model="numpy")(function))
