"""The estimator's state as bytes of a version, and back."""

from struct import Struct as Format
from typing import Any, Final

import numpy as np
from numpy.lib.recfunctions import repack_fields
from numpy.typing import NDArray

from skyless.core.estimator.settings import EstimatorSettings
from skyless.core.estimator.state import (
    ALL_RANGE_ERRORS,
    FAULT_KINDS,
    NO_RANGE_ERRORS,
    State,
    covariances,
    new_state,
    set_layout,
)
from skyless.core.native.sizes import MAX_ANCHORS
from skyless.core.native.views import view

VERSION: Final = 4
"""Changes with the fields of ``State`` and of the records in it."""
_HEAD: Final = Format("<HBBB")
"""Version, dimensions, anchors, and whether there are ambiguities."""


def packed_state(s: State) -> bytes:
    """A state as bytes: a head, then what is in use of each array."""
    return _HEAD.pack(VERSION, s.dim, s.count, s.status.has_phases) + b"".join(
        _packed(part).tobytes() for part in _parts(s)
    )


def unpacked_state(settings: EstimatorSettings, packed: bytes) -> State:
    """The state that ``packed_state`` has turned into bytes, which may come from anywhere.

    What the estimator uses as an index is checked or computed again. Any other numbers will do.

    Raises:
        ValueError: the bytes are of another version, other settings or another length, or hold an anchor twice.
    """
    if len(packed) < _HEAD.size or _HEAD.unpack_from(packed)[:2] != (VERSION, settings.dim):
        raise ValueError("the estimator's state is of another version or of other settings")
    s, place = new_state(settings), _HEAD.size
    s.count, has_phases = _HEAD.unpack_from(packed)[2:]
    s.status.has_phases = has_phases == 1
    if s.count > MAX_ANCHORS:
        raise ValueError(f"the estimator's state has {s.count} anchors; it can have {MAX_ANCHORS}")
    set_layout(s)
    for part in _parts(s):
        size, dtype = part.size * _packed(part).itemsize, _packed(part).dtype
        part[...] = np.frombuffer(packed[place : place + size].ljust(size, b"\0"), dtype).reshape(part.shape)
        if any((flags.view(np.uint8) > 1).any() for flags in _flags(part)):
            raise ValueError("the estimator's state has a field that is neither true nor false")
        place += size
    identifiers = {s.anchors[anchor].identifier for anchor in range(s.count)}
    if s.status.has_phases is not (has_phases == 1):
        raise ValueError("the estimator's state has ambiguities and has none")
    if place != len(packed) or len(identifiers) != s.count:
        raise ValueError("the estimator's state is incomplete or holds an anchor twice")
    if not NO_RANGE_ERRORS <= s.status.range_errors <= ALL_RANGE_ERRORS:
        raise ValueError("the estimator's state has range errors of no kind")
    set_layout(s)
    return s


def _flags(part: NDArray[Any]) -> list[NDArray[Any]]:
    """All fields of records, and of records in these, that are true or false."""
    fields = [part[name] for name in part.dtype.names or ()]
    return [one for one in fields if one.dtype == np.bool_] + [flags for one in fields for flags in _flags(one)]


def _packed(part: NDArray[Any]) -> NDArray[Any]:
    """Without what lies between the fields of records."""
    return repack_fields(part, recurse=True) if part.dtype.names else part


def _parts(s: State) -> list[NDArray[Any]]:
    """What is in use of the arrays of a state, and its counters."""
    n, count, faults = s.layout.end, s.count, FAULT_KINDS * s.count
    return [
        view(s.status),
        view(s.x)[:n],
        covariances(s)[:n, :n],
        view(s.V)[:n, : faults + s.dim],
        view(s.information)[:faults, :faults],
        view(s.evidence)[:faults],
        view(s.lasting_covariance)[:count, :count],
        view(s.lasting_m)[:count],
        view(s.anchors)[:count],
        view(s.packets)[:count],
        view(s.links)[:count, :count],
    ]
