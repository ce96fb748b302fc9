"""``Anchor``: the protocol machine of one anchor. Bytes and ticks in, frames and ticks out; no I/O, no clock.

A driver (simulator, program) passes it every reception, asks when its next frame is due, and fetches that frame as late
as its radio allows, so that it carries the latest receptions.

An anchor knows no time other than its own counter. It sends at the instants of ``skyless.core.air.almanac``. The more
anchors it receives, the less often it sends, so that together they make the best use of the air.
"""

from collections import Counter
from typing import Final

from skyless.core.air.almanac import PERIOD_CHANGES, gap_ticks, period_code, period_ticks, suitable_period_s
from skyless.core.air.beacon import Beacon, StatedPosition, decode_cached, encode, heard_capacity
from skyless.core.air.frame import Heard, Malformed, Reception, Transmission, is_weak_first_path, phase_of
from skyless.core.air.neighbours import PRESENT_TICKS, STAMP_COUNTERS, STAMP_FITS, Neighbours, unwrap_stamp
from skyless.core.air.site_pages import site_issue
from skyless.core.keys.authentication import BeaconAuthentication, Contents
from skyless.core.native.library import compiled
from skyless.core.pages import site_pages_of, stated_position
from skyless.core.site import AnchorSite, Site, UnplacedAnchor
from skyless.core.ticks import (
    DELAYED_TX_GRANULARITY_TICKS,
    LAST_TICKS,
    Unwrapper,
    from_seconds,
    to_seconds,
    wrap,
)

MAX_RELAY_AGE_TICKS: Final = from_seconds(1.0)
"""Older stamps are not relayed: sequence numbers wrap after 256 frames, and then name another frame."""

PRESENT_PERIODS: Final = 8
"""An anchor is in reach if it was received within ``PRESENT_TICKS`` or within this number of own periods."""

MIN_CODE_STEPS: Final = 2
"""Smaller changes of the period, up to 9 to 12 %, are not made, so that beacons stay predictable for long."""


