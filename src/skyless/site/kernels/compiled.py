"""How Numba compiles functions of the simulation and of planning, which stay typed Python functions.

With ``NUMBA_DISABLE_JIT=1`` every kernel runs as plain Python and gives the same values to rounding.
"""

import pickle
from collections.abc import Callable
from contextlib import suppress
from typing import Any, TypeVar, cast

import numba
from numba import njit
from numba.core.caching import CompileResultCacheImpl, FunctionCache, UserProvidedCacheLocator
from numba.extending import register_jitable

from skyless.site.kernels.cache import kernel_folder

Function = TypeVar("Function", bound=Callable[..., Any])

_CONFIG: Any = numba.config


def kernel(function: Function) -> Function:
    """Compile a scalar function over arrays that its caller owns; the result is cached on disk.

    ``error_model="numpy"`` makes a division by zero an infinity instead of an exception, as in NumPy.
    Fast-math stays off: streaming and batch must give identical bits.
    """
    return _compile(function, {})


def part(function: Function) -> Function:
    """Compile a small function only as lines of its callers, and by itself only where Python calls it.

    A kernel of its own costs a twentieth of a second at the first start, however short it is, and its callers then
    compile its instructions once more. What is long and has several callers is better a kernel.
    """
    return _compile(function, {"inline": "always"})


def jitted(function: Function) -> Function:
    """A small function that kernels may call, and that stays plain Python elsewhere."""
    return register_jitable(function)


def step(function: Function) -> Function:
    """A step of kernels: compiled as part of each that calls it, and plain Python where Python calls it."""
    return register_jitable(forceinline=True, error_model="numpy")(function)


def threaded_kernel(function: Function) -> Function:
    """Compile a long loop that runs without the interpreter's lock, so that threads run it side by side."""
    return _compile(function, {"nogil": True})


def _compile(function: Function, options: dict[str, Any]) -> Function:
    compiled = njit(error_model="numpy", **options)(function)
    if not _CONFIG.DISABLE_JIT and kernel_folder() is not None:
        compiled._cache = _KernelCache(function)  # type: ignore[no-untyped-call]
    return cast("Function", compiled)


class _Locator(UserProvidedCacheLocator):
    """Where a kernel is kept: numba's own locators reject a folder that cannot be written, as images have them."""

    def __init__(self, function: Callable[..., Any], file: str) -> None:
        self._py_file, self._lineno = file, function.__code__.co_firstlineno
        home = kernel_folder()
        assert home is not None, "without a folder kernels have no cache"
        folder = home / self.get_suitable_cache_subpath(file)  # type: ignore[no-untyped-call]
        self._cache_path, self._stamp = str(folder), home.name
        with suppress(OSError):
            folder.mkdir(exist_ok=True)

    def get_source_stamp(self) -> str:
        """The folder's name holds a digest of the sources; times of files change on their way into an image."""
        return self._stamp

    @classmethod
    def from_function(cls, function: Callable[..., Any], file: str) -> "_Locator":
        """See numba."""
        return cls(function, file)


class _Kept(CompileResultCacheImpl):
    _locator_classes = [_Locator]  # noqa: RUF012 (numba's)


class _KernelCache(FunctionCache):
    """A file that cannot be read or written costs a compilation, and is no error."""

    _impl_class = _Kept

    def load_overload(self, signature: object, context: object) -> object:
        """See numba; None where there is no usable file."""
        try:
            return super().load_overload(signature, context)  # type: ignore[no-untyped-call]
        except (OSError, EOFError, pickle.UnpicklingError):  # as a loss of power leaves them
            with suppress(OSError):
                self.flush()  # type: ignore[no-untyped-call]
            return None

    def save_overload(self, signature: object, data: object) -> None:
        """See numba."""
        with suppress(OSError):
            super().save_overload(signature, data)  # type: ignore[no-untyped-call]
