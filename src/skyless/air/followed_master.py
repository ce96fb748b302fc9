"""Which master a tag goes by: the newest term, and what is heard once that has fallen silent."""

from typing import Final

from msgspec import Struct, field

from skyless.air.beacon import Beacon
from skyless.air.master_term import Confirmations, MasterTerm, is_newer, master_term_of
from skyless.ticks import from_seconds

CONFIRMED_WITHIN_TICKS: Final = from_seconds(0.5)
"""A newer term is believed when it is heard twice so soon."""

OLDER_AFTER_TICKS: Final = from_seconds(0.5)
"""A whole site that was switched off and on counts its terms from 0 again."""


class FollowedMaster(Struct):
    """The claim that a listener goes by."""

    claim: MasterTerm | None = None
    heard_ticks: int = 0
    sightings: Confirmations = field(default_factory=Confirmations)

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
            self.heard_ticks = rx_ticks
            return True
        claim = master_term_of(beacon)
        if self.claim is None:
            self.claim, self.heard_ticks = claim, rx_ticks
            return True
        if is_newer(claim.term, self.claim.term):
            if self.sightings.again(claim, rx_ticks, CONFIRMED_WITHIN_TICKS):
                self.claim, self.heard_ticks = claim, rx_ticks
            return True
        patience = max(OLDER_AFTER_TICKS, 3 * superframe_ticks)
        if claim.term == self.claim.term and superframe_ticks:
            patience = 3 * superframe_ticks // 2
        if 0 <= rx_ticks - self.heard_ticks < patience:
            return False
        self.claim, self.heard_ticks = claim, rx_ticks
        return True
