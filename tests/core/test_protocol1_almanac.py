"""The almanac of protocol 1: its pages and issue, in which slot each is sent, and how a tag puts them together."""

import itertools

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import asdict, replace

from skyless.core.air.almanac import AccuracyPage, AnchorPage, GeoreferencePage, NoisePage, SchedulePage
from skyless.core.air.site_pages import decode_page, encode_page
from skyless.core.protocol1.almanac import AlmanacAssembly, almanac_issue, page_for, pages_of
from skyless.core.site import EXACT, AccuracySite, AnchorSite, GeoreferenceSite, NoiseSite, ScheduleSite, Site, TagsSite
from skyless.site.file.check import SITE_LIMITS


def site(anchors=7, **changes):
    nodes = tuple(AnchorSite(number, 0.1 * number, 1.0, 2.5) for number in range(1, anchors + 1))
    return Site("lab", 1, 1, nodes, **changes)


def some_pages(count):
    return tuple(AnchorPage(number, 0.0, 0.0, 0.0, 0) for number in range(count))


def receptions_until_complete(pages, receptions):
    """How many (superframe, slot) it takes until every page was heard."""
    missing = set(pages)
    for count, (superframe, slot) in enumerate(receptions, 1):
        missing.discard(page_for(pages, superframe, slot))
        if not missing:
            return count
    return None


def prime_from(count):
    return next(number for number in itertools.count(max(count, 2)) if all(number % d for d in range(2, number)))


def test_pages_of_a_site():
    earth = GeoreferenceSite(52.0, 4.0, 3.0, -90.0)
    pages = pages_of(site(2, georeference=earth, tags=TagsSite(height_m=1.2), schedule=ScheduleSite(slots=5)))
    assert pages == (
        SchedulePage(2**27, 5, 1, 1, 2, 1.2),
        NoisePage(pytest.approx(100e-12), pytest.approx(100e-12), 2e-11, 1e-9),
        AccuracyPage(0.02, 0.03, 0.05, 0.005, 1.0, 100.0),
        AnchorPage(1, 0.1, 1.0, 2.5, 0),
        AnchorPage(2, 0.2, 1.0, 2.5, 1),
        GeoreferencePage(52.0, 4.0, 3.0, 270.0),
    )
    assert len(pages_of(site(2))) == 5


@given(st.integers(1, 60), st.integers(0, 254), st.integers(0, 2**32 - 500), st.integers(1, 500))
def test_one_slot_brings_every_page_whatever_the_duty_cycle(count, slot, start, every):
    pages = some_pages(count)
    heard = ((start + every * number, slot) for number in range(2 * count + 2))
    positions = receptions_until_complete(pages, ((start + number, slot) for number in range(10 * count + 2)))
    # The rotation's length is a prime below twice the number of pages (Bertrand); 2 at least.
    assert positions <= max(2, 2 * count - 1)
    period = prime_from(count)
    if every % period:
        assert receptions_until_complete(pages, heard) <= period


@given(st.integers(1, 255), st.integers(0, 2**32 - 1))
def test_slots_of_one_superframe_bring_different_pages(count, superframe):
    pages = some_pages(count)
    carried = [page_for(pages, superframe, slot) for slot in range(count)]
    # No page twice, but for those that fill the rotation up to a prime.
    assert len(set(carried)) >= count - (prime_from(count) - count)