class Anchor:
    """One anchor of a site of protocol 2."""

    def __init__(
        self, site: Site, anchor_id: int, lead_s: float = 1e-3, authentication: BeaconAuthentication | None = None
    ) -> None:
        """``lead_s``: how long before its RMARKER the driver needs a frame.

        ``authentication``: the keys; None for an anchor that sends without codes and accepts all frames. The radio is
        configured with the antenna delays of ``site`` and keeps them.

        Raises:
            KeyError: the site has no such anchor.
        """
        self.id = anchor_id
        self.counters: Counter[str] = Counter()
        self.authentication = authentication
        self._site = site
        self._has_phases = site.schedule.sends_phases
        self._known = frozenset(anchor.id for anchor in site.all_anchors) - {anchor_id}
        self._delay_ticks = anchor_of(site, anchor_id).tx_antenna_delay_ticks
        self._correction_ticks = 0
        """Correction of the radio's TX stamps in frames, if another site corrects its delays."""
        self._lead_ticks = from_seconds(lead_s) + DELAYED_TX_GRANULARITY_TICKS
        self._own_ticks = Unwrapper()
        self._neighbours = Neighbours()
        self._heard: dict[int, tuple[Heard, int, bool]] = {}
        """Last reception of each anchor, its unwrapped stamp, and whether its first path was weak; the newest last."""
        self._sequence = 0
        self._next_ticks: int | None = None
        """Instant of the frame with that sequence number, own unwrapped counter."""
        # At first all anchors of the site may be in reach: a site that is switched on must not choke its air.
        self._period_code = period_code(suitable_period_s(len(site.all_anchors), site.schedule.rate_hz))
        self.place(site)

    def place(self, site: Site) -> None:
        """Continue with other positions and antenna delays of the same anchors.

        The radio's own stamps do not change; frames state them corrected.
        """
        anchor = anchor_of(site, self.id)
        self._position: StatedPosition | None = (
            None if isinstance(anchor, UnplacedAnchor) else stated_position(site, anchor)
        )
        self._correction_ticks = delay_change_ticks(self._site, site, self.id)
        self._pages = site_pages_of(site)
        self._issue = site_issue(self._pages)

    @property
    def interval_ticks(self) -> float:
        """0, because frames are at random instants."""
        return 0.0

    def clock(self, _now_ticks: int | None) -> None:
        """None, because it knows only its own counter."""
        return

    def hear(self, reception: Reception) -> None:
        """Process a frame from the air. Frames of others are counted and dropped."""
        beacon = decode_cached(reception.frame)
        if isinstance(beacon, Malformed):
            self.counters[beacon] += 1
            return
        if beacon.site != self._site.id or beacon.anchor not in self._known:
            self.counters["foreign-site" if beacon.site != self._site.id else "unknown-anchor"] += 1
            return
        fault = None if self.authentication is None else self.authentication.fault_of(beacon, reception)
        if fault is not None:
            self.counters[fault] += 1
            return
        rx_ticks = self._own_ticks.unwrap(reception.rx_ticks, reception.host_s)
        if abs(rx_ticks) > LAST_TICKS:
            self.counters["impossible-host-time"] += 1
            return
        stamps = beacon.anchor, beacon.sequence, beacon.tx_ticks
        stamp = _unwrap_stamp(self._neighbours, *stamps, rx_ticks, period_ticks(beacon.period_code))
        if stamp != STAMP_FITS:
            self.counters.update(STAMP_COUNTERS[stamp])
            return
        self.counters["heard"] += 1
        weak, cycles = is_weak_first_path(reception.diagnostics), phase_of(reception)
        phase_cycles = cycles if self._has_phases and 0.0 <= cycles < 1.0 else None
        self._heard.pop(beacon.anchor, None)
        heard = Heard(beacon.anchor, beacon.sequence, reception.rx_ticks, phase_cycles)
        self._heard[beacon.anchor] = (heard, rx_ticks, weak)

    def next_transmission_ticks(self, now_ticks: int) -> int:
        """TX stamp (40-bit, own counter) of the next frame that can still be prepared.

        Frames that would have been due earlier use up their sequence numbers, so that later ones stay predictable.
        """
        earliest_ticks = self._own_ticks.unwrap(now_ticks) + self._lead_ticks
        if self._next_ticks is None:
            first_ticks = earliest_ticks + gap_ticks(self.id, 0xFF, self._period_code)
            self._next_ticks = on_radio_grid(first_ticks, self._delay_ticks)
        while self._next_ticks < earliest_ticks:
            self._advance()
        return wrap(self._next_ticks)

    def transmission(self, tx_ticks: int) -> Transmission:
        """The frame for the time last returned by ``next_transmission_ticks``."""
        assert self._next_ticks is not None
        keys, period_s = self.authentication, to_seconds(period_ticks(self._period_code))
        added = Contents() if keys is None else keys.contents(tx_ticks, self._sequence, self.id, period_s)
        position = None if added.certificate else self._position
        capacity = heard_capacity(position=position is not None, certificate=added.certificate is not None)
        heard, weak = self._relayed(self._next_ticks, capacity)
        beacon = Beacon(
            self._site.id, self.id, self._sequence, wrap(tx_ticks + self._correction_ticks), self._issue,
            self._period_code, position, heard, weak, added.page(self._pages, self._sequence, self.id),
            added.certificate, has_phases=self._has_phases and added.certificate is None,
        )  # fmt: skip
        self._advance()
        self.counters["sent"] += 1
        frame = encode(beacon)
        return Transmission(frame if keys is None else keys.seal(frame, added.interval), tx_ticks)

    def _advance(self) -> None:
        """Advance to the next frame, and adapt the period to the number of anchors in reach."""
        assert self._next_ticks is not None
        self._next_ticks += gap_ticks(self.id, self._sequence, self._period_code)
        self._sequence = (self._sequence + 1) & 0xFF
        if self._sequence % PERIOD_CHANGES == 0:
            rate_hz = self._site.schedule.rate_hz
            code = period_code(suitable_period_s(1 + self._in_reach(self._next_ticks), rate_hz))
            if abs(code - self._period_code) >= MIN_CODE_STEPS:
                self._period_code = code

    def _in_reach(self, now_ticks: int) -> int:
        """Number of other anchors that it receives."""
        oldest_ticks = now_ticks - max(PRESENT_TICKS, PRESENT_PERIODS * period_ticks(self._period_code))
        return sum(rx_ticks > oldest_ticks for _, rx_ticks, _ in self._heard.values())

    def _relayed(self, tx_ticks: int, capacity: int) -> tuple[tuple[Heard, ...], int]:
        """Receptions for a frame at this own time, the most recent first, and the bit mask of the weak ones."""
        oldest_ticks = tx_ticks - MAX_RELAY_AGE_TICKS
        recent = [(heard, weak) for heard, rx_ticks, weak in reversed(self._heard.values()) if rx_ticks > oldest_ticks]
        recent = recent[:capacity]
        return tuple(heard for heard, _ in recent), sum(weak << place for place, (_, weak) in enumerate(recent))


def anchor_of(site: Site, anchor_id: int) -> AnchorSite | UnplacedAnchor:
    """An anchor of a site by identifier. Raises KeyError if there is none."""
    for anchor in site.all_anchors:
        if anchor.id == anchor_id:
            return anchor
    raise KeyError(anchor_id)


def delay_change_ticks(before: Site, after: Site, anchor_id: int) -> int:
    """By how much later an anchor's frames leave than its radio states, if the delays of ``after`` are right.

    The radio uses those of ``before``. Only the sum of TX and RX delay is observable, so a change of the latter counts
    as one of the TX delay. Raises KeyError if the site has no such anchor.
    """
    old, new = anchor_of(before, anchor_id), anchor_of(after, anchor_id)
    change_ticks = new.tx_antenna_delay_ticks - old.tx_antenna_delay_ticks
    return change_ticks + new.rx_antenna_delay_ticks - old.rx_antenna_delay_ticks


def on_radio_grid(ticks_own: int, tx_antenna_delay_ticks: int) -> int:
    """Round down to the radio's grid: it starts at multiples of 512 raw ticks, the antenna delay comes on top."""
    raw = ticks_own - tx_antenna_delay_ticks
    return raw - raw % DELAYED_TX_GRANULARITY_TICKS + tx_antenna_delay_ticks


_unwrap_stamp: Final = compiled(unwrap_stamp)
