"""Tags that compute at a site of protocol 2 of any size, whose anchors are simulated on demand (``simulation/cells``).

Anchors have no machines here: they send when their schedule says, and relay what they have received. A tag gets the
beacons that it receives, as decoded from their frames, and nothing else.
"""

from collections.abc import Iterator, Sequence
from typing import Final

import numpy as np

from skyless.air.almanac import Page
from skyless.air.beacon import Malformed, PackedHeard
from skyless.air.beacon2 import Beacon2
from skyless.air.page_codec import decode_page, encode_page
from skyless.air.reception import Reception
from skyless.evaluation.fleet import FleetSettings, JudgedFix, TagFleet
from skyless.kernels.arrays import Array
from skyless.simulation.cells.timetable import FreeSchedule, Schedule, SlotSchedule
from skyless.simulation.cells.world import CellWorld, TagReceptions, anchors_of
from skyless.simulation.impairments import Impairments
from skyless.simulation.listening import Outcome
from skyless.simulation.medium import Tally
from skyless.simulation.trajectory import Trajectory
from skyless.site.local_almanac import site_issue, site_page_for, site_pages_of, stated_position
from skyless.site.model import Site
from skyless.site.slots import schedule_of

MOST_MACHINES: Final = 200
"""Sites with more anchors are simulated on demand."""

_ENTRY: Final = np.dtype([("anchor", "<u2"), ("sequence", "u1"), ("low", "<u4"), ("high", "u1")])
"""A relayed reception as frames carry it (``air/beacon.HEARD``)."""


def schedule_in_cells(site: Site) -> Schedule:
    """The schedule of a site of protocol 2 for ``CellWorld``.

    Raises:
        ValueError: the site has no slots yet.
    """
    if site.schedule.mode == "free":
        return FreeSchedule(site.schedule.rate_hz)
    schedule = schedule_of(site)
    colours = np.array([anchor.slot for anchor in site.anchors])
    return SlotSchedule(colours, schedule.slots, schedule.slot_ticks)


class SiteBeacons:
    """What the beacons of a site say, whatever is received."""

    def __init__(self, site: Site) -> None:
        """Raises ValueError for a site without slots."""
        self._site, self._pages = site.id, tuple(map(_on_air, site_pages_of(site)))
        self._issue = site_issue(self._pages)
        self._positions = {anchor.id: stated_position(site, anchor) for anchor in site.anchors}

    def received(self, received: TagReceptions) -> Iterator[tuple[Beacon2, Reception, int]]:
        """The beacons that a tag has received, its receptions of them (without their bytes), and their rows.

        They carry no slot time: a tag makes no use of it.
        """
        entries = np.zeros(received.relay_anchor.shape, _ENTRY)
        entries["anchor"], entries["sequence"] = received.relay_anchor, received.relay_sequence
        entries["low"], entries["high"] = received.relay_rx_ticks & 0xFFFFFFFF, received.relay_rx_ticks >> 32
        rows = zip(
            received.anchor.tolist(), received.sequence.tolist(), received.tx_ticks.tolist(),
            received.rx_ticks.tolist(), received.relays.tolist(), received.emission_s.tolist(), strict=True,
        )  # fmt: skip
        for row, (anchor, sequence, tx_ticks, rx_ticks, relays, emission_s) in enumerate(rows):
            heard, page = PackedHeard(entries[row, :relays].tobytes()), site_page_for(self._pages, sequence, anchor)
            beacon = Beacon2(
                self._site, anchor, sequence, tx_ticks, self._issue, None, self._positions[anchor], None, heard, 0, page
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
            ValueError: an impairment that is not modelled, or a site without slots.
        """
        super().__init__(site, len(trajectories), settings)
        self.cells = CellWorld(
            anchors_of(site), schedule_in_cells(site), trajectories, impairments, seed, survey_std_m=survey_std_m
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
