"""What a tag receives in a system without a master, and the time differences that result from it.

Anchors of such a system report when they sent and when they heard each other, each in its own clock. How many bits
their counters have is a property of the whole stream, so it is kept with the stream and not in each value.
"""

from msgspec import Struct

Point = tuple[float, float, float]
"""x, y, z in metres."""


class Relay(Struct, frozen=True, gc=False):
    """The sender of a packet heard another anchor."""

    anchor: int
    """Identifier of the anchor that was heard."""
    sequence: int
    """Sequence number of the packet that was heard."""
    rx_ticks: int
    """When it was heard, in the clock of the sender of this relay; as many bits as its TX stamps."""
    tof_ticks: float | None
    """Time of flight between the two anchors, antenna delays included where the stamps include them."""
    carrier_phase_cycles: float | None = None
    """Phase of the carrier as it was heard (``Reception.carrier_phase_cycles``)."""


class Packet(Struct, frozen=True, gc=False):
    """One packet of an anchor as a tag received it."""

    host_s: float | None
    """The host's clock, needed only to bridge gaps over 8.6 s."""
    anchor: int
    """Identifier of the sender."""
    sequence: int
    tx_ticks: int
    """When it was sent, in the sender's clock."""
    rx_ticks: int
    """When the tag received it, in the tag's own clock."""
    relays: tuple[Relay, ...]
    position_m: Point | None = None
    """The sender's position, as it reports it."""
    carrier_phase_cycles: float | None = None
    """Phase of the carrier as the tag received it (``Reception.carrier_phase_cycles``)."""


class PairTdoa(Struct, frozen=True, gc=False):
    """One time difference of arrival between two anchors, in metres."""

    time_s: float
    """In the tag's clock, since its first packet, or in the time of the recording that it comes from."""
    anchor_a: int
    anchor_b: int
    tdoa_m: float
    """Range to b less range to a."""
    a_m: Point | None = None
    """Position of a, if it moves and the recording has it; otherwise the site's coordinates hold."""
    b_m: Point | None = None
