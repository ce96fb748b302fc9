"""Many packets at once, as ``joint`` takes them in batch."""

from msgspec import Struct

from skyless.positioning.joint_state import Integers, Matrix
from skyless.positioning.joint_sync import NO_SYNCS


class Messages(Struct, frozen=True):
    """Packets in the order in which the tag heard them, all stamps unwrapped."""

    sites: Integers
    """Place of each packet's anchor in the table of positions, shape (n,)."""
    sequences: Integers
    rx_ticks: Integers
    """The tag's stamps."""
    tx_ticks: Integers
    """The anchors' own."""
    relays: Integers
    """As ``joint_hear`` takes them, shape (relays, 4)."""
    ends: Integers
    """Where the relays of each packet end."""
    syncs: Matrix = NO_SYNCS
    """What each packet's anchor says of its clock, as ``joint_hear`` takes it, shape (n, 3), or (0, 3) for nothing."""
