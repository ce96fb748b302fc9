import pytest

from skyless.core.air.frame import HEARD
from skyless.core.tag.selection import (
    BETTER_DB,
    MAX_ANCHORS_IN_USE,
    MAX_KEPT,
    RELAYED_TICKS,
    AnchorSelection,
    fitting_relays,
    is_full,
)
from skyless.core.ticks import from_seconds, wrap


def relays(*anchors):
    return b"".join(HEARD.pack(anchor, 0, 0, 0) for anchor in anchors)


def test_a_relayed_reception_confirms_for_a_second():
    selection = AnchorSelection()
    selection.add_relays(relays(7, 8), 1000)
    assert selection.is_confirmed(7, 1000 + RELAYED_TICKS - 1)
    assert not selection.is_confirmed(7, 1000 + RELAYED_TICKS)
    assert not selection.is_confirmed(9, 1000)
    selection.forget_times()
    assert not selection.is_confirmed(7, 1001)


def test_the_weakest_leaves_for_one_that_is_stronger_by_3_db():
    selection = AnchorSelection()
    for anchor, power_dbm in ((1, -80.0), (2, -75.0), (3, -77.1), (4, -76.9)):
        selection.add_power(anchor, power_dbm)
    ranges_m = dict.fromkeys((1, 2), 10.0)
    assert selection.replaced_by(3, {**ranges_m, 3: 10.0}) is None
    assert selection.replaced_by(4, {**ranges_m, 4: 10.0}) == 1
    assert BETTER_DB == 3.0


def test_where_no_power_is_reported_the_farthest_leaves_for_a_nearer_one():
    selection = AnchorSelection()
    assert selection.replaced_by(3, {1: 10.0, 2: 30.0, 3: 20.0}) == 2
    assert selection.replaced_by(3, {1: 10.0, 2: 30.0, 3: 25.0}) is None


def test_powers_are_averaged_and_impossible_ones_passed_over():
    selection = AnchorSelection()
    selection.add_power(1, -80.0)
    selection.add_power(1, float("nan"))
    selection.add_power(1, -70.0)
    assert selection.power_dbm[1] == pytest.approx(-79.0)


@pytest.mark.parametrize(
    ("off_ticks", "fitting"), [(0, 2), (from_seconds(0.9e-6), 2), (from_seconds(3e-6), 0), (-from_seconds(1e-3), 0)]
)
def test_receptions_that_an_anchor_relays_show_whether_it_is_there(off_ticks, fitting):
    """It received anchors 1 to 3, 5, 10 and 20 ms before its own frame; the tag has another packet of anchor 3."""
    tx_ticks, rx_ticks, ages = (1 << 40) + 7, 5_000_000_000, [from_seconds(1e-3 * age) for age in (5, 10, 20)]
    stamps = [wrap(tx_ticks - age + off_ticks) for age in ages]
    packed = b"".join(HEARD.pack(n, 9, stamp & 0xFFFFFFFF, stamp >> 32) for n, stamp in enumerate(stamps, start=1))
    packets = {n: (9 if n < 3 else 8, rx_ticks - age) for n, age in enumerate(ages, start=1)}
    assert fitting_relays(packed, tx_ticks, rx_ticks, packets.get) == fitting


def test_memory_is_bounded():
    selection = AnchorSelection()
    for anchor in range(2000):
        selection.add_relays(relays(anchor), anchor)
        selection.add_power(anchor, -80.0)
    assert len(selection.relayed_ticks) == len(selection.power_dbm) == MAX_KEPT
    assert min(selection.relayed_ticks) == 2000 - MAX_KEPT


def test_full_with_24():
    assert not is_full(range(MAX_ANCHORS_IN_USE - 1))
    assert is_full(range(MAX_ANCHORS_IN_USE))
