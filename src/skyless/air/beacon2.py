"""The beacon of protocol 2, which needs no master: each anchor states its own position (``docs/protocol2.md``)."""

from typing import Final

from msgspec import Struct

from skyless.air.almanac import Page
from skyless.air.beacon import Heard, PackedHeard

MAX_HEARD: Final = 12
"""Entries that the number and the flags of ``heard`` have space for."""

MOST_PULSE_AGE: Final = 0xFF


class SlotTime(Struct, frozen=True, gc=False):
    """The sender's slot, and the claim that its slot time follows."""

    superframe: int
    """Number of the superframe, 32 bits."""
    slot: int
    """Slot in which this frame is sent, 8 bits."""
    root: int
    """Identifier of the anchor whose counter leads the slot time, 16 bits."""
    term: int
    """Of two claims that with the higher term counts, of one term that with the lower root; 32 bits."""
    hop: int
    """Number of links from the root to the sender, 8 bits; 0 for the root."""
    pulse_age: int
    """``superframe`` less the newest superframe in which the root is known to have sent, at most ``MOST_PULSE_AGE``."""
    rate: float
    """Fractional rate of the sender's counter against the slot time; sent in steps of 2⁻³⁶, up to 1.2·10⁻⁴."""


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


class StatedSiteTime(Struct, frozen=True, gc=False):
    """Site time at the TX stamp, as the sender knows it."""

    residual_ticks: float
    """Site time less the nominal start of the slot, up to 32767 ticks; sent in 1/256 tick."""
    std_ticks: float
    """Its standard deviation; sent in steps of 1/64 tick, rounded up, at most 1023.98."""


class Authentication(Struct, frozen=True, gc=False):
    """What shows that a frame is of an anchor of the site, once the key of its interval is known."""

    interval: int
    """Number of the interval, its lowest 16 bits."""
    mac: bytes
    """Message authentication code of all bytes before it, 8 bytes."""


class Beacon2(Struct, frozen=True, gc=False):
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
    slot_time: SlotTime | None
    """None of anchors that send at random instants."""
    position: StatedPosition | None
    """None while the sender's position is unknown."""
    site_time: StatedSiteTime | None
    """None where the site does not want it; only with ``slot_time``."""
    heard: tuple[Heard, ...] | PackedHeard
    """Receptions of other anchors, the most recent first; as many as fit."""
    weak: int
    """Bit k is set where the first path of entry k of ``heard`` was weak: it may be late."""
    page: Page | None
    """One page of what is common to the site."""
    certificate: bytes | None = None
    """Signed statement about the site's key chain (``skyless.authentication.certificate``); then the beacon has no
    slot time, position, site time or page."""
    authentication: Authentication | None = None
    """None of anchors without keys."""
