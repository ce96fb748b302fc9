"""Who claims to be the master: what every beacon says of it, and which of two claims is the newer one."""

from typing import Final

from msgspec import Struct

from skyless.air.beacon import Beacon

TERMS: Final = 256


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


class Confirmations(Struct):
    """Claims heard once, so that two frames are needed: one corrupted past its FCS makes no new master."""

    seen: dict[MasterTerm, int] = {}

    def again(self, claim: MasterTerm, rx_ticks: int, within_ticks: int) -> bool:
        """Take a claim; whether it was heard before, no longer ago than that."""
        self.seen = {other: ticks for other, ticks in self.seen.items() if 0 < rx_ticks - ticks < within_ticks}
        again = claim in self.seen
        self.seen[claim] = rx_ticks
        return again
