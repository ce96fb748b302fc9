"""What the server has computed by processes of their own (``task_process.py``)."""

from pathlib import Path
from typing import Final, Literal

from msgspec import Struct
from msgspec.structs import replace

from skyless.core.site import AnchorSite, Site
from skyless.site.file.check import check_site

Kind = Literal["pdop", "hdop", "sigma"]
KINDS: Final[tuple[Kind, ...]] = ("pdop", "hdop", "sigma")


class OverlayTask(Struct, frozen=True):
    """An overlay of the map."""

    site: Site
    kind: Kind
    method: str
    step_m: float
    """The least side of its cells."""
    plan_px: tuple[int, int] | None
    """Size of the floor plan's image."""


class WhatIfTask(Struct, frozen=True):
    """The packets of one tag, which a page recomputes with an anchor left out or moved, or other noise."""

    path: str
    tag: str
    begin_unix_s: float
    """It begins with the first fix from then on."""
    seconds: float


class MovedAnchors(Struct, frozen=True):
    """What a page asks about: the site as it would be with some anchors elsewhere."""

    anchors: tuple[AnchorSite, ...] = ()
    """Only their positions count."""

    def site_of(self, site: Site) -> Site:
        """The site with its anchors moved. Raises ConfigurationError."""
        at = {anchor.id: anchor for anchor in self.anchors}
        anchors = tuple(
            replace(one, x_m=at[one.id].x_m, y_m=at[one.id].y_m, z_m=at[one.id].z_m) if one.id in at else one
            for one in site.anchors
        )
        moved = replace(site, anchors=anchors)
        check_site(moved, Path("the moved anchors"))
        return moved
