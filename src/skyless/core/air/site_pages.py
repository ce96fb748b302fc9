"""Protocol 2: which pages of those that beacons carry count, as the majority of the anchors states."""

from typing import Annotated, Final

from skyless.core.air.neighbours import Neighbours
from skyless.core.air.page_check import HEIGHT_FLAG_AT, NOISE_PAGE, PAGE_BYTES, SITE_PAGE
from skyless.core.native.records import Array, Byte, Bytes, Integers, Record, Ticks, record
from skyless.core.native.sizes import MAX_PAGES, MAX_SENDERS
from skyless.core.ticks import from_seconds

PRESENT_TICKS: Final = from_seconds(1.0)
"""Anchors received within this time take part in the majority."""

MIN_ANCHORS: Final = 3
"""With fewer no majority counts, unless that is all that a tag receives for ``PRESENT_TICKS``."""

NOISE_KIND, EARTH_KIND, ACCURACY_KIND, SITE_KIND = range(4)
"""The types of these pages on the air, from ``NOISE_PAGE`` on; that of the georeference may be missing."""
PAGE_KINDS: Final = 4
NO_ISSUE: Final = -1
NO_PAGE: Final = -1

SAME_PAGES, OTHER_PAGES, OTHER_SETTINGS = range(3)
"""What a beacon has changed; the last is a page that the filters' settings depend on."""

_MAX_TRIALS: Final = 256
_CRC_32: Final = 0xEDB88320
"""The polynomial of Ethernet's check sequence, its bits in reverse order."""
_ONES: Final = 0xFFFFFFFF


@record
class UsedPage(Record):
    """A page that is in use."""

    contents: Annotated[Array[Byte], PAGE_BYTES]
    """All zeros where there is none."""


@record
class CollectedPage(Record):
    """A page of an issue that is not complete yet."""

    issue: int
    support: int
    """How many of the anchors that have sent it others have received."""
    contents: Annotated[Array[Byte], PAGE_BYTES]
    sender_count: int
    senders: Annotated[Integers, MAX_SENDERS]


@record
class Choices(Record):
    """What there is for each page of an issue."""

    counts: Annotated[Integers, PAGE_KINDS]
    places: Annotated[Array[Integers], PAGE_KINDS, MAX_PAGES]
    """Where they stand in the table, those of most anchors first."""
    chosen: Annotated[Integers, PAGE_KINDS]


@record
class SitePages(Record):
    """What a tag has learned of what is common to a site.

    The pages count once a majority of the anchors received recently states their issue, and they fit it; those in use
    stay until all pages of another such issue are there.
    """

    issue: int = NO_ISSUE
    """Of the pages in use."""
    used: Annotated[Array[UsedPage], PAGE_KINDS]
    has_first: bool
    first_ticks: Ticks
    """When the first beacon was received."""
    count: int
    collected: Annotated[Array[CollectedPage], MAX_PAGES]


def note_page(p: SitePages, t: Neighbours, frame: Bytes, page_at: int, rx_ticks: Ticks) -> int:
    """Process the page at this place of the newest anchor's beacon, if it is not 0; whether others are in use then."""
    n = t.rows[t.row]
    if not p.has_first:
        p.has_first, p.first_ticks = True, rx_ticks
    if n.almanac_issue == p.issue:
        return SAME_PAGES
    if page_at > 0 and NOISE_PAGE <= frame[page_at] <= SITE_PAGE:
        _collect(p, t, frame, page_at)
    return _complete(p, t, n.almanac_issue) if _is_majority(p, t, n.almanac_issue, rx_ticks) else SAME_PAGES


def _collect(p: SitePages, t: Neighbours, frame: Bytes, page_at: int) -> None:
    """Note that the newest anchor has sent a page; where there are too many, one takes the place of the worst."""
    n, place = t.rows[t.row], 0
    while place < p.count and not (p.collected[place].issue == n.almanac_issue and _is_page(p, place, frame, page_at)):
        place += 1
    if place == p.count:
        if p.count == MAX_PAGES:
            place = _worst(p, t)
        p.count = max(p.count, place + 1)
        p.collected[place].issue, p.collected[place].sender_count = n.almanac_issue, 0
        for byte in range(PAGE_BYTES):
            p.collected[place].contents[byte] = frame[page_at + byte]
    one = p.collected[place]
    for sender in range(one.sender_count):
        if one.senders[sender] == n.anchor:
            return
    if one.sender_count < MAX_SENDERS:
        one.senders[one.sender_count] = n.anchor
        one.sender_count += 1


