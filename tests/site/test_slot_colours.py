"""Slots that anchors share: never two near ones, and not many more slots than a search would find."""

import math
from itertools import pairwise

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from skyless.site.grid import grid_site
from skyless.site.model import UnplacedAnchor
from skyless.site.near import pairs_within
from skyless.site.slot_colours import SlotShortageError, slot_colours, with_slots


def square(width_m, depth_m, spacing_m, jitter_m=0.0, seed=1):
    x, y = np.arange(round(width_m / spacing_m)), np.arange(round(depth_m / spacing_m))
    points = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1).reshape(-1, 2) * spacing_m
    points = points + np.random.default_rng(seed).uniform(-jitter_m, jitter_m, points.shape)
    return np.column_stack([points, np.full(len(points), 4.0)])


def conflicts(points, slots, reuse_m):
    near = pairs_within(points, reuse_m - 1e-6)
    return sum(int((slots[one] == slots[other]).sum()) for one, other, _ in near)


TABU = [(15, 47, 15), (15, 62, 24), (15, 78, 36), (15, 93, 48), (15, 124, 81), (7, 62, 91), (7, 93, 193)]
"""Spacing, distance, and the slots that a tabu search found for 10⁴ anchors."""


@pytest.mark.parametrize(("spacing_m", "reuse_m", "tabu"), TABU)
def test_ten_thousand_anchors(spacing_m, reuse_m, tabu):
    points = square(*((2000, 1125) if spacing_m == 15 else (1000, 500)), spacing_m)
    slots = slot_colours(points, reuse_m)
    assert conflicts(points, slots, reuse_m) == 0
    assert slots.max() + 1 <= 1.1 * tabu
    assert set(slots.tolist()) == set(range(slots.max() + 1))


@given(st.integers(0, 2**32 - 1), st.integers(0, 80), st.floats(0.5, 40.0), st.booleans())
def test_no_two_near_anchors_share_a_slot(seed, count, reuse_m, on_a_lattice):
    rng = np.random.default_rng(seed)
    points = rng.uniform(-20.0, 20.0, (count, 3)).round(0 if on_a_lattice else 3)
    pairs = [tuple(pair) for pair in rng.integers(0, max(count, 1), (count, 2)).tolist()]
    slots = slot_colours(points, reuse_m, pairs)
    assert slots.shape == (count,)
    assert conflicts(points, slots, reuse_m) == 0
    assert all(slots[one] != slots[other] for one, other in pairs if one != other)
    if count:
        assert set(slots.tolist()) == set(range(slots.max() + 1))


@pytest.mark.parametrize("reuse_m", [0.5, 3.0, 3.1, 10.0, 29.9])
def test_a_line_needs_as_many_as_fit_within_the_distance(reuse_m):
    """Anchors 3 m apart: k neighbours nearer than D lie in a row, so k + 1 are needed, and are enough."""
    points = np.column_stack([np.arange(50) * 3.0, np.zeros(50), np.zeros(50)])
    slots = slot_colours(np.random.default_rng(3).permutation(points), reuse_m)
    assert slots.max() + 1 == math.ceil(reuse_m / 3.0)


def test_anchors_all_near_each_other_need_one_slot_each():
    assert sorted(slot_colours(square(60, 60, 15), 78.0)) == list(range(16))


def test_neighbours_at_exactly_the_distance_may_share():
    points = np.array([[0.1, 0.0, 0.0], [46.9, 62.4, 0.0]])  # 78 m apart, but for the rounding
    assert slot_colours(points, 78.0).tolist() == [0, 0]
    assert slot_colours(points, 78.1).tolist() == [0, 1]


def test_slots_of_a_site():
    site = grid_site(300.0, 150.0, 15.0, 4.0)
    ids = [anchor.id for anchor in site.anchors]
    far = [(a, b) for a, b in pairwise(ids[::40])]
    site = msgspec.structs.replace(site, unplaced=(UnplacedAnchor(5000), UnplacedAnchor(5001)))
    coloured = with_slots(site, [*far, (5000, 1), (7777, 1)])
    slots = {anchor.id: anchor.slot for anchor in coloured.all_anchors}
    assert all(slots[one] != slots[other] for one, other in far)
    assert (
        sorted(slots.values())[-2:] == [slots[5000], slots[5001]] == [coloured.schedule.slots - 2 + k for k in (0, 1)]
    )


def test_too_many_slots():
    with pytest.raises(SlotShortageError, match=r"282 slots .*schedule\.reuse_m, 120 m.* at most 255"):
        with_slots(msgspec.structs.replace(
            (site := grid_site(140.0, 140.0, 7.0, 4.0)),
            schedule=msgspec.structs.replace(site.schedule, reuse_m=120.0),
        ))  # fmt: skip
