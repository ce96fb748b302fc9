"""The master's own counter against the site's time, which it may continue at another rate than its own."""

from typing import Final

from msgspec import Struct

from skyless.core.constants import SUBTICKS
from skyless.core.protocol1._master_term import MasterTerm
from skyless.core.ticks import TICK_MASK

FARTHEST_LENGTHS: Final = 16  # lines are extended by this number of times their length
MISFIT_SUBTICKS: Final = 64  # by which a master's packets may lie off the line: roundings, extended that far

SITE_TIME_MASK: Final = SUBTICKS * (TICK_MASK + 1) - 1


class MasterScale(Struct):
    """A straight line through the first and the last packet of a master's term."""

    master_term: MasterTerm | None = None
    points: tuple[tuple[int, int, int, int], ...] = ()
    """Site time and its lead on the master's counter, each in ticks and subticks: 64 bits cannot hold subticks."""

    def update(self, master_term: MasterTerm, site_subticks: int, tx_ticks: int) -> None:
        """Process a packet of the master."""
        lead = site_subticks - tx_ticks * SUBTICKS
        point = (*divmod(site_subticks, SUBTICKS), *divmod(lead, SUBTICKS))
        if master_term != self.master_term:
            self.master_term, self.points = master_term, (point,)
        elif point > self.points[-1]:
            expected = self._lead(site_subticks)
            fits = len(self.points) < 2 or (expected is not None and abs(expected - lead) <= MISFIT_SUBTICKS)
            self.points = (self.points[0], point) if fits else (point,)

    def difference(self, master_term: MasterTerm | None, site_subticks: int, tx_ticks: int) -> int | None:
        """An anchor's reading less the master's at its TX stamp, in subticks modulo 2⁴⁸; None while not known."""
        lead = self._lead(site_subticks) if master_term == self.master_term else None
        return None if lead is None else (lead - site_subticks + tx_ticks * SUBTICKS) & SITE_TIME_MASK

    def _lead(self, site_subticks: int) -> int | None:
        """Lead of the site's time on the master's counter, on the line; None too far from what is known."""
        if len(self.points) < 2:
            return None
        (first, before), (last, lead) = ((a * SUBTICKS + b, c * SUBTICKS + d) for a, b, c, d in self.points)
        length, beyond = last - first, site_subticks - last
        return lead + (lead - before) * beyond // length if 0 <= beyond <= FARTHEST_LENGTHS * length else None
