"""Packets that a tag receives in a system without a master, and the time differences derived from them.

Anchors of such a system report when they sent and when they received each other, each in its own clock. The number
of bits of their counters is a property of the whole stream, so it is kept with the stream, not with each value.
"""

from msgspec import Struct

Point = tuple[float, float, float]
"""x, y, z in metres."""


class Relay(Struct, frozen=True, gc=False):
    """One reception of another anchor, as the sender of a packet reports it."""

    anchor: int
    """Identifier of the anchor that was heard."""
    sequence: int
    """Sequence number of the packet that was heard."""
    rx_ticks: int
    """RX stamp in the relaying sender's clock; as many bits as its TX stamps."""
    tof_ticks: float | None
    """Time of flight between the two anchors, including antenna delays if the stamps include them."""
    carrier_phase_cycles: float | None = None
    """Carrier phase at this reception (``Reception.carrier_phase_cycles``)."""


class Packet(Struct, frozen=True, gc=False):
    """One packet of an anchor as a tag received it."""

    host_s: float | None
    """The host's clock, needed only to bridge gaps over 8.6 s."""
    anchor: int
    """Identifier of the sender."""
    sequence: int
    tx_ticks: int
    """TX stamp in the sender's clock."""
    rx_ticks: int
    """RX stamp in the tag's clock."""
    relays: tuple[Relay, ...]
    position_m: Point | None = None
    """Sender's position as it reports it."""
    carrier_phase_cycles: float | None = None
    """Carrier phase as the tag received it (``Reception.carrier_phase_cycles``)."""
    claims_common_time: bool = False
    """Whether its sender states that ``tx_ticks`` is in a time common to all anchors."""


class PairTdoa(Struct, frozen=True, gc=False):
    """One time difference of arrival between two anchors, in metres."""

    time_s: float
    """Time in the tag's clock since its first packet, or in the time of the recording it comes from."""
    anchor_a: int
    anchor_b: int
    tdoa_m: float
    """Range to b minus range to a."""
    a_m: Point | None = None
    """Position of a, if it moves and is recorded; otherwise the site's coordinates apply."""
    b_m: Point | None = None