@pytest.mark.parametrize("anchors", range(3, 33))
@pytest.mark.parametrize(("earth", "superframes"), [(None, 3), (GeoreferenceSite(52.0, 4.0), 4)])
def test_all_anchors_heard_fill_the_almanac_in_a_few_superframes(anchors, earth, superframes):
    pages = pages_of(site(anchors, georeference=earth))
    for start in range(50):
        heard = ((start + number // anchors, number % anchors) for number in range(superframes * anchors))
        assert receptions_until_complete(pages, heard) is not None


@pytest.mark.parametrize("end", ["low", "high"])
def test_whatever_a_site_file_may_say_fits_the_pages(end):
    def at_end(*keys):
        return [getattr(SITE_LIMITS[key], end) for key in keys]

    places = at_end("anchors.id", "anchors.x_m", "anchors.y_m", "anchors.z_m")
    noise = at_end("noise.tx_stamp_ps", "noise.rx_stamp_ps", "noise.white_fm", "noise.random_walk_fm")
    accuracy = at_end(*(f"accuracy.{field}" for field in AccuracySite.__struct_fields__))
    earth = at_end(*(f"georeference.{field}" for field in GeoreferenceSite.__struct_fields__))
    extreme = Site(
        "lab",
        *at_end("id", "master"),
        (AnchorSite(*places, *at_end("anchors.slot")),),
        ScheduleSite(slots=255),
        NoiseSite(*noise),
        TagsSite(*at_end("tags.height_m")),
        AccuracySite(*accuracy),
        georeference=GeoreferenceSite(*earth),
    )
    for page in pages_of(extreme):
        assert type(decode_page(encode_page(page))) is type(page)


def test_accuracy_of_a_site_file_comes_back_as_it_was():
    for accuracy in (AccuracySite(), EXACT, AccuracySite(0.0153, 0.1, 0.0007, 1.2345, 0.35, 12.3)):
        (page,) = (page for page in pages_of(site(accuracy=accuracy)) if isinstance(page, AccuracyPage))
        heard = decode_page(encode_page(page))
        assert AccuracySite(**asdict(heard)) == accuracy


def test_issue_is_the_same_for_the_same_contents():
    quantised = tuple(decode_page(encode_page(page)) for page in pages_of(site()))
    assert almanac_issue(quantised) == almanac_issue(pages_of(site()))
    assert 0 <= almanac_issue(pages_of(site())) <= 255


def test_issue_depends_on_every_page():
    pages = pages_of(site(anchors=9))
    issue = almanac_issue(pages)
    for at, page in enumerate(pages):
        field = next(name for name in ("z_m", "slots", "survey_std_m", "white_fm") if hasattr(page, name))
        moved = replace(page, **{field: getattr(page, field) * 2})
        assert almanac_issue((*pages[:at], moved, *pages[at + 1 :])) != issue
    assert almanac_issue(pages[::-1]) != issue


def test_issue_spreads_over_all_values():
    # 2000 almanacs over 256 values: chi-squared of 255 degrees of freedom, 5 sigma.
    counts = [0] * 256
    for number in range(2000):
        counts[almanac_issue((AnchorPage(1, number / 1000, 0.0, 0.0, 0),))] += 1
    chi_squared = sum((count - 2000 / 256) ** 2 / (2000 / 256) for count in counts)
    assert chi_squared < 255 + 5 * (2 * 255) ** 0.5


SCHEDULE = SchedulePage(2**27, 3, 1, 1, 3, 1.2)
NOISE = NoisePage(1e-10, 1e-10, 2e-11, 1e-9)
ROOM = AccuracyPage(**asdict(AccuracySite()))
SURVEYED = AccuracyPage(0.001, 0.02, 0.0, 0.03, 1.0, 50.0)
EARTH = GeoreferencePage(52.0, 4.0, 3.0, 90.0)
ANCHORS = tuple(AnchorPage(number, float(number), 0.5, 2.5, number - 1) for number in (1, 2, 3))
PAGES = (SCHEDULE, NOISE, *ANCHORS)
MOVED = replace(ANCHORS[1], x_m=9.0)


@pytest.fixture
def almanac():
    """Filled under issue 7."""
    almanac = AlmanacAssembly()
    for page in PAGES:
        almanac.add_page(7, page)
    return almanac


def test_fills_page_by_page():
    almanac = AlmanacAssembly()
    assert (almanac.issue, almanac.anchors_m, almanac.schedule, almanac.noise) == (None, {}, None, None)
    assert almanac.georeference is None
    changes = []
    for page in (None, *ANCHORS, SCHEDULE, NOISE):
        assert not almanac.complete
        changes.append(almanac.add_page(7, page))
    assert changes == [False, True, True, True, True, True]
    assert almanac.complete
    assert almanac.issue == 7
    assert almanac.anchors_m == {1: (1.0, 0.5, 2.5), 2: (2.0, 0.5, 2.5), 3: (3.0, 0.5, 2.5)}
    assert (almanac.schedule, almanac.noise, almanac.georeference) == (SCHEDULE, NOISE, None)
    assert almanac.add_page(7, EARTH)
    assert almanac.georeference == EARTH


def test_the_known_is_no_news(almanac):
    held = almanac.anchors_m
    assert not any(almanac.add_page(7, page) for page in (*PAGES, None))
    assert almanac.anchors_m is held


def test_one_corrupt_issue_cannot_wipe_the_book(almanac):
    for corrupt_issue in (8, 9, 10, 8, 8 ^ 255):
        assert not almanac.add_page(corrupt_issue, MOVED)
        assert almanac.complete
        assert not almanac.add_page(7, NOISE)
    assert not almanac.add_page(8, None)
    assert not almanac.add_page(9, None)  # those in a row must agree
    assert almanac.issue == 7
    assert almanac.anchors_m[2] == (2.0, 0.5, 2.5)


def test_new_issue_in_two_frames_starts_a_new_book(almanac):
    almanac.add_page(7, EARTH)
    assert not almanac.add_page(8, MOVED)
    assert almanac.add_page(8, ANCHORS[0])
    assert almanac.issue == 8
    assert almanac.anchors_m == {1: (1.0, 0.5, 2.5), 2: (9.0, 0.5, 2.5)}
    assert (almanac.schedule, almanac.noise, almanac.georeference, almanac.complete) == (None, None, None, False)


def test_only_a_page_heard_twice_replaces_the_first(almanac):
    held = almanac.anchors_m
    assert not almanac.add_page(7, MOVED)
    assert not almanac.add_page(7, ANCHORS[1])  # as it was: the one before was corrupt
    assert not almanac.add_page(7, MOVED)
    assert almanac.anchors_m[2] == (2.0, 0.5, 2.5)
    assert not almanac.add_page(7, ANCHORS[0])
    assert almanac.add_page(7, MOVED)
    assert almanac.anchors_m[2] == (9.0, 0.5, 2.5)
    assert held[2] == (2.0, 0.5, 2.5)


def test_book_that_began_with_a_corrupt_frame_heals():
    almanac = AlmanacAssembly()
    almanac.add_page(99, MOVED)
    for _ in range(2):
        for page in PAGES:
            almanac.add_page(7, page)
    assert almanac.complete
    assert almanac.anchors_m[2] == (2.0, 0.5, 2.5)


def test_accuracy_is_the_rooms_until_it_is_heard(almanac):
    assert almanac.complete
    assert AlmanacAssembly().accuracy == almanac.accuracy == ROOM
    assert almanac.add_page(7, SURVEYED)
    assert almanac.accuracy == SURVEYED
    assert not almanac.add_page(7, SURVEYED)
    assert not almanac.add_page(7, ROOM)
    assert almanac.accuracy == SURVEYED
    assert almanac.add_page(7, ROOM)
    assert almanac.accuracy == ROOM


def test_accuracy_goes_with_its_issue(almanac):
    almanac.add_page(7, SURVEYED)
    assert not almanac.add_page(8, None)
    assert almanac.add_page(8, None)  # an issue may come without pages
    assert (almanac.accuracy, almanac.anchors_m) == (ROOM, {})
