"""Whether an estimator from elsewhere is what its kernels, which check no bounds, count on."""

from collections.abc import Iterator
from typing import Any, Final

import numpy as np
from numpy.typing import DTypeLike

from skyless.air.beacon import HEARD
from skyless.kernels.arrays import Integers
from skyless.positioning.estimator.estimator import MOST_PACKED, Estimator
from skyless.positioning.estimator.levels import LEVELS
from skyless.positioning.estimator.state import (
    ANCHOR,
    LASTING,
    LINK,
    NONE,
    PACKET,
    REMEMBERED,
    SETTINGS,
    STATUS,
    EstimatorSettings,
    EstimatorState,
    layout,
    most_terms,
)
from skyless.positioning.fix import PROTECTED_ROWS

MethodOptions = tuple[object, tuple[int, ...], DTypeLike]
"""An array, its shape and its type."""

MOST: Final = 4096
"""Anchors in the table."""


def is_sound(estimator: Estimator) -> bool:
    """Shapes and types of all arrays, and that the table names each anchor of the state once.

    Any numbers will do elsewhere: ``h_index`` is written before it is read, and no other number is an index.
    """
    own = vars(estimator)
    settings, state = own["settings"], own["_state"]
    if not isinstance(settings, EstimatorSettings) or not isinstance(state, EstimatorState):
        return False
    known = all(type(index) is int and 0 <= index < len(state.index_of) for index in own["index_of"].values())
    if not isinstance(own["_left_out"], frozenset) or not known:
        return False
    if own["dim"] != settings.dim or not isinstance(own["_table_m"], list) or len(own["_table_m"]) > MOST:
        return False
    arrays = [*_of_state(state, settings.dim, len(own["_table_m"])), *_of_estimator(own)]
    if not all(_is_array(*wanted) for wanted in arrays):
        return False
    if state.settings["dim"][0] != settings.dim or not NONE <= state.status["range_errors"][0] <= LASTING:
        return False
    return _is_inverse(state.index_of, state.anchors["table_index"])


def _of_state(s: EstimatorState, dim: int, table_size: int) -> Iterator[MethodOptions]:
    count = len(s.anchors)
    n, faults, terms = layout(dim, count).room, 2 * count + dim, most_terms(dim)
    yield s.x, (n,), np.float64
    yield s.P, (n, n), np.float64
    yield s.V, (faults, n), np.float64
    yield s.information, (3, count, count), np.float64
    yield s.evidence, (2, count), np.float64
    yield s.anchors, (count,), ANCHOR
    yield s.packets, (count, REMEMBERED), PACKET
    yield s.links, (count, count), LINK
    yield s.status, (1,), STATUS
    yield s.settings, (1,), SETTINGS
    yield s.index_of, (table_size,), np.int64
    yield s.h, (terms,), np.float64
    yield s.h_index, (terms,), np.uint32
    yield s.ph, (n,), np.float64
    yield s.fault_input, (faults,), np.float64
    yield s.work, (count + 1 + dim, count), np.float64


def _of_estimator(own: dict[str, Any]) -> Iterator[MethodOptions]:
    table_m, listed = own["_table_m"], own["_listed"]
    for position_m in table_m:
        yield position_m, (3,), np.float64
    yield own["_identifiers"], (len(table_m),), np.int64
    yield own["_levels"], (LEVELS,), np.float64
    yield own["_rows"], (PROTECTED_ROWS, 3), np.float64
    yield own["_packed"], (MOST_PACKED * HEARD.size,), np.uint8
    yield listed, (max(len(listed), MOST_PACKED), 4), np.int64


def _is_array(value: object, shape: tuple[int, ...], kind: DTypeLike) -> bool:
    return isinstance(value, np.ndarray) and value.shape == shape and value.dtype == kind and value.flags.carray


def _is_inverse(index_of: Integers, table_index: Integers) -> bool:
    """Whether the table names for every anchor of the state its index, and for no other an index."""
    if not ((table_index >= 0) & (table_index < len(index_of))).all():
        return False
    expected = np.full(len(index_of), -1)
    expected[table_index] = np.arange(len(table_index))
    return bool((index_of == expected).all() and (expected >= 0).sum() == len(table_index))
