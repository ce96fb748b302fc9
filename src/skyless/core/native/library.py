"""The libraries compiled from Python (``tools/translator``), and their functions.

With ``SKYLESS_UNCOMPILED=1`` in the environment the Python itself runs: the same bits, some thousand times slower.
"""

import ctypes
import os
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, Final, ParamSpec, TypeVar, cast, get_args, get_origin, get_type_hints

import numpy as np

from skyless.core.errors import SkylessError
from skyless.core.native.records import Array, ReadOnly, Record, c_type

Parameters = ParamSpec("Parameters")
Result = TypeVar("Result")

UNCOMPILED_VARIABLE: Final = "SKYLESS_UNCOMPILED"
CORE: Final = "skyless_core"
"""The library of a tag: what boards and browsers share with it."""
KERNELS: Final = "skyless_kernels"
"""The library of simulation and planning."""
FOLDER: Final = Path(__file__).parent
"""Where the sources and libraries are."""
SOURCE: Final = FOLDER / f"{CORE}.c"
_VARIANTS: Final = ("_avx2", "")
"""The first is for x86-64 processors with 256-bit vectors; both give the same bits."""
_AVX2: Final = frozenset({"avx2", "bmi1", "bmi2", "f16c", "fma", "movbe"})
"""Linux's names of the instruction sets of x86-64-v3."""


def is_compiled() -> bool:
    """Whether the library's functions are used rather than their Python."""
    return os.environ.get(UNCOMPILED_VARIABLE, "") in {"", "0"}


@cache
def library(name: str) -> ctypes.CDLL:
    """A library of this installation.

    Raises:
        SkylessError: it is missing, or was not compiled from the source beside it.
    """
    again = "install Skyless again (in a checkout: scripts/core)"
    source = FOLDER / f"{name}.c"
    files = [FOLDER / f"lib{name}{variant}.so" for variant in _VARIANTS]
    file = files[0] if files[0].exists() and _has_avx2() else files[-1]
    try:
        found = ctypes.CDLL(str(file))
    except OSError as error:
        raise SkylessError(f"the library {name}: {error}; {again}") from None
    digest = ctypes.c_char_p.in_dll(found, "skyless_source_digest").value
    if source.exists() and digest != source_digest(source).encode():
        raise SkylessError(f"{file} was made from another {source.name} than the one beside it; {again}")
    return found


def _has_avx2() -> bool:
    """Whether this processor has 256-bit vectors; False if unknown."""
    try:
        return set(Path("/proc/cpuinfo").read_text(encoding="ascii", errors="replace").split()) >= _AVX2
    except OSError:
        return False


def source_digest(source: Path) -> str:
    """Digest of the source from which a library is compiled."""
    import hashlib  # noqa: PLC0415 - not needed where there is no source

    header = source.with_suffix(".h")
    return hashlib.sha256(source.read_bytes() + header.read_bytes()).hexdigest()[:16]


def compiled(function: Callable[Parameters, Result], name: str = CORE) -> Callable[Parameters, Result]:
    """A library's version of a Python function.

    Records are passed as they are, arrays as ctypes or NumPy arrays, bytes also as ``bytes``. Lengths are not checked.
    """
    if not is_compiled():
        return function
    hints = get_type_hints(function, include_extras=True)
    returned = hints.pop("return")
    called = library(name)[f"skyless_{function.__name__}"]
    called.argtypes = [_argument_type(hint) for hint in hints.values()]
    called.restype = None if returned is type(None) else c_type(returned)
    return cast("Callable[Parameters, Result]", called)


def _argument_type(hint: Any) -> Any:  # noqa: ANN401 - types have no type
    if get_origin(hint) in {Array, ReadOnly}:
        return _address_type(c_type(get_args(hint)[0]))
    found = c_type(hint)
    return ctypes.POINTER(found) if issubclass(found, Record) else found


@cache
def _address_type(element: Any) -> type:  # noqa: ANN401 - types have no type
    """The type of an argument that is an array of these elements."""
    expected = np.dtype(element)

    class Address:
        @classmethod
        def from_param(cls, array: Any) -> Any:  # noqa: ANN401 - arrays of several libraries
            """Convert an array to a C argument. Raises TypeError: it has other elements, or is not contiguous."""
            if getattr(array, "_type_", None) is element or (isinstance(array, bytes) and element is ctypes.c_uint8):
                return ctypes.c_void_p.from_param(array)
            if not isinstance(array, np.ndarray):
                raise TypeError(f"the array is a {type(array).__name__}; it should have elements of {expected}")
            if array.dtype != expected:
                raise TypeError(f"the array has elements of {array.dtype}; they should be of {expected}")
            if not array.flags.c_contiguous:
                raise TypeError(f"the array's strides are {array.strides}; it should be contiguous")
            return ctypes.c_void_p(array.ctypes.data)

    return Address
