import msgspec
import pytest

from skyless.air.almanac import AccuracyPage, AnchorPage, GeoreferencePage, NoisePage, SchedulePage
from skyless.site.almanac_pages import AlmanacAssembly
from skyless.site.model import AccuracySite

SCHEDULE = SchedulePage(2**27, 3, 1, 1, 3, 1.2)
NOISE = NoisePage(1e-10, 1e-10, 2e-11, 1e-9)
ROOM = AccuracyPage(**msgspec.structs.asdict(AccuracySite()))
SURVEYED = AccuracyPage(0.001, 0.02, 0.0, 0.03, 1.0, 50.0)
EARTH = GeoreferencePage(52.0, 4.0, 3.0, 90.0)
ANCHORS = tuple(AnchorPage(number, float(number), 0.5, 2.5, number - 1) for number in (1, 2, 3))
PAGES = (SCHEDULE, NOISE, *ANCHORS)
MOVED = msgspec.structs.replace(ANCHORS[1], x_m=9.0)


@pytest.fixture
def book():
    """A book filled under issue 7."""
    book = AlmanacAssembly()
    for page in PAGES:
        book.hear(7, page)
    return book


def test_fills_page_by_page():
    book = AlmanacAssembly()
    assert (book.issue, book.anchors_m, book.schedule, book.noise, book.georeference) == (None, {}, None, None, None)
    changes = []
    for page in (None, *ANCHORS, SCHEDULE, NOISE):
        assert not book.complete
        changes.append(book.hear(7, page))
    assert changes == [False, True, True, True, True, True]
    assert book.complete
    assert book.issue == 7
    assert book.anchors_m == {1: (1.0, 0.5, 2.5), 2: (2.0, 0.5, 2.5), 3: (3.0, 0.5, 2.5)}
    assert (book.schedule, book.noise, book.georeference) == (SCHEDULE, NOISE, None)
    assert book.hear(7, EARTH)
    assert book.georeference == EARTH


def test_the_known_is_no_news(book):
    held = book.anchors_m
    assert not any(book.hear(7, page) for page in (*PAGES, None))
    assert book.anchors_m is held


def test_one_corrupt_issue_cannot_wipe_the_book(book):
    for corrupt_issue in (8, 9, 10, 8, 8 ^ 255):
        assert not book.hear(corrupt_issue, MOVED)
        assert book.complete
        assert not book.hear(7, NOISE)
    assert book.anchors_m[2] == (2.0, 0.5, 2.5)


def test_corrupt_issues_in_a_row_must_agree(book):
    assert not book.hear(8, None)
    assert not book.hear(9, None)
    assert book.issue == 7


def test_new_issue_in_two_frames_starts_a_new_book(book):
    book.hear(7, EARTH)
    assert not book.hear(8, MOVED)
    assert book.hear(8, ANCHORS[0])
    assert book.issue == 8
    assert book.anchors_m == {1: (1.0, 0.5, 2.5), 2: (9.0, 0.5, 2.5)}
    assert (book.schedule, book.noise, book.georeference, book.complete) == (None, None, None, False)


def test_new_issue_may_come_without_pages(book):
    book.hear(8, None)
    assert book.hear(8, None)
    assert book.anchors_m == {}


def test_one_corrupt_page_does_not_move_an_anchor(book):
    assert not book.hear(7, MOVED)
    assert not book.hear(7, ANCHORS[1])
    assert not book.hear(7, MOVED)
    assert book.anchors_m[2] == (2.0, 0.5, 2.5)


def test_page_heard_twice_replaces_the_first(book):
    held = book.anchors_m
    assert not book.hear(7, MOVED)
    assert not book.hear(7, ANCHORS[0])
    assert book.hear(7, MOVED)
    assert book.anchors_m[2] == (9.0, 0.5, 2.5)
    assert held[2] == (2.0, 0.5, 2.5)


def test_book_that_began_with_a_corrupt_frame_heals():
    book = AlmanacAssembly()
    book.hear(99, MOVED)
    for _ in range(2):
        for page in PAGES:
            book.hear(7, page)
    assert book.complete
    assert book.anchors_m[2] == (2.0, 0.5, 2.5)


def test_accuracy_is_the_rooms_until_it_is_heard(book):
    assert book.complete
    assert AlmanacAssembly().accuracy == book.accuracy == ROOM
    assert book.hear(7, SURVEYED)
    assert book.accuracy == SURVEYED
    assert not book.hear(7, SURVEYED)


def test_accuracy_changes_as_other_pages_do(book):
    book.hear(7, SURVEYED)
    assert not book.hear(7, ROOM)
    assert book.accuracy == SURVEYED
    assert book.hear(7, ROOM)
    assert book.accuracy == ROOM


def test_accuracy_goes_with_its_issue(book):
    book.hear(7, SURVEYED)
    book.hear(8, None)
    book.hear(8, None)
    assert book.accuracy == ROOM
