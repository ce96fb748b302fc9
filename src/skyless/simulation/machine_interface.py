"""What the world asks of the protocol machines that run in it."""

from collections.abc import Callable
from typing import Protocol

from skyless.air.reception import Reception, Transmission


class AnchorMachine(Protocol):
    """An anchor as its radio sees it (``skyless.anchor.Anchor`` is one)."""

    @property
    def id(self) -> int:
        """Identifier of the anchor, 16 bits."""

    def hear(self, reception: Reception) -> None:
        """Take one frame off the air; never raises."""

    def next_transmission_ticks(self, now_ticks: int) -> int | None:
        """TX stamp (own 40-bit counter) of the next frame, at least a lead time after now; None: ask again."""

    def transmission(self, tx_ticks: int) -> Transmission:
        """The frame for that slot, made as late as possible so that it carries the latest receptions."""


AnchorFactory = Callable[[int], AnchorMachine]
"""Makes a machine for an anchor's identifier; called again when that anchor restarts."""
