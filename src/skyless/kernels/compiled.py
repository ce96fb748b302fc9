"""The one door to the compiler, so that kernels stay typed Python functions.

With ``NUMBA_DISABLE_JIT=1`` every kernel runs as plain Python and gives the same values to rounding.
"""

import hashlib
import os
import shutil
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, Final, TypeVar, cast

import numba
from numba import njit
from numba.extending import register_jitable

Function = TypeVar("Function", bound=Callable[..., Any])

_CONFIG: Any = numba.config
_PACKAGE: Final = Path(__file__).parents[1]
_KEPT_S: Final = 86_400.0
"""Kernels of older sources are kept for a day: a program that was started with them may still be compiling."""


def _cache_folder() -> str:
    """Folder of compiled kernels for exactly these sources.

    Numba notices a change of the kernel's own file but not of the kernels that it calls. So a digest of all files with
    kernels, and of the constants that they use, stands in the folder's name; older folders are removed when no
    running program can need them.
    """
    digest = hashlib.sha1(usedforsecurity=False)
    for source in sorted(_PACKAGE.rglob("*.py")):
        text = source.read_bytes()
        is_kernel = b"skyless.kernels.compiled" in text or source.parent.name == "kernels"
        if is_kernel or source.name == "constants.py":
            digest.update(text)
    folder = _cache_home() / f"kernels-{digest.hexdigest()[:16]}"
    if not folder.exists():
        for old in folder.parent.glob("kernels-*"):
            with suppress(FileNotFoundError):  # another program may be cleaning up as well
                if time.time() - old.stat().st_mtime > _KEPT_S:
                    shutil.rmtree(old, ignore_errors=True)
        folder.mkdir(parents=True, exist_ok=True)
    return str(folder)


def _cache_home() -> Path:
    beside_sources = _PACKAGE / "__pycache__"
    if os.access(_PACKAGE, os.W_OK):
        return beside_sources
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "skyless"


_CACHE_FOLDER: Final = os.environ.get("NUMBA_CACHE_DIR") or _cache_folder()


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
    """A step of kernels: compiled as part of each that calls it, and plain Python where Python calls it.

    A step that takes arrays returns at its end only. Then the compiler sees that all references to arrays that it
    counts up it counts down again, and omits both; with a dozen arrays they take as long as the arithmetic. A kernel
    has none of them where all that it calls are steps.
    """
    return register_jitable(forceinline=True, error_model="numpy")(function)


def threaded_kernel(function: Function) -> Function:
    """Compile a long loop that runs without the interpreter's lock, so that threads run it side by side."""
    return _compile(function, {"nogil": True})


def _compile(function: Function, options: dict[str, Any]) -> Function:
    callers_folder = _CONFIG.CACHE_DIR
    _CONFIG.CACHE_DIR = _CACHE_FOLDER
    try:
        return cast("Function", njit(cache=True, error_model="numpy", **options)(function))
    finally:
        _CONFIG.CACHE_DIR = callers_folder


def cores() -> int:
    """Processors that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
