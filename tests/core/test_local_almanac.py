import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import asdict, replace

from skyless.core.air import site_pages
from skyless.core.air.almanac import AccuracyPage, NoisePage, SitePage
from skyless.core.air.beacon import Beacon, StatedPosition, fields_of
from skyless.core.air.neighbours import PRESENT_TICKS, Neighbours, find_neighbour, neighbour_of
from skyless.core.clock_filter import clock_noise, stamp_variances_m2
from skyless.core.estimator.settings import EstimatorSettings
from skyless.core.native.records import MAX_NEIGHBOURS, MAX_PAGES
from skyless.core.pages import site_page_for, site_pages_of
from skyless.core.site import GeoreferenceSite
from skyless.core.tag.hearing import keep_place
from skyless.core.tag.joint import read_accuracy
from skyless.core.ticks import from_seconds
from skyless.sim.lab import lab_site

SITE = replace(lab_site(), schedule=replace(lab_site().schedule, mode="free"))
PAGES = tuple(site_pages.decode_page(site_pages.encode_page(one)) for one in site_pages_of(SITE))
ISSUE = site_pages.site_issue(PAGES)
STEP = from_seconds(0.005)


HERE = StatedPosition(1.0, 2.0, 3.0)


def beacon(anchor, page=None, issue=ISSUE, position=HERE):
    return Beacon(1, anchor, 0, 0, issue, 0x20, position, (), 0, page)


