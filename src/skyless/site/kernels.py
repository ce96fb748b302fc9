"""How Numba compiles functions of the simulation and of planning, which stay typed Python functions.

With ``NUMBA_DISABLE_JIT=1`` every kernel runs as plain Python and gives the same values to rounding.
"""

import hashlib
import math
import os
import pickle
import re
import shutil
import time
from collections.abc import Callable, Iterable
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any, Final, TypeVar, cast

import numba
from numba import njit
from numba.core.caching import CompileResultCacheImpl, FunctionCache, UserProvidedCacheLocator
from numba.extending import register_jitable

from skyless.core.arrays import Array

# Folder of the kernels that Numba has compiled.
#
# The folder belongs to exactly these sources: the compiler notices a change of the kernel's own file, but not of called
# functions or of constants from elsewhere, so the folder's name contains a digest of all files with kernels and of all
# that they import. Folders of other sources are removed when they have not been used for long.
#
# Candidates in order: ``NUMBA_CACHE_DIR``, next to the sources, the user's cache. The first one is used that can be
# written, or that is read-only but holds kernels (an image). Without any, every program compiles for itself.

_PACKAGE: Final = Path(__file__).parents[1]
_IMPORT: Final = re.compile(rb"from (skyless[\w.]*) import (\([^)]*\)|.*)")
_KEPT_S: Final = 7 * 86_400.0
"""Kernels of other sources are kept for a week after their last use, as several versions may share a folder."""


@cache
def kernel_folder() -> Path | None:
    """Folder of this program's compiled kernels; None if no folder can be used."""
    if asked := os.environ.get("NUMBA_CACHE_DIR"):
        # Absolute also for child processes, which may change their working folder.
        os.environ["NUMBA_CACHE_DIR"] = str(Path(asked).absolute())
    name = f"kernels-{digest(_PACKAGE)}"
    found = choose_folder(_homes(), name)
    if found is not None:
        with suppress(OSError):
            os.utime(found)  # the folder's time is that of its last use
            _remove_unused(found)
    return found


def choose_folder(homes: Iterable[Path], name: str) -> Path | None:
    """The folder in the first home where it is writable, or read-only with kernels in it; None if there is none."""
    for home in homes:
        path = home / name
        with suppress(OSError):
            path.mkdir(parents=True, exist_ok=True)
        with suppress(OSError):  # a home that may not be searched
            if path.is_dir() and (os.access(path, os.W_OK | os.X_OK) or any(path.iterdir())):
                return path
    return None


def _homes() -> Iterable[Path]:
    if asked := os.environ.get("NUMBA_CACHE_DIR"):
        yield Path(asked)
    yield _PACKAGE / "__pycache__"
    cached = Path(os.environ.get("XDG_CACHE_HOME", ""))
    if cached.is_absolute():  # a relative one is not valid
        yield cached / "skyless"
    with suppress(RuntimeError):  # a user without a home
        yield Path.home() / ".cache" / "skyless"


def digest(package: Path) -> str:
    """Digest of the files of the package ``skyless`` that contain kernels, and of all that they import."""
    texts = {_module(file, package): file.read_bytes() for file in sorted(package.rglob("*.py"))}
    wanted = [name for name, text in texts.items() if b"skyless.site.kernels" in text or ".kernels." in name]
    used: set[str] = set()
    while wanted:
        name = wanted.pop()
        if name in texts and name not in used:
            used.add(name)
            for module, names in _IMPORT.findall(texts[name]):
                origin = module.decode()
                wanted += [origin, *(f"{origin}.{one}" for one in re.findall(r"\w+", names.decode()))]
    found = hashlib.sha1(usedforsecurity=False)
    for name in sorted(used):
        found.update(texts[name])
    return found.hexdigest()[:16]


def _module(file: Path, package: Path) -> str:
    return str(file)[len(str(package.parent)) + 1 : -len(".py")].replace(os.sep, ".")


def _remove_unused(folder: Path) -> None:
    for old in folder.parent.glob("kernels-*"):
        with suppress(FileNotFoundError):  # another program may be cleaning up as well
            if old != folder and time.time() - old.stat().st_mtime > _KEPT_S:
                shutil.rmtree(old, ignore_errors=True)


Function = TypeVar("Function", bound=Callable[..., Any])

_CONFIG: Any = numba.config


def kernel(function: Function) -> Function:
    """Compile a scalar function over arrays that its caller owns; the result is cached on disk.

    ``error_model="numpy"`` makes a division by zero an infinity instead of an exception, as in NumPy.
    Fast-math stays off, as streaming and batch must give identical bits.
    """
    return _compile(function, {})