def _is_page(p: SitePages, place: int, frame: Bytes, page_at: int) -> bool:
    same = 0
    while same < PAGE_BYTES and p.collected[place].contents[same] == frame[page_at + same]:
        same += 1
    return same == PAGE_BYTES


def _worst(p: SitePages, t: Neighbours) -> int:
    """The page of the issue, and then with the senders, that fewest anchors support which others have received.

    Strangers are any number.
    """
    worst, least_issue, least = 0, 0, 0
    for place in range(p.count):
        one, of_issue = p.collected[place], 0
        for row in range(t.count):
            if t.rows[row].was_relayed and t.rows[row].almanac_issue == one.issue:
                of_issue += 1
        support = _supporters(one, t)
        if place == 0 or of_issue < least_issue or (of_issue == least_issue and support < least):
            worst, least_issue, least = place, of_issue, support
    return worst


def _supporters(one: CollectedPage, t: Neighbours) -> int:
    support = 0
    for row in range(t.count):
        for sender in range(one.sender_count):
            if t.rows[row].was_relayed and t.rows[row].anchor == one.senders[sender]:
                support += 1
    return support


def _is_majority(p: SitePages, t: Neighbours, issue: int, rx_ticks: Ticks) -> bool:
    """Whether most of the anchors that are there state this issue."""
    oldest, present, stating = rx_ticks - PRESENT_TICKS, 0, 0
    for row in range(t.count):
        n = t.rows[row]
        if n.was_relayed and n.rx_ticks > oldest:
            present += 1
            stating += 1 if n.almanac_issue == issue else 0
    is_enough = present >= MIN_ANCHORS or (present > 0 and p.first_ticks <= oldest)
    return is_enough and 2 * stating > present


def _complete(p: SitePages, t: Neighbours, issue: int) -> int:
    """Use the pages of an issue if they are all there; of several contents those of most anchors that fit it."""
    c, trials = Choices(), 1
    for place in range(p.count):
        if p.collected[place].issue == issue:
            p.collected[place].support = _supporters(p.collected[place], t)
            _add_choice(c, p, place)
    for kind in range(PAGE_KINDS):
        trials *= _options(c, kind)
    for trial in range(min(trials, _MAX_TRIALS)):
        rest, pages = trial, 0
        for kind in range(PAGE_KINDS):
            option = rest % _options(c, kind)
            rest //= _options(c, kind)
            c.chosen[kind] = c.places[kind][option] if option < c.counts[kind] else NO_PAGE
            pages += 1 if option < c.counts[kind] else 0
        if p.collected[c.chosen[SITE_KIND]].contents[1] == pages and _issue_of(p, c) == issue:
            return _use_chosen(p, c, issue)
    return SAME_PAGES


def _options(c: Choices, kind: int) -> int:
    """How many there are for a page; a site may have no georeference."""
    return c.counts[kind] + (1 if kind == EARTH_KIND else 0)


def _add_choice(c: Choices, p: SitePages, place: int) -> None:
    """Add a page to those of its type, behind those that more anchors support."""
    kind = p.collected[place].contents[0] - NOISE_PAGE
    index = c.counts[kind]
    while index > 0 and p.collected[c.places[kind][index - 1]].support < p.collected[place].support:
        c.places[kind][index] = c.places[kind][index - 1]
        index -= 1
    c.places[kind][index] = place
    c.counts[kind] += 1


def _issue_of(p: SitePages, c: Choices) -> int:
    """``site_issue`` of the pages that are chosen."""
    crc: Ticks = _ONES
    for kind in range(PAGE_KINDS):
        if c.chosen[kind] != NO_PAGE:
            for byte in range(PAGE_BYTES):
                crc = crc ^ p.collected[c.chosen[kind]].contents[byte]
                for _ in range(8):
                    crc = crc >> 1 ^ _CRC_32 * (crc & 1)
    crc = crc ^ _ONES
    return int((crc ^ crc >> 16) & 0xFFFF)


def _use_chosen(p: SitePages, c: Choices, issue: int) -> int:
    """Use the pages that are chosen."""
    outcome = OTHER_PAGES
    for kind in range(PAGE_KINDS):
        for byte in range(PAGE_BYTES):
            place = c.chosen[kind]
            value = p.collected[place].contents[byte] if place != NO_PAGE else 0
            is_setting = kind != EARTH_KIND and (kind != SITE_KIND or byte >= HEIGHT_FLAG_AT)
            if is_setting and value != p.used[kind].contents[byte]:
                outcome = OTHER_SETTINGS
            p.used[kind].contents[byte] = value
    p.issue, p.count = issue, 0
    return outcome
