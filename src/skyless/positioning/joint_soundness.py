"""Whether arrays of a joint filter from elsewhere are what its kernels, which check no bounds, count on."""

from typing import Final

import numpy as np

from skyless.positioning.fix_rows import PROTECTED_ROWS
from skyless.positioning.joint import JointFilter
from skyless.positioning.joint_state import (
    DIM,
    NOISE,
    NOISES,
    PLACES,
    SITE,
    SLOTS,
    TERMS,
    Integers,
    JointArrays,
    new_arrays,
)
from skyless.positioning.joint_step import MOST_PACKED, PACKET, Exchanged
from skyless.positioning.protection_levels import LEVELS, LIMITS

MOST: Final = 4096
"""Anchors, in view or in the table."""


def is_sound(joint: JointFilter) -> bool:
    """Shapes, kinds, counts and all that points from one array into another."""
    s = joint.arrays
    if joint.dim not in (2, 3) or not isinstance(s, JointArrays) or not all(isinstance(a, np.ndarray) for a in s):
        return False
    if s.slots.ndim != 2 or s.slot_of.ndim != 1 or s.settings.shape != (11,) or s.settings.dtype != np.float64:
        return False
    if s.settings[DIM] != joint.dim or not (0 < len(s.slots) <= MOST and len(s.slot_of) <= MOST):
        return False
    like = new_arrays(s.settings, len(s.slots), len(s.slot_of))
    alike = all(
        a.shape == b.shape and a.dtype == b.dtype and a.flags.c_contiguous for a, b in zip(s, like, strict=True)
    )
    return alike and _counts(s) and _exchanged(joint) and bool(0 <= vars(joint)["_anchors"] <= len(s.site_m))


def _exchanged(joint: JointFilter) -> bool:
    told, n = vars(joint)["_exchanged"], 2 * joint.dim
    if vars(joint)["_addresses"] is not None or not isinstance(told, Exchanged):
        return False
    if not isinstance(told.relays, np.ndarray) or told.relays.ndim != 2 or len(told.relays) < MOST_PACKED:
        return False
    integers = ((PACKET.size // 8,), (len(joint.arrays.site_m),), (len(told.relays), 4))
    shapes = (*integers, (1, 3), (n,), (n, n), (PROTECTED_ROWS, 3), (LIMITS,), (LEVELS,))
    kinds = (np.int64,) * 3 + (np.float64,) * 6
    return all(_is_array(*one) for one in zip(told, shapes, kinds, strict=True))


def _is_array(value: object, shape: tuple[int, ...], kind: type) -> bool:
    return isinstance(value, np.ndarray) and value.shape == shape and value.dtype == kind and value.flags.c_contiguous


def _counts(s: JointArrays) -> bool:
    slots, noises = int(s.counts[SLOTS]), int(s.counts[NOISES])
    if not (0 <= slots <= len(s.slots) and 0 <= noises <= slots):
        return False
    if s.counts[TERMS] != 0 or not 0 <= s.counts[PLACES] <= len(s.h):
        return False
    used = s.slots[:slots]
    return _inverse(s.slot_of, used[:, SITE], slots) and _one_each(used[:, NOISE], noises)


def _inverse(slot_of: Integers, sites: Integers, slots: int) -> bool:
    """Whether the table names for every slot the anchor that has it, and for no other anchor a slot."""
    if not ((sites >= 0) & (sites < len(slot_of))).all() or len(set(sites.tolist())) != slots:
        return False
    expected = np.full(len(slot_of), -1)
    expected[sites] = np.arange(slots)
    return bool((slot_of == expected).all())


def _one_each(places: Integers, noises: int) -> bool:
    """Whether the noises 0 … n − 1 are each named once, and nothing else but −1."""
    return sorted(place for place in places.tolist() if place != -1) == list(range(noises))
