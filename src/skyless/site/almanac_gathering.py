"""What a listener has gathered of a site's almanac."""

from collections.abc import Iterable
from typing import Annotated, Final

from msgspec import Meta, Struct
from msgspec.structs import asdict

from skyless.air.almanac import AccuracyPage, AnchorPage, GeoreferencePage, NoisePage, Page, SchedulePage
from skyless.air.malformed import Malformed
from skyless.air.page_codec import PAGE_BYTES, decode_page, encode_page
from skyless.site.model import AccuracySite

_SIGHTINGS: Final = 2
"""A frame corrupted on the air passes its FCS once in 65,536 times; the same error twice in a row is not expected."""

_MOST_ANCHORS: Final = 255
"""As many as a site can have; forged pages beyond that take no memory."""

_ASSUMED_ACCURACY: Final = AccuracyPage(**asdict(AccuracySite()))


_PageBytes = Annotated[bytes, Meta(min_length=PAGE_BYTES, max_length=PAGE_BYTES)]


class AlmanacState(Struct, frozen=True):
    """What an ``AlmanacAssembly`` has gathered, pages as they are on the air."""

    issue: int | None
    pages: tuple[_PageBytes, ...]
    doubted: tuple[_PageBytes, ...]
    rival_issue: int | None
    rival_frames: int
    rival_pages: tuple[_PageBytes, ...]


class AlmanacAssembly:
    """Gathers the pages of one site as its beacons bring them, page by page.

    What contradicts the book must be heard twice before it is believed. A new issue empties the book once two frames
    in a row carry it. A page that differs from the one held under the same issue replaces it once it was heard twice
    with nothing else for its place in between. So one corrupt frame that passed its FCS cannot do lasting harm.
    """

    def __init__(self) -> None:
        self._issue: int | None = None
        self._rival_issue: int | None = None
        self._rival_frames = 0
        self._rival_pages: list[Page] = []
        self._clear()

    def _clear(self) -> None:
        self._pages: dict[object, Page] = {}
        self._doubted: dict[object, Page] = {}
        self._anchors_m: dict[int, tuple[float, float, float]] = {}
        self._schedule: SchedulePage | None = None
        self._noise: NoisePage | None = None
        self._accuracy = _ASSUMED_ACCURACY
        self._georeference: GeoreferencePage | None = None

    def state(self) -> AlmanacState:
        """What was gathered."""
        held, doubted, rivals = (
            tuple(map(encode_page, pages))
            for pages in (self._pages.values(), self._doubted.values(), self._rival_pages)
        )
        return AlmanacState(self._issue, held, doubted, self._rival_issue, self._rival_frames, rivals)

    def restore(self, state: AlmanacState) -> None:
        """Continue from a state.

        Raises:
            ValueError: it holds something that is not a page.
        """
        self._clear()
        for page in _decoded(state.pages):
            self._enter(_place(page), page)
        self._doubted = {_place(page): page for page in _decoded(state.doubted)}
        self._issue, self._rival_issue, self._rival_frames = state.issue, state.rival_issue, state.rival_frames
        self._rival_pages = _decoded(state.rival_pages)

    @property
    def issue(self) -> int | None:
        """Issue of the almanac held, None before the first beacon."""
        return self._issue

    @property
    def anchors_m(self) -> dict[int, tuple[float, float, float]]:
        """Position of each anchor known so far; another dict whenever one changes, never changed in place."""
        return self._anchors_m

    @property
    def schedule(self) -> SchedulePage | None:
        """The superframe and the tags' height, once heard."""
        return self._schedule

    @property
    def noise(self) -> NoisePage | None:
        """The site's noise figures, once heard."""
        return self._noise

    @property
    def accuracy(self) -> AccuracyPage:
        """How good survey and ranges are; the defaults of ``AccuracySite`` until it is heard, for some sites never."""
        return self._accuracy

    @property
    def georeference(self) -> GeoreferencePage | None:
        """Where the site lies on the Earth, once heard; many sites send none."""
        return self._georeference

    def slot_of(self, anchor: int | None) -> int | None:
        """First slot of an anchor, once its page was heard."""
        page = self._pages.get(anchor)
        return page.slot if isinstance(page, AnchorPage) else None

    @property
    def complete(self) -> bool:
        """Whether schedule, noise and all anchors are known."""
        schedule = self._schedule
        return schedule is not None and self._noise is not None and len(self._anchors_m) >= schedule.anchors

    def hear(self, issue: int, page: Page | None) -> bool:
        """Take in the issue and the page (if any) of one beacon; return whether the book changed."""
        if issue != self._issue:
            if self._issue is not None:
                return self._hear_rival(issue, page)
            self._issue = issue
        self._rival_issue = None
        if page is None:
            return False
        place = page.anchor if type(page) is AnchorPage else type(page)  # as _place does, here for every beacon
        if self._pages.get(place) is page and not self._doubted:  # pages come from a cache, so mostly the very same
            return False
        return self._enter(place, page)

    def _hear_rival(self, issue: int, page: Page | None) -> bool:
        if issue != self._rival_issue:
            self._rival_issue, self._rival_frames, self._rival_pages = issue, 0, []
        self._rival_frames += 1
        if page is not None:
            self._rival_pages.append(page)
        if self._rival_frames < _SIGHTINGS:
            return False
        self._clear()
        self._issue, self._rival_issue = issue, None
        for rival_page in self._rival_pages:
            self._enter(_place(rival_page), rival_page)
        return True

    def _enter(self, place: object, page: Page) -> bool:
        held = self._pages.get(place)
        if held == page:
            if self._doubted:
                self._doubted.pop(place, None)
            return False
        if held is not None and self._doubted.get(place) != page:
            self._doubted[place] = page
            return False
        if held is None and isinstance(page, AnchorPage) and len(self._anchors_m) >= _MOST_ANCHORS:
            return False
        self._doubted.pop(place, None)
        self._pages[place] = page
        match page:
            case AnchorPage():
                self._anchors_m = self._anchors_m | {page.anchor: (page.x_m, page.y_m, page.z_m)}
            case SchedulePage():
                self._schedule = page
            case NoisePage():
                self._noise = page
            case AccuracyPage():
                self._accuracy = page
            case GeoreferencePage():
                self._georeference = page
        return True


def _decoded(pages: Iterable[bytes]) -> list[Page]:
    found = [page for page in map(decode_page, pages) if page is not None and page is not Malformed.BAD_PAGE]
    if len(found) < len(tuple(pages)):
        raise ValueError("a page of the almanac is damaged")
    return found


def _place(page: Page) -> object:
    """What a page is kept by: another of the same place replaces it."""
    return page.anchor if type(page) is AnchorPage else type(page)