def part(function: Function) -> Function:
    """Compile a small function inline into its callers, and on its own only if Python calls it.

    A separate kernel costs a twentieth of a second at the first start, however short it is, and its callers compile its
    instructions once more. A long function with several callers is better a kernel.
    """
    return _compile(function, {"inline": "always"})


def jitted(function: Function) -> Function:
    """Let kernels call a small function, which stays plain Python elsewhere."""
    return register_jitable(function)


def step(function: Function) -> Function:
    """Compile a function into each kernel that calls it; it stays plain Python elsewhere."""
    return register_jitable(forceinline=True, error_model="numpy")(function)


def threaded_kernel(function: Function) -> Function:
    """Compile a long loop that releases the interpreter's lock, so that threads run it in parallel."""
    return _compile(function, {"nogil": True})


def _compile(function: Function, options: dict[str, Any]) -> Function:
    compiled = njit(error_model="numpy", **options)(function)
    if not _CONFIG.DISABLE_JIT and kernel_folder() is not None:
        compiled._cache = _KernelCache(function)  # type: ignore[no-untyped-call]
    return cast("Function", compiled)


class _Locator(UserProvidedCacheLocator):
    """Locates a kernel's cache; numba's own locators reject read-only folders, as in images."""

    def __init__(self, function: Callable[..., Any], file: str) -> None:
        self._py_file, self._lineno = file, function.__code__.co_firstlineno
        home = kernel_folder()
        assert home is not None, "without a folder kernels have no cache"
        folder = home / self.get_suitable_cache_subpath(file)  # type: ignore[no-untyped-call]
        self._cache_path, self._stamp = str(folder), home.name
        with suppress(OSError):
            folder.mkdir(exist_ok=True)

    def get_source_stamp(self) -> str:
        """The folder's name, which contains a digest of the sources: times of files change on the way into an image."""
        return self._stamp

    @classmethod
    def from_function(cls, function: Callable[..., Any], file: str) -> "_Locator":
        """See numba."""
        return cls(function, file)


class _Kept(CompileResultCacheImpl):
    _locator_classes = [_Locator]  # noqa: RUF012 (numba's)


class _KernelCache(FunctionCache):
    """Cache for which a file that cannot be read or written is no error, but costs a compilation."""

    _impl_class = _Kept

    def load_overload(self, signature: object, context: object) -> object:
        """See numba; None if there is no usable file."""
        try:
            return super().load_overload(signature, context)  # type: ignore[no-untyped-call]
        except (OSError, EOFError, pickle.UnpicklingError):  # for instance after a loss of power
            with suppress(OSError):
                self.flush()  # type: ignore[no-untyped-call]
            return None

    def save_overload(self, signature: object, data: object) -> None:
        """See numba."""
        with suppress(OSError):
            super().save_overload(signature, data)  # type: ignore[no-untyped-call]


# Cholesky factors of small matrices, in place and without allocation.
#
# With the few unknowns of a position they avoid LAPACK's call overhead, and they run in compiled loops.

SINGULAR_PIVOT = 1e-12
"""A pivot below this share of its diagonal element is rounding noise: the matrix is singular."""


@kernel
def factorise(matrix: Array, size: int) -> bool:
    """Replace the leading ``size`` × ``size`` block by its lower factor L, with L·Lᵀ = matrix.

    Only the lower triangle is read and written. Returns False if the matrix is not positive definite (or not finite);
    its contents are then undefined.
    """
    for j in range(size):
        diagonal = matrix[j, j]
        pivot = diagonal
        for k in range(j):
            pivot -= matrix[j, k] * matrix[j, k]
        if not (pivot > SINGULAR_PIVOT * diagonal and diagonal > 0.0):
            return False
        root = math.sqrt(pivot)
        matrix[j, j] = root
        for i in range(j + 1, size):
            total = matrix[i, j]
            for k in range(j):
                total -= matrix[i, k] * matrix[j, k]
            matrix[i, j] = total / root
    return True


@kernel
def solve(factor: Array, size: int, vector: Array) -> None:
    """Replace ``vector`` by (L·Lᵀ)⁻¹·vector."""
    for i in range(size):
        total = vector[i]
        for k in range(i):
            total -= factor[i, k] * vector[k]
        vector[i] = total / factor[i, i]
    for i in range(size - 1, -1, -1):
        total = vector[i]
        for k in range(i + 1, size):
            total -= factor[k, i] * vector[k]
        vector[i] = total / factor[i, i]


@kernel
def invert(factor: Array, size: int, inverse: Array) -> None:
    """Write (L·Lᵀ)⁻¹ into the leading block of ``inverse``."""
    for j in range(size):
        for i in range(size):
            inverse[j, i] = 1.0 if i == j else 0.0
        solve(factor, size, inverse[j])
