"""What a tag of protocol 2 keeps beside its filter (``State``) and its search for a start (``Acquisition``)."""

from typing import Annotated

from skyless.core.air.beacon_fields import BeaconFields
from skyless.core.air.site_pages import SitePages
from skyless.core.estimator.process import Packet, Relays
from skyless.core.estimator.settings import EstimatorSettings
from skyless.core.estimator.state import AXES
from skyless.core.native.records import Integers, Record, Ticks, record
from skyless.core.tag.admission import Admission
from skyless.core.tag.course import Course


@record
class Tag(Record):
    """A tag of protocol 2."""

    owner: EstimatorSettings
    """What its owner has chosen; the site's pages state the rest."""
    admission: Admission
    pages: SitePages
    course: Course
    has_settings: bool
    """Whether the pages are known, so that it looks for a start or follows its course."""
    period_ticks: Ticks
    """Longest mean time between two beacons of an anchor, when the settings were made."""
    is_moving: bool
    """Whether anchors of the site have stated other positions recently (``Neighbour.has_moved``)."""
    moved_ticks: Ticks
    """When the last one did."""
    uses_moved: bool
    """Whether those are in use, and not the others."""
    origin_mm: Annotated[Integers, AXES]
    """To be added to all positions, where ``HAS_ORIGIN``."""
    has_origin: bool
    most_relays: int
    """Of a beacon that follows its course, the newest ones: fewer where its processor is late."""
    # The beacon at hand
    beacon: BeaconFields
    has_moved: bool
    """Whether its sender states another position than before."""
    packet: Packet
    """The same for the filter."""
    relays: Relays
    events: int
    """What has happened with it (``admission.COUNTER_JUMPED`` and others)."""
