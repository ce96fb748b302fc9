"""The beacon of protocol 1: what every anchor broadcasts in its slots (``docs/protocol.md``)."""

from msgspec import Struct

from skyless.core.air.almanac import Page
from skyless.core.air.frame import Heard, PackedHeard


class MasterTime(Struct, frozen=True, gc=False):
    """The frame's TX time on the master's scale, as the sending anchor's clock filter knows it."""

    tx_subticks_master: int
    """TX time on the site's scale, which the master keeps, in 1/256 tick, 48 bits."""
    std_ticks: float
    """Standard deviation of that time in ticks; sent in steps of 1/64 tick up to 1023.98."""


class Beacon(Struct, frozen=True, gc=False):
    """One decoded beacon frame, version 1."""

    site: int
    """Site identifier, 16 bits, sent as the PAN identifier."""
    anchor: int
    """Identifier of the sending anchor, 16 bits, sent as the short source address."""
    sequence: int
    """Frame counter of the sender, 8 bits."""
    superframe: int
    """Number of the superframe, 32 bits, counted by the master."""
    slot: int
    """Slot within the superframe in which this frame is sent, 8 bits."""
    tx_ticks: int
    """TX stamp in the sender's own clock, 40 bits."""
    almanac_issue: int
    """Changes when the almanac changes, 8 bits; a tag then discards the old one."""
    master: int
    """Identifier of the master whose time this anchor uses; its own for the master."""
    term: int
    """Counts the takeovers of the master's role, modulo 256 (8 bits)."""
    master_heard: Heard | None
    """The last master beacon that this anchor heard (raw stamp), None for the master or when none was heard."""
    master_time: MasterTime | None
    """None until the sender's clock is known against the master; exact (std 0) for the master itself."""
    heard: tuple[Heard, ...] | PackedHeard
    """The other anchors, the master excluded, in the order of the most recent first; as many as fit."""
    page: Page | None
    """One page of the almanac."""

    @property
    def relayed(self) -> tuple[Heard, ...]:
        """All receptions of other anchors, the master's last."""
        return (*self.heard,) if self.master_heard is None else (*self.heard, self.master_heard)
