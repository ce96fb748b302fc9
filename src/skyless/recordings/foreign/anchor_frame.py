"""Positions that anchors of another system state of themselves, in one frame.

Relative positions are in the frame of whoever installed the anchors. Positions on the Earth become east, north and up
of the first one that is stated, so that the tag's are as well. One frame cannot have both: the first that is stated
decides.
"""

from skyless.air.masterless_packets import Point
from skyless.air.uci_location import GeodeticPoint
from skyless.site.earth import east_north_up_of
from skyless.site.model import GeoreferenceSite


class AnchorFrame:
    """The frame of one recording, or of the boards of one process."""

    def __init__(self) -> None:
        self.origin: GeodeticPoint | None = None
        """The first point on the Earth, where positions are stated there."""
        self._is_relative = False

    def position_m(self, location: Point | GeodeticPoint | None) -> Point | None:
        """A location in this frame; None for one of the other kind."""
        if isinstance(location, GeodeticPoint):
            if self._is_relative:
                return None
            self.origin = self.origin or location
            origin = GeoreferenceSite(self.origin.latitude_deg, self.origin.longitude_deg, self.origin.height_m)
            return east_north_up_of(location.latitude_deg, location.longitude_deg, location.height_m, origin)
        if location is None or self.origin is not None:
            return None
        self._is_relative = True
        return location
