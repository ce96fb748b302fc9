"""How the master's own counter goes with the site's time, so that what anchors say of it is said of that counter."""

from typing import Final

from msgspec import Struct

from skyless.air.master_term import MasterTerm
from skyless.positioning.estimator.kinds import SUBTICKS
from skyless.positioning.observation import Observation
from skyless.ticks import TICK_MASK

FARTHEST: Final = 16
"""Lines go on for so many times their length."""

MISFIT_SUBTICKS: Final = 64
"""By which a master's packets may lie off the line: roundings, carried so far."""

SUBTICKS_MASK: Final = SUBTICKS * (TICK_MASK + 1) - 1


class MasterScaleState(Struct, frozen=True):
    """What a ``MasterScale`` remembers: of each packet site time and its lead, each in ticks and subticks."""

    claim: MasterTerm | None
    points: tuple[tuple[int, int, int, int], ...]


class MasterScale:
    """The master's own counter against the site's time, which it may lead on at another rate than its own."""

    def __init__(self) -> None:
        self._claim: MasterTerm | None = None
        self._points: tuple[tuple[int, int], ...] = ()
        """Site time in subticks and its lead on the master's counter, of the first and the last packet of the term."""

    def state(self) -> MasterScaleState:
        """What it remembers; in 64 bits, which subticks exceed."""
        points = ((*divmod(site, SUBTICKS), *divmod(lead, SUBTICKS)) for site, lead in self._points)
        return MasterScaleState(self._claim, tuple(points))

    def restore(self, state: MasterScaleState) -> None:
        """Continue from a state."""
        self._claim = state.claim
        self._points = tuple((site * SUBTICKS + a, lead * SUBTICKS + b) for site, a, lead, b in state.points)

    def hear(self, observation: Observation) -> None:
        """Learn from a packet of the master."""
        claim = observation.claim
        if claim is None or observation.anchor != claim.master:
            return
        site, lead = _site_time(observation)
        if claim != self._claim:
            self._claim, self._points = claim, ((site, lead),)
        elif site > self._points[-1][0]:
            expected = self._lead(site)
            fits = len(self._points) < 2 or (expected is not None and abs(expected - lead) <= MISFIT_SUBTICKS)
            self._points = (self._points[0], (site, lead)) if fits else ((site, lead),)

    def difference(self, observation: Observation) -> int | None:
        """The sender's reading less the master's at its TX stamp, in subticks modulo 2⁴⁸; None while not known."""
        claim, ticks = observation.claim, observation.tx_ticks_master
        if claim is None or ticks is None or claim != self._claim:
            return None
        site = ticks * SUBTICKS + round(observation.tx_fraction_ticks * SUBTICKS)
        lead = self._lead(site)
        return None if lead is None else (lead - site + observation.tx_ticks_anchor * SUBTICKS) & SUBTICKS_MASK

    def _lead(self, site: int) -> int | None:
        """Lead of the site's time on the master's counter, on a straight line; None too far from what is known."""
        if len(self._points) < 2:
            return None
        (first, before), (last, lead) = self._points
        length, beyond = last - first, site - last
        return lead + (lead - before) * beyond // length if 0 <= beyond <= FARTHEST * length else None


def _site_time(observation: Observation) -> tuple[int, int]:
    """Site time in subticks, and by how much it is ahead of the sender's counter."""
    assert observation.tx_ticks_master is not None
    site = observation.tx_ticks_master * SUBTICKS + round(observation.tx_fraction_ticks * SUBTICKS)
    return site, site - observation.tx_ticks_anchor * SUBTICKS
