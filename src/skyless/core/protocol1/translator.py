"""How ``joint`` hears a site of protocol 1: its beacons as those of protocol 2.

An anchor of protocol 1 states its own TX stamp and relays its receptions, the master's among them, as one of protocol 2
does. Its position and the site's pages come from the almanac that the beacons carry. What protocol 2 lacks is the
anchor's own estimate of its clock against the master's: where most frames are lost, positions from relays alone are a
third less accurate (``docs/protocol.md``).
"""

from typing import Final

from skyless.core.air import beacon as protocol2
from skyless.core.air.almanac import Page, SitePage, period_code
from skyless.core.air.site_choice import OF_PROTOCOL_1
from skyless.core.air.site_pages import site_issue
from skyless.core.estimator.estimator import NO_REPORT, Report
from skyless.core.protocol1.almanac import AlmanacAssembly
from skyless.core.protocol1.beacon import Beacon, MasterTime, schedule_from_page
from skyless.core.protocol1.clock import MasterScale, master_term_of
from skyless.core.ticks import SUBTICKS, TICK_M, nearest

STATED_BY_PAGE: Final = -1.0
"""Standard deviation of a position where that of the accuracy page counts."""


class Translator:
    """Translates the beacons that a tag receives from one site."""

    def __init__(self) -> None:
        self._almanac = AlmanacAssembly()
        self._pages: tuple[Page, ...] = ()
        self._issue = self._period_code = self._turn = 0
        self._positions: dict[int, protocol2.StatedPosition] = {}
        self._master_scale = MasterScale()
        self._newest: tuple[int, int] | None = None
        """The master's time and the tag's counter at the newest beacon, both unwrapped."""

    def translated(self, beacon: Beacon) -> protocol2.Beacon:
        """The beacon as one of protocol 2; without position or page until these are known."""
        if self._almanac.add_page(beacon.almanac_issue, beacon.page):
            self._read_almanac()
        page = None
        if self._pages:
            self._turn = (self._turn + 1) % len(self._pages)
            page = self._pages[self._turn]
        return protocol2.Beacon(
            beacon.site | OF_PROTOCOL_1,
            beacon.anchor,
            beacon.sequence,
            beacon.tx_ticks,
            self._issue,
            self._period_code,
            position=self._positions.get(beacon.anchor),
            heard=beacon.relayed,
            weak=0,
            page=page,
        )

    def _read_almanac(self) -> None:
        """Derive positions and pages from the almanac; none before it is complete."""
        almanac = self._almanac
        self._positions, self._pages = {}, ()
        if not almanac.complete or almanac.schedule is None or almanac.noise is None:
            return  # a start from all anchors finds the one that contradicts the others
        self._positions = {
            anchor: protocol2.StatedPosition(*point_m, std_m=STATED_BY_PAGE)
            for anchor, point_m in almanac.anchors_m.items()
        }
        schedule = schedule_from_page(almanac.schedule)
        self._period_code = period_code(1.0 / (schedule.superframe_rate_hz * schedule.frames_per_node))
        others: list[Page] = [almanac.noise, almanac.accuracy]
        if almanac.georeference is not None:
            others.append(almanac.georeference)
        self._pages = (SitePage(1 + len(others), almanac.schedule.tag_height_m), *others)
        self._issue = site_issue(self._pages)

    def report(self, beacon: Beacon, rx_counter: int) -> Report:
        """An anchor's report of its clock against the master's; ``rx_counter``: the tag's 40-bit stamp."""
        time = beacon.master_time
        if time is None:
            return NO_REPORT
        site_subticks, master_term = self._site_subticks(time, rx_counter), master_term_of(beacon)
        if beacon.anchor == beacon.master:
            self._master_scale.update(master_term, site_subticks, nearest(beacon.tx_ticks, site_subticks // SUBTICKS))
            return NO_REPORT
        difference = self._master_scale.difference(master_term, site_subticks, beacon.tx_ticks)
        if difference is None or time.std_ticks <= 0.0:
            return NO_REPORT
        return Report(beacon.master, difference, (time.std_ticks * TICK_M) ** 2)

    def _site_subticks(self, time: MasterTime, rx_counter: int) -> int:
        """TX time on the master's scale, unwrapped."""
        whole, subticks = divmod(time.tx_subticks_master, SUBTICKS)
        rx_ticks = rx_counter
        if self._newest is not None:
            rx_ticks = nearest(rx_counter, self._newest[1])
            whole = nearest(whole, self._newest[0] + rx_ticks - self._newest[1])
        self._newest = whole, rx_ticks
        return whole * SUBTICKS + subticks
