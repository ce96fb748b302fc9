"""The beacon of protocol 2: each anchor states its own position and when it sends next (``docs/protocol2.md``)."""

from typing import Final

from msgspec import Struct

from skyless.core.air.almanac import Page
from skyless.core.air.frame import Heard, PackedHeard

MAX_HEARD: Final = 12
"""Entries that the number and the flags of ``heard`` have space for."""


class StatedPosition(Struct, frozen=True, gc=False):
    """Where the sender is (antenna phase centre), to the millimetre, up to 8388 m from the origin along each axis."""

    x_m: float
    y_m: float
    z_m: float
    std_m: float = 0.0
    """Standard deviation of each coordinate; sent in millimetres, rounded up, at most 0.255 m."""
    floor: int = 0
    """Storey, −128 to 127."""
    zone: int = 0
    """Zone of the site, 0 to 255; 0 for none."""


class Authentication(Struct, frozen=True, gc=False):
    """What shows that a frame is of an anchor of the site, once the key of its interval is known."""

    interval: int
    """Number of the interval, its lowest 16 bits."""
    mac: bytes
    """Message authentication code of all bytes before it, 8 bytes."""


class Beacon(Struct, frozen=True, gc=False):
    """One decoded beacon frame, version 2."""

    site: int
    """Site identifier, 16 bits, sent as the PAN identifier."""
    anchor: int
    """Identifier of the sending anchor, 16 bits, sent as the short source address."""
    sequence: int
    """Frame counter of the sender, 8 bits."""
    tx_ticks: int
    """TX stamp in the sender's own clock, 40 bits."""
    almanac_issue: int
    """Checksum of the site's pages, 16 bits."""
    period_code: int
    """Mean period of the beacons from this one on, as a code (``skyless.core.air.instants``), 8 bits."""
    position: StatedPosition | None
    """None while the sender's position is unknown."""
    heard: tuple[Heard, ...] | PackedHeard
    """Receptions of other anchors, the most recent first; as many as fit."""
    weak: int
    """Bit k is set where the first path of entry k of ``heard`` was weak: it may be late."""
    page: Page | None
    """One page of what is common to the site."""
    certificate: bytes | None = None
    """Signed statement about the site's key chain (``skyless.core.keys.chain``); then the beacon has
    neither position, receptions nor page."""
    authentication: Authentication | None = None
    """None of anchors without keys."""
    has_phases: bool = False
    """Whether ``heard`` has phases; a frame then has only the lowest 32 bits of its stamps."""

    @property
    def relayed(self) -> tuple[Heard, ...]:
        """All receptions of other anchors."""
        return tuple(self.heard)
