import msgspec
import pytest

from skyless.core.air.almanac import AccuracyPage, AnchorPage, GeoreferencePage, NoisePage, SchedulePage
from skyless.core.protocol1.almanac import AlmanacAssembly
from skyless.core.site import AccuracySite

SCHEDULE = SchedulePage(2**27, 3, 1, 1, 3, 1.2)
NOISE = NoisePage(1e-10, 1e-10, 2e-11, 1e-9)
ROOM = AccuracyPage(**msgspec.structs.asdict(AccuracySite()))
SURVEYED = AccuracyPage(0.001, 0.02, 0.0, 0.03, 1.0, 50.0)
EARTH = GeoreferencePage(52.0, 4.0, 3.0, 90.0)
ANCHORS = tuple(AnchorPage(number, float(number), 0.5, 2.5, number - 1) for number in (1, 2, 3))
PAGES = (SCHEDULE, NOISE, *ANCHORS)
MOVED = msgspec.structs.replace(ANCHORS[1], x_m=9.0)


@pytest.fixture
def almanac():
    """A almanac filled under issue 7."""
    almanac = AlmanacAssembly()
    for page in PAGES:
        almanac.add_page(7, page)
    return almanac


def test_fills_page_by_page():
    almanac = AlmanacAssembly()
    assert (almanac.issue, almanac.anchors_m, almanac.schedule, almanac.noise, almanac.georeference) == (
        None,
        {},
        None,
        None,
        None,
    )
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
    assert almanac.anchors_m[2] == (2.0, 0.5, 2.5)


def test_corrupt_issues_in_a_row_must_agree(almanac):
    assert not almanac.add_page(8, None)
    assert not almanac.add_page(9, None)
    assert almanac.issue == 7


def test_new_issue_in_two_frames_starts_a_new_book(almanac):
    almanac.add_page(7, EARTH)
    assert not almanac.add_page(8, MOVED)
    assert almanac.add_page(8, ANCHORS[0])
    assert almanac.issue == 8
    assert almanac.anchors_m == {1: (1.0, 0.5, 2.5), 2: (9.0, 0.5, 2.5)}
    assert (almanac.schedule, almanac.noise, almanac.georeference, almanac.complete) == (None, None, None, False)


def test_new_issue_may_come_without_pages(almanac):
    almanac.add_page(8, None)
    assert almanac.add_page(8, None)
    assert almanac.anchors_m == {}


def test_one_corrupt_page_does_not_move_an_anchor(almanac):
    assert not almanac.add_page(7, MOVED)
    assert not almanac.add_page(7, ANCHORS[1])
    assert not almanac.add_page(7, MOVED)
    assert almanac.anchors_m[2] == (2.0, 0.5, 2.5)


def test_page_heard_twice_replaces_the_first(almanac):
    held = almanac.anchors_m
    assert not almanac.add_page(7, MOVED)
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


def test_accuracy_changes_as_other_pages_do(almanac):
    almanac.add_page(7, SURVEYED)
    assert not almanac.add_page(7, ROOM)
    assert almanac.accuracy == SURVEYED
    assert almanac.add_page(7, ROOM)
    assert almanac.accuracy == ROOM


def test_accuracy_goes_with_its_issue(almanac):
    almanac.add_page(7, SURVEYED)
    almanac.add_page(8, None)
    almanac.add_page(8, None)
    assert almanac.accuracy == ROOM
