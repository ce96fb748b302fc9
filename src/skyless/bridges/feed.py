"""What bridges get of a site, and what all of them do with it alike."""

from math import isfinite
from typing import Final

from msgspec import Struct

from skyless.errors import SkylessError
from skyless.mqtt.messages import FixMessage, Matrix, Vector, Zone
from skyless.positioning.alert import Alert
from skyless.site.model import GeoreferenceSite, Site, WallSite

MIN_STD_M: Final = 0.01
"""Least standard deviation of an axis that leaves: the gates of other programs reject fixes with honest millimetres."""

_FORBIDDING: Final = (Alert.NOT_EXCLUDED, Alert.LIMIT)
"""Alerts of fixes that nobody should navigate with."""


class BridgedSite(Struct, frozen=True):
    """What a bridge knows of the site."""

    id: int
    name: str
    simulated: bool
    """True where its radios are emulated."""
    anchors_m: dict[int, Vector]
    """Positions of those that are known, in the site's frame."""
    georeference: GeoreferenceSite | None = None
    zones: tuple[Zone, ...] = ()
    master: int | None = None
    """The anchor that is the master by the site file; None where there is none, or it is not known."""
    walls: tuple[WallSite, ...] = ()
    """A tag by itself knows none."""


def bridged_site(site: Site, zones: tuple[Zone, ...] = (), *, simulated: bool) -> BridgedSite:
    """The same of a whole site, as MQTT has it."""
    anchors_m = {anchor.id: (anchor.x_m, anchor.y_m, anchor.z_m) for anchor in site.anchors}
    return BridgedSite(site.id, site.name, simulated, anchors_m, site.georeference, zones, site.master, site.walls)


def is_usable(fix: FixMessage) -> bool:
    """Whether its position may be given: it is finite, and no alert forbids its use."""
    return fix.alert not in _FORBIDDING and all(map(isfinite, (*fix.position_m, *fix.covariance_m2)))


def floored(covariance_m2: Matrix) -> Matrix:
    """The covariance of a position with a variance of at least ``MIN_STD_M`` squared in each axis."""
    xx, xy, xz, yx, yy, yz, zx, zy, zz = covariance_m2
    least = MIN_STD_M**2
    return max(xx, least), xy, xz, yx, max(yy, least), yz, zx, zy, max(zz, least)


def require_georeference(site: BridgedSite, target: str) -> GeoreferenceSite:
    """Where the site is on the Earth, for a target that speaks of nothing else.

    Raises:
        SkylessError: the site does not know it.
    """
    if site.georeference is None:
        raise SkylessError(
            f"{target} gives positions on the Earth, and site {site.id} ({site.name}) does not say where it is: its "
            "site file should have [georeference] with latitude_deg, longitude_deg, height_m and heading_deg"
        )
    return site.georeference
