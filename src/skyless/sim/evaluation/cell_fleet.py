"""Tags that compute at a site of protocol 2 of any size, whose anchors are simulated on demand (``sim/cells``).

Anchors have no machines here: they send when their schedule says, and relay what they have received. A tag gets the
beacons that it receives, as decoded from their frames, and nothing else.
"""

from collections.abc import Iterator, Sequence
from functools import lru_cache
from typing import Final

import numpy as np

from skyless.core.air.almanac import Page, period_code, suitable_period_s
from skyless.core.air.beacon import Beacon
from skyless.core.air.frame import Malformed, PackedHeard, Reception
from skyless.core.air.site_pages import decode_page, encode_page
from skyless.core.anchor import site_issue, site_page_for, site_pages_of, stated_position
from skyless.core.arrays import Array, Integers
from skyless.core.geometry import anchors_in_reach
from skyless.core.site import Site
from skyless.sim.cells.world import CellWorld, TagReceptions, anchors_of
from skyless.sim.evaluation.fleet import FleetSettings, JudgedFix, TagFleet
from skyless.sim.impairments import Impairments
from skyless.sim.listening import Outcome
from skyless.sim.medium import Tally
from skyless.sim.trajectory import Trajectory

MAX_MACHINES: Final = 200
"""Sites with more anchors are simulated on demand."""


_ENTRY: Final = np.dtype([("anchor", "<u2"), ("sequence", "u1"), ("low", "<u4"), ("high", "u1")])
"""A relayed reception as frames carry it (``air/beacon.HEARD``)."""


@lru_cache(maxsize=4)
def period_codes_of(site: Site) -> Integers:
    """Codes of the mean periods of a site's anchors once they have found out how many are in reach, shape (n,)."""
    rate_hz = site.schedule.rate_hz
    return np.array([period_code(suitable_period_s(count, rate_hz)) for count in anchors_in_reach(site).tolist()])


class SiteBeacons:
    """The contents of the beacons of a site."""

    def __init__(self, site: Site) -> None:
        self._site, self._pages = site.id, tuple(map(_on_air, site_pages_of(site)))
        self._issue = site_issue(self._pages)
        self._positions = {anchor.id: stated_position(site, anchor) for anchor in site.anchors}
        ids = [anchor.id for anchor in site.anchors]
        self._period_codes = dict(zip(ids, period_codes_of(site).tolist(), strict=True))

    def received(self, received: TagReceptions) -> Iterator[tuple[Beacon, Reception, int]]:
        """The beacons that a tag has received, its receptions of them (without their bytes), and their rows."""
        entries = np.zeros(received.relay_anchor.shape, _ENTRY)
        entries["anchor"], entries["sequence"] = received.relay_anchor, received.relay_sequence
        entries["low"], entries["high"] = received.relay_rx_ticks & 0xFFFFFFFF, received.relay_rx_ticks >> 32
        rows = zip(
            received.anchor.tolist(), received.sequence.tolist(), received.tx_ticks.tolist(),
            received.rx_ticks.tolist(), received.relays.tolist(), received.emission_s.tolist(), strict=True,
        )  # fmt: skip
        for row, (anchor, sequence, tx_ticks, rx_ticks, relays, emission_s) in enumerate(rows):
            heard, page = PackedHeard(entries[row, :relays].tobytes()), site_page_for(self._pages, sequence, anchor)
            beacon = Beacon(
                self._site,
                anchor,
                sequence,
                tx_ticks,
                self._issue,
                self._period_codes[anchor],
                self._positions[anchor],
                heard,
                0,
                page,
            )
            yield beacon, Reception(b"", rx_ticks, emission_s), row


def _on_air(page: Page) -> Page:
    """A page as its bytes state it: noise in single precision, lengths in millimetres."""
    decoded = decode_page(encode_page(page))
    assert decoded is not None and not isinstance(decoded, Malformed)
    return decoded


class CellFleet(TagFleet):
    """Tags that walk through a large site; each frame that one of them receives becomes fixes."""

    step_s = 0.5

    def __init__(
        self,
        site: Site,
        trajectories: Sequence[Trajectory],
        impairments: Impairments,
        seed: int,
        settings: FleetSettings,
        survey_std_m: float = 0.0,
        only: Sequence[int] | None = None,
    ) -> None:
        """``survey_std_m``: true less stated positions of the anchors, per axis.

        ``only``: the tags that are simulated here; others may be in other processes, with the same results.

        Raises:
            ValueError: an impairment that is not modelled.
        """
        super().__init__(site, len(trajectories), settings)
        self.cells = CellWorld(
            anchors_of(site), period_codes_of(site), trajectories, impairments, seed, survey_std_m=survey_std_m
        )
        self._only = range(len(trajectories)) if only is None else only
        self._beacons = SiteBeacons(site)
        self._now_s = 0.0
        self._received = 0

    @property
    def now_s(self) -> float:
        """True time that has passed."""
        return self._now_s

    @property
    def tally(self) -> Tally:
        """What tags have received; what others have, and what was lost, is not counted."""
        return Tally(0, 0, {}, {str(Outcome.HEARD): self._received})

    def run(self, until_s: float) -> Iterator[JudgedFix]:
        """Let true time pass; every fix of every tag, tag by tag within each half second."""
        while self._now_s < until_s:
            end_s = min(self._now_s + self.step_s, until_s)
            for tag in self._only:
                received = self.cells.receptions(tag, self._now_s, end_s)
                self._received += len(received)
                truths_m: Array = received.positions_m
                for beacon, reception, row in self._beacons.received(received):
                    fix = self.receivers[tag].hear_beacon(beacon, reception)
                    at_s = reception.host_s or 0.0
                    judged = self.add(tag, fix, truths_m[row], at_s)
                    if judged is not None:
                        yield judged
            self._now_s = end_s
