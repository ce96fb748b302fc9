from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from skyless.core.air.almanac import AccuracyPage, NoisePage, SitePage
from skyless.core.air.beacon import Beacon, StatedPosition
from skyless.core.air.local_almanac import (
    MAX_ISSUE_PAGES,
    MAX_ISSUES,
    MAX_POSITIONS,
    PRESENT_TICKS,
    LocalAlmanac,
    site_issue,
    site_page_for,
    site_pages_of,
)
from skyless.core.site import GeoreferenceSite
from skyless.core.ticks import from_seconds
from skyless.sim.lab import lab_site

SITE = replace(lab_site(), schedule=replace(lab_site().schedule, mode="free"))
PAGES = site_pages_of(SITE)
ISSUE = site_issue(PAGES)
STEP = from_seconds(0.005)


HERE = StatedPosition(1.0, 2.0, 3.0)


def beacon(anchor, page=None, issue=ISSUE, position=HERE):
    return Beacon(1, anchor, 0, 0, issue, 0x20, position, (), 0, page)


def rotation(count, anchors=(1, 2, 3), pages=PAGES):
    """Beacons of some anchors, one after the other, with the pages of their turns."""
    issue = site_issue(pages)
    for n in range(count):
        anchor = anchors[n % len(anchors)]
        yield beacon(anchor, site_page_for(pages, n // len(anchors), anchor), issue)


def run(almanac, beacons, is_confirmed=True, start=0):
    return [almanac.on_beacon(one, start + n * STEP, is_confirmed) for n, one in enumerate(beacons)]


def test_pages_of_a_site_in_the_order_of_their_types():
    assert [type(page) for page in PAGES] == [NoisePage, AccuracyPage, SitePage]
    assert PAGES[-1].pages == 3
    earth = site_pages_of(replace(SITE, georeference=GeoreferenceSite(1.0, 2.0)))
    assert earth[-1].pages == len(earth) == 4


def test_three_anchors_make_the_pages_complete_in_two_rounds():
    almanac = LocalAlmanac()
    changes = run(almanac, rotation(9))
    assert changes.count(True) == 1
    assert changes.index(True) < 5
    assert (almanac.pages.noise, almanac.pages.accuracy, almanac.pages.site) == PAGES
    assert almanac.issue == ISSUE


def test_two_anchors_count_only_once_they_are_all_for_a_second():
    almanac = LocalAlmanac()
    before = int(PRESENT_TICKS / STEP)
    changes = run(almanac, rotation(before + 40, (1, 2)))
    assert not any(changes[:before])
    assert any(changes)


def test_anchors_that_nobody_has_received_take_no_part():
    almanac = LocalAlmanac()
    assert not any(run(almanac, rotation(60), is_confirmed=False))
    assert almanac.pages is None


def test_pages_of_a_minority_are_not_used():
    almanac = LocalAlmanac()
    false_pages = (*PAGES[:-1], replace(PAGES[-1], tag_height_m=17.0))
    mixed = [one for pair in zip(rotation(60), rotation(60, (8, 9), false_pages), strict=True) for one in pair]
    run(almanac, mixed)
    assert almanac.pages.site == PAGES[-1]


def test_a_page_that_does_not_fit_the_issue_is_passed_over():
    almanac = LocalAlmanac()
    false_page = replace(PAGES[-1], tag_height_m=17.0)
    mixed = [one for n, good in enumerate(rotation(60)) for one in (beacon(4 + n % 5, false_page), good)]
    run(almanac, mixed)
    assert almanac.pages.site == PAGES[-1]


def test_another_issue_of_the_majority_replaces_the_pages_once_they_are_complete():
    almanac = LocalAlmanac()
    run(almanac, rotation(12))
    changed = (replace(PAGES[0], rx_stamp_s=2e-10), *PAGES[1:])
    changes = run(almanac, rotation(12, pages=changed), start=from_seconds(1.0))
    assert changes.count(True) == 1
    assert almanac.pages.noise.rx_stamp_s == 2e-10


def test_a_position_is_used_at_once_and_another_one_when_it_comes_twice_in_a_row():
    almanac = LocalAlmanac()
    moved = StatedPosition(9.0, 2.0, 3.0, 0.05)
    run(almanac, [beacon(1)])
    first = almanac.position_m(1)
    run(almanac, [beacon(1, position=moved), beacon(1), beacon(1, position=moved)])
    assert almanac.position_m(1) is first
    run(almanac, [beacon(1, position=moved)])
    assert almanac.position_m(1).tolist() == [9.0, 2.0, 3.0]
    assert almanac.std_m(1) == 0.05


def test_an_anchor_without_a_position_has_none():
    almanac = LocalAlmanac()
    run(almanac, [beacon(1, position=None)])
    assert almanac.position_m(1) is None
    run(almanac, [beacon(1), beacon(1, position=None)])
    assert almanac.position_m(1) is not None


@given(
    st.lists(st.tuples(st.integers(0, 65535), st.integers(0, 65535), st.integers(0, 2), st.booleans()), max_size=300)
)
def test_memory_is_bounded_whatever_comes_and_a_state_goes_on_the_same(rows):
    almanac, again = LocalAlmanac(), LocalAlmanac()
    for n, (anchor, issue, page, is_confirmed) in enumerate(rows):
        height = replace(PAGES[-1], tag_height_m=float(n)) if page == 2 else PAGES[page]
        almanac.on_beacon(beacon(anchor, height, issue % 9), n * STEP, is_confirmed)
    state = almanac.state()
    assert len(state.anchors) <= MAX_POSITIONS
    assert len(state.collected) <= MAX_ISSUES * 3 * MAX_ISSUE_PAGES
    again.restore(state)
    assert again.state() == state


def test_the_issue_does_not_depend_on_the_order_of_the_pages():
    assert site_issue(reversed(PAGES)) == ISSUE
    assert site_issue((*PAGES[:-1], replace(PAGES[-1], tag_height_m=0.5))) != ISSUE


def test_strangers_do_not_displace_anchors_that_others_have_received():
    """Neither their positions nor the pages that they state, however many there are."""
    almanac, good = LocalAlmanac(), rotation(190)
    for n, one in enumerate(good):
        if n % 100 == 0:
            almanac.on_beacon(one, n * STEP, True)
        else:
            page = replace(PAGES[n % 2 * 2], **({"tag_height_m": float(n % 7)} if n % 2 else {"rx_stamp_s": n * 1e-12}))
            almanac.on_beacon(beacon(1000 + n % 90, page, ISSUE if n % 3 else n % 7), n * STEP, False)
    assert almanac.position_m(1) is not None
    assert any(one.issue == ISSUE for one in almanac.state().collected)
    run(almanac, rotation(9), start=from_seconds(2.0))
    assert almanac.pages is not None
    assert almanac.issue == ISSUE
    assert len(almanac.state().anchors) <= MAX_POSITIONS