def rotation(count, anchors=(1, 2, 3), pages=PAGES):
    """Beacons of some anchors, one after the other, with the pages of their turns."""
    issue = site_pages.site_issue(pages)
    for n in range(count):
        anchor = anchors[n % len(anchors)]
        yield beacon(anchor, site_page_for(pages, n // len(anchors), anchor), issue)


class Tag:
    """A table of anchors, as a tag keeps it, and the almanac over it."""

    def __init__(self):
        self.neighbours = Neighbours()
        self.pages = site_pages.SitePages()
        self.almanac = site_pages.LocalAlmanac(self.pages, self.neighbours)

    def hear(self, one, rx_ticks, is_confirmed=True):
        t, fields = self.neighbours, fields_of(one)
        t.row = neighbour_of(t, one.anchor, rx_ticks)
        n = t.rows[t.row]
        n.frames, n.rx_ticks, n.was_relayed = min(n.frames + 1, 2), rx_ticks, is_confirmed
        n.almanac_issue, n.period_code = one.almanac_issue, one.period_code
        if is_confirmed:
            n.relayed_ticks = rx_ticks
        if fields.has_place:
            keep_place(n, fields.place)
        frame = b"" if one.page is None else b"\0" + site_pages.encode_page(one.page)
        return site_pages.note_page(self.pages, t, frame, 1 if frame else 0, rx_ticks) != site_pages.SAME_PAGES

    def run(self, beacons, is_confirmed=True, start=0):
        return [self.hear(one, start + n * STEP, is_confirmed) for n, one in enumerate(beacons)]


@pytest.fixture
def tag():
    return Tag()


def test_pages_of_a_site_in_the_order_of_their_types():
    assert [type(page) for page in PAGES] == [NoisePage, AccuracyPage, SitePage]
    assert PAGES[-1].pages == 3
    earth = site_pages_of(replace(SITE, georeference=GeoreferenceSite(1.0, 2.0)))
    assert earth[-1].pages == len(earth) == 4


def test_three_anchors_make_the_pages_complete_in_two_rounds(tag):
    changes = tag.run(rotation(9))
    assert changes.count(True) == 1
    assert changes.index(True) < 5
    assert (tag.almanac.pages.noise, tag.almanac.pages.accuracy, tag.almanac.pages.site) == PAGES
    assert tag.almanac.issue == ISSUE


def test_two_anchors_count_only_once_they_are_all_for_a_second(tag):
    before = int(PRESENT_TICKS / STEP)
    changes = tag.run(rotation(before + 40, (1, 2)))
    assert not any(changes[:before])
    assert any(changes)


def test_anchors_that_nobody_has_received_take_no_part(tag):
    assert not any(tag.run(rotation(60), is_confirmed=False))
    assert tag.almanac.pages is None


FALSE_PAGE = replace(PAGES[-1], tag_height_m=17.0)


@pytest.mark.parametrize(
    "false",
    [
        list(rotation(60, (8, 9), (*PAGES[:-1], FALSE_PAGE))),  # a minority
        [beacon(4 + n % 5, FALSE_PAGE) for n in range(60)],  # it does not fit the issue
    ],
)
def test_false_pages_are_passed_over(tag, false):
    tag.run([one for pair in zip(false, rotation(60), strict=True) for one in pair])
    assert tag.almanac.pages.site == PAGES[-1]


def test_another_issue_of_the_majority_replaces_the_pages_once_they_are_complete(tag):
    tag.run(rotation(12))
    changed = (replace(PAGES[0], rx_stamp_s=2e-10), *PAGES[1:])
    changes = tag.run(rotation(12, pages=changed), start=from_seconds(1.0))
    assert changes.count(True) == 1
    assert tag.almanac.pages.noise.rx_stamp_s == pytest.approx(2e-10)


def test_a_position_is_used_at_once_and_another_one_when_it_comes_twice_in_a_row(tag):
    moved = StatedPosition(9.0, 2.0, 3.0, 0.05)
    tag.run([beacon(1), beacon(1, position=moved), beacon(1), beacon(1, position=moved)])
    assert tag.almanac.points_m() == {1: (1.0, 2.0, 3.0)}
    tag.run([beacon(1, position=moved)])
    assert tag.almanac.points_m() == {1: (9.0, 2.0, 3.0)}
    assert tag.neighbours.rows[tag.neighbours.row].place.std_mm == 50


def test_an_anchor_without_a_position_has_none(tag):
    tag.run([beacon(1, position=None)])
    assert tag.almanac.points_m() == {}
    tag.run([beacon(1), beacon(1, position=None)])
    assert tag.almanac.points_m() == {1: (1.0, 2.0, 3.0)}


@given(
    st.lists(st.tuples(st.integers(0, 65535), st.integers(0, 65535), st.integers(0, 2), st.booleans()), max_size=300)
)
def test_memory_is_bounded_whatever_comes(rows):
    tag = Tag()
    for n, (anchor, issue, page, is_confirmed) in enumerate(rows):
        height = replace(PAGES[-1], tag_height_m=float(n)) if page == 2 else PAGES[page]
        tag.hear(beacon(anchor, height, issue % 9), n * STEP, is_confirmed)
    assert tag.neighbours.count <= MAX_NEIGHBOURS
    assert tag.pages.count <= MAX_PAGES


def test_the_issue_does_not_depend_on_the_order_of_the_pages():
    assert site_pages.site_issue(reversed(PAGES)) == ISSUE
    assert site_pages.site_issue((*PAGES[:-1], replace(PAGES[-1], tag_height_m=0.5))) != ISSUE


@pytest.mark.site
def test_strangers_do_not_displace_anchors_that_others_have_received(tag):
    """Neither their positions nor the pages that they state, however many there are."""
    good = rotation(600)
    for n, one in enumerate(good):
        if n % 300 == 0:
            tag.hear(one, n * STEP // 5)
        else:
            page = replace(PAGES[n % 2 * 2], **({"tag_height_m": float(n % 7)} if n % 2 else {"rx_stamp_s": n * 1e-12}))
            tag.hear(beacon(1000 + n // 2, page, ISSUE if n % 3 else n % 7), n * STEP // 5, False)
    assert find_neighbour(tag.neighbours, 1) >= 0
    assert tag.neighbours.count == MAX_NEIGHBOURS
    assert any(one.issue == ISSUE for one in tag.pages.collected)
    tag.run(rotation(9), start=from_seconds(4.0))
    assert tag.almanac.pages is not None
    assert tag.almanac.issue == ISSUE


@given(
    st.lists(st.floats(0.0, site_pages.MAX_NOISE), min_size=4, max_size=4),
    st.lists(st.integers(1, 65535), min_size=6, max_size=6),
)
def test_settings_from_the_bytes_of_pages_are_those_from_their_figures(figures, steps):
    pages = site_pages.encode_page(NoisePage(*figures)), struct.pack("<B6H4x", 5, *steps)
    noise, accuracy = map(site_pages.decode_page, pages)
    expected = EstimatorSettings(**asdict(accuracy))
    expected.tx_variance_m2, expected.rx_variance_m2 = stamp_variances_m2(noise.tx_stamp_s, noise.rx_stamp_s)
    oscillator = clock_noise(noise.white_fm, noise.random_walk_fm)
    expected.white, expected.walk = oscillator.white / 2.0, oscillator.walk / 2.0  # of one clock
    found = EstimatorSettings()
    read_accuracy(found, *pages)
    assert bytes(found) == bytes(expected)
