"""What a page asks the server for, and what it has been sent: of a large site, the part that it shows."""

from typing import Annotated, Final

import msgspec
from msgspec import Meta, Struct

MAX_ROWS: Final = 2_000
"""Tags that a page is sent at once; of more those on its map, and those that it names or looks for."""

MAX_HEALTHS: Final = 200
"""Of more tags, or anchors, a page is sent the health of those that it names only."""

MAX_REQUEST_BYTES: Final = 16_384
_MAX_NAMED: Final = 200


class PageRequest(Struct, frozen=True):
    """What one page shows."""

    view: tuple[float, float, float, float] | None = None
    """Its part of the site, least x and y and largest x and y in m; None: all of it."""
    find: Annotated[str, Meta(max_length=200)] = ""
    """Tags with this in their names."""
    tags: Annotated[tuple[str, ...], Meta(max_length=_MAX_NAMED)] = ()
    """Selected tags and those in the visible part of a list, of which also the health is sent."""
    anchors: Annotated[tuple[str, ...], Meta(max_length=_MAX_NAMED)] = ()
    rows: Annotated[int, Meta(ge=1)] = MAX_ROWS
    """Tags that its browser can draw in time."""

    @classmethod
    def read(cls, text: str) -> "PageRequest | None":
        """A page's request; None for a text that is none."""
        try:
            return msgspec.json.decode(text, type=cls)
        except (msgspec.MsgspecError, ValueError, RecursionError):
            return None


class Sent:
    """What a page has been sent of the state, so that it is sent only what is new."""

    def __init__(self) -> None:
        self.wanted = PageRequest()
        self.fixes = 0
        """Serial of the last fix."""
        self.tags: dict[str, None] | None = None
        """Tags that it has been sent; None: all."""
        self.inside = 0
        """Tags in its view."""
        self.chosen_s = float("-inf")
        """When its tags were chosen."""
        self.healths: int | None = None
        """Serial of the last health, None before the first message."""
        self.named: dict[str, set[str]] = {"tags": set(), "anchors": set(), "ether": set()}
        """By kind, the names whose health it was sent whatever their number."""
        self.statuses = 0
        """Serial of the last status."""
        self.conditions: dict[str, str] = {}
        """Of anchors."""
