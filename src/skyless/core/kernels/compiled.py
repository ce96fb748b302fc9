"""The one door to the compiler, so that kernels stay typed Python functions.

With ``NUMBA_DISABLE_JIT=1`` every kernel runs as plain Python and gives the same values to rounding.
"""

import os
import pickle
from collections.abc import Callable
from contextlib import suppress
from typing import Any, Final, TypeVar, cast

import numba
from numba import njit
from numba.core.caching import CompileResultCacheImpl, FunctionCache, UserProvidedCacheLocator
from numba.extending import register_jitable

from skyless.core.kernels.cache import ONLY_VARIABLE, kernel_folder

Function = TypeVar("Function", bound=Callable[..., Any])

_CONFIG: Any = numba.config

_NAMES: Final = os.environ.get(ONLY_VARIABLE, "").replace(",", " ").split()
_ONLY: Final = tuple(name for name in _NAMES if not name.startswith("-"))
_WITHOUT: Final = tuple(name[1:] for name in _NAMES if name.startswith("-"))
_declared: Final[set[str]] = set()


def is_compiling() -> bool:
    """Whether kernels are compiled at all."""
    return not _CONFIG.DISABLE_JIT


def declared_kernels() -> frozenset[str]:
    """Module and name of every function that has been declared here so far and that this program compiles."""
    return frozenset(_declared)


def kernel(function: Function) -> Function:
    """Compile a scalar function over arrays that its caller owns; the result is cached on disk.

    ``error_model="numpy"`` makes a division by zero an infinity instead of an exception, as in NumPy.
    Fast-math stays off: streaming and batch must give identical bits.
    """
    _declare(function)
    return _compile(function, {})


def part(function: Function) -> Function:
    """Compile a small function only as lines of its callers, and by itself only where Python calls it.

    A kernel of its own costs a twentieth of a second at the first start, however short it is, and its callers then
    compile its instructions once more. What is long and has several callers is better a kernel.
    """
    return _compile(function, {"inline": "always"})


def jitted(function: Function) -> Function:
    """A small function that kernels may call, and that stays plain Python elsewhere."""
    _declare(function)
    return register_jitable(function)


def step(function: Function) -> Function:
    """A step of kernels: compiled as part of each that calls it, and plain Python where Python calls it.

    A step that takes arrays returns at its end only. Then the compiler sees that all references to arrays that it
    counts up it counts down again, and omits both; with a dozen arrays they take as long as the arithmetic. A kernel
    has none of them where all that it calls are steps.
    """
    _declare(function)
    return register_jitable(forceinline=True, error_model="numpy")(function)


def threaded_kernel(function: Function) -> Function:
    """Compile a long loop that runs without the interpreter's lock, so that threads run it side by side."""
    _declare(function)
    return _compile(function, {"nogil": True})


def _compile(function: Function, options: dict[str, Any]) -> Function:
    if not _is_wanted(function):
        return function
    compiled = njit(error_model="numpy", **options)(function)
    if is_compiling():
        compiled._cache = _KernelCache(function)  # type: ignore[no-untyped-call]
    return cast("Function", compiled)


def _declare(function: Callable[..., Any]) -> None:
    if _is_wanted(function):
        _declared.add(f"{function.__module__}.{function.__qualname__}")


def _is_wanted(function: Callable[..., Any]) -> bool:
    module = function.__module__
    return (not _ONLY or module.startswith(_ONLY)) and not module.startswith(_WITHOUT)


class _Locator(UserProvidedCacheLocator):
    """Where a kernel is kept: numba's own locators reject a folder that cannot be written, as images have them."""

    def __init__(self, function: Callable[..., Any], file: str) -> None:
        self._py_file, self._lineno = file, function.__code__.co_firstlineno
        folder = kernel_folder().path / self.get_suitable_cache_subpath(file)  # type: ignore[no-untyped-call]
        self._cache_path = str(folder)
        with suppress(OSError):
            folder.mkdir(exist_ok=True)

    def get_source_stamp(self) -> str:
        """The folder's name holds a digest of the sources; times of files change on their way into an image."""
        return kernel_folder().path.name

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
