"""What writing and reading a graph of objects share (``checkpoint_writer``, ``checkpoint_reader``).

A graph is a list of nodes ``[kind, ...]``; node 0 is the root, and nodes name others by their numbers, so that shared
and circular references are kept.
"""

from collections import deque
from collections.abc import Callable, Mapping
from typing import Any, Final

import numpy as np
from msgspec import Struct

from skyless.positioning.estimator.state import ANCHOR_DTYPE, LINK_DTYPE, PACKET_DTYPE, SETTINGS_DTYPE, STATUS_DTYPE

PACKAGES: Final = (
    "skyless.air",
    "skyless.clocks",
    "skyless.positioning",
    "skyless.receiver",
    "skyless.ticks",
    "skyless.uncertainty",
)
"""Where the classes of a protocol machine live."""

PLAIN: Final[tuple[type, ...]] = (type(None), bool, float, str, bytes)

RECORDS: Final = {
    "anchor": ANCHOR_DTYPE,
    "packet": PACKET_DTYPE,
    "link": LINK_DTYPE,
    "status": STATUS_DTYPE,
    "settings": SETTINGS_DTYPE,
}
"""Types of the records that arrays may consist of."""

Node = list[Any]
Arrays = Mapping[type, Callable[[Any], bool]]
"""The classes that may hold arrays, each with whether one's are sound."""

_MISSING: Final = object()


def is_ours(module: str) -> bool:
    """Whether classes of that module may be part of a graph."""
    return any(module == package or module.startswith(f"{package}.") for package in PACKAGES)


def fields_of(value: object) -> dict[str, object]:
    """Attributes of an object, in ``__dict__``, slots or a struct's fields."""
    if isinstance(value, Struct):
        return {name: getattr(value, name) for name in value.__struct_fields__}
    slots = [name for kind in type(value).__mro__ for name in kind.__dict__.get("__slots__", ())]
    found = {name: getattr(value, name, _MISSING) for name in slots} | getattr(value, "__dict__", {})
    return {name: part for name, part in found.items() if part is not _MISSING}


def holds_arrays(value: object) -> bool:
    """Whether an object has arrays in its attributes, directly or in containers."""
    return any(_is_array(part, 4) for part in fields_of(value).values())


def _is_array(value: object, depth: int) -> bool:
    """Whether a value is an array or a container of some; what is nested deeper than any state counts as one."""
    if isinstance(value, dict):
        parts = [*value.values()]
    elif isinstance(value, list | tuple | deque):
        parts = [*value]
    else:
        return isinstance(value, np.ndarray)
    return depth == 0 or any(_is_array(part, depth - 1) for part in parts)
