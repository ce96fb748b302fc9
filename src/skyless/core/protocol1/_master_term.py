"""The master term of a beacon, which of two terms is the newer, and which one a tag uses."""

from typing import Final

from msgspec import Struct, field

from skyless.core.protocol1.beacon import Beacon
from skyless.core.ticks import from_seconds

TERMS: Final = 256

_CONFIRMATION_TICKS: Final = from_seconds(0.5)
"""A newer term is accepted when two beacons carry it within this time."""

_OLDER_AFTER_TICKS: Final = from_seconds(0.5)
"""A whole site that was switched off and on counts its terms from 0 again."""


class MasterTerm(Struct, frozen=True, gc=False):
    """Whose time an anchor states: the master, and how often that role has changed hands, modulo 256."""

    term: int
    master: int


def master_term_of(beacon: Beacon) -> MasterTerm:
    """Return the master term that a beacon carries."""
    return MasterTerm(beacon.term, beacon.master)


def is_newer(term: int, other: int) -> bool:
    """Whether one term came after another: serial arithmetic (RFC 1982), right up to 127 takeovers apart."""
    return 0 < (term - other) % TERMS < TERMS // 2


class Confirmations(Struct):
    """Master terms received once, so that two frames are needed: one corrupted past its FCS makes no new master."""

    seen: dict[MasterTerm, int] = {}

    def confirm(self, master_term: MasterTerm, rx_ticks: int, within_ticks: int) -> bool:
        """Add a master term; whether it was received before, no longer ago than that."""
        self.seen = {other: ticks for other, ticks in self.seen.items() if 0 < rx_ticks - ticks < within_ticks}
        confirmed = master_term in self.seen
        self.seen[master_term] = rx_ticks
        return confirmed


class FollowedMaster(Struct):
    """The master term that a tag uses: the newest one, or what it receives once that one has fallen silent."""

    master_term: MasterTerm | None = None
    rx_ticks: int = 0
    confirmations: Confirmations = field(default_factory=Confirmations)

    @property
    def master(self) -> int | None:
        """The present master, None before the first beacon."""
        return None if self.master_term is None else self.master_term.master

    def on_beacon(self, beacon: Beacon, rx_ticks: int, superframe_ticks: int) -> bool:
        """Update the master term from a beacon; False if the beacon's master has been replaced.

        A newer term counts from its second beacon on; the first one may be used, as time goes on unchanged. Another
        master of the same term counts after a superframe and a half without the present one, an older term after three
        superframes and at least half a second. ``superframe_ticks`` is 0 before the schedule is known.
        """
        present = self.master_term
        if present is not None and beacon.term == present.term and beacon.master == present.master:
            self.rx_ticks = rx_ticks
            return True
        received = master_term_of(beacon)
        if present is not None and is_newer(received.term, present.term):
            if self.confirmations.confirm(received, rx_ticks, _CONFIRMATION_TICKS):
                self.master_term, self.rx_ticks = received, rx_ticks
            return True
        if present is not None:
            silence_ticks = max(_OLDER_AFTER_TICKS, 3 * superframe_ticks)
            if received.term == present.term and superframe_ticks:
                silence_ticks = 3 * superframe_ticks // 2
            if 0 <= rx_ticks - self.rx_ticks < silence_ticks:
                return False
        self.master_term, self.rx_ticks = received, rx_ticks
        return True
