"""Who claims to be the master: what every beacon says of it, and which of two claims is the newer one."""

from typing import Final

from msgspec import Struct

from skyless.air.beacon import Beacon
from skyless.ticks import from_seconds

TERMS: Final = 256

CONFIRMED_WITHIN_TICKS: Final = from_seconds(0.5)
"""A newer term is believed when it is heard twice so soon."""

OLDER_AFTER_TICKS: Final = from_seconds(0.5)
"""A whole site that was switched off and on counts its terms from 0 again."""


class MasterTerm(Struct, frozen=True, gc=False):
    """The master that an anchor follows, and the term: how often the role has changed hands, modulo 256."""

    term: int
    master: int


def master_term_of(beacon: Beacon) -> MasterTerm:
    """Return what a beacon says of the master."""
    return MasterTerm(beacon.term, beacon.master)


def is_newer(term: int, other: int) -> bool:
    """Whether one term came after another: serial arithmetic (RFC 1982), right up to 127 takeovers apart."""
    return 0 < (term - other) % TERMS < TERMS // 2


class Confirmations:
    """Claims heard once, so that two frames are needed: one corrupted past its FCS makes no new master."""

    def __init__(self) -> None:
        self._seen: dict[MasterTerm, int] = {}

    def again(self, claim: MasterTerm, rx_ticks: int, within_ticks: int) -> bool:
        """Take a claim; whether it was heard before, no longer ago than that."""
        self._seen = {other: ticks for other, ticks in self._seen.items() if 0 < rx_ticks - ticks < within_ticks}
        again = claim in self._seen
        self._seen[claim] = rx_ticks
        return again


class FollowedMaster:
    """The claim that a listener goes by."""

    def __init__(self) -> None:
        self.claim: MasterTerm | None = None
        self._heard_ticks = 0
        self._sightings = Confirmations()

    @property
    def master(self) -> int | None:
        """The present master, None before the first beacon."""
        return None if self.claim is None else self.claim.master

    def hear(self, beacon: Beacon, rx_ticks: int, superframe_ticks: int) -> bool:
        """Take what a beacon says of the master; False if it goes by one that is no more.

        A newer term counts from its second beacon on; the first one may be used, for time goes on the same. Another
        master of the same term counts after a superframe and a half without the present one, an older term after three
        superframes and at least half a second. ``superframe_ticks`` is 0 before the schedule is known.
        """
        present = self.claim
        if present is not None and beacon.term == present.term and beacon.master == present.master:
            self._heard_ticks = rx_ticks
            return True
        claim = master_term_of(beacon)
        if self.claim is None:
            self.claim, self._heard_ticks = claim, rx_ticks
            return True
        if is_newer(claim.term, self.claim.term):
            if self._sightings.again(claim, rx_ticks, CONFIRMED_WITHIN_TICKS):
                self.claim, self._heard_ticks = claim, rx_ticks
            return True
        patience = max(OLDER_AFTER_TICKS, 3 * superframe_ticks)
        if claim.term == self.claim.term and superframe_ticks:
            patience = 3 * superframe_ticks // 2
        if 0 <= rx_ticks - self._heard_ticks < patience:
            return False
        self.claim, self._heard_ticks = claim, rx_ticks
        return True
