"""``Anchor``: the protocol machine of one anchor. Bytes and ticks in, frames and ticks out; no I/O, no clock.

A driver (simulator, program) passes it every reception, asks when its next frame is due, and fetches that frame as late
as its radio allows, so that it carries the latest receptions.

An anchor knows no time other than its own counter. It sends at the instants of ``skyless.core.air.almanac``. The more
anchors it receives, the less often it sends, so that together they make the best use of the air.
"""

import math
from collections import Counter
from collections.abc import Iterable
from typing import Final

from msgspec import Struct
from msgspec.structs import asdict

from skyless.core.air.almanac import (
    PERIOD_CHANGES,
    AccuracyPage,
    GeoreferencePage,
    KeyPage,
    NoisePage,
    Page,
    SitePage,
    gap_ticks,
    period_code,
    period_ticks,
    suitable_period_s,
)
from skyless.core.air.beacon import (
    INTERVAL_BITS,
    Beacon,
    StatedPosition,
    decode_cached,
    encode,
    heard_capacity,
    signed_bytes,
    with_authentication,
)
from skyless.core.air.frame import Heard, Malformed, Reception, Transmission, is_weak_first_path, phase_of
from skyless.core.air.neighbours import PRESENT_TICKS, STAMP_COUNTERS, STAMP_FITS, Neighbours, unwrap_stamp
from skyless.core.air.site_pages import site_issue
from skyless.core.keys.chain import Chain, ChainKeys, ChainRing, ChainTiming, is_mac, mac_of
from skyless.core.keys.fault import Fault
from skyless.core.native.library import compiled
from skyless.core.site import AnchorSite, Site, UnplacedAnchor
from skyless.core.ticks import (
    DELAYED_TX_GRANULARITY_TICKS,
    LAST_TICKS,
    TICK_S,
    Unwrapper,
    difference,
    from_seconds,
    nearest,
    to_seconds,
    wrap,
)

# Protocol 2: the pages that are common to a site, and what a tag knows of anchors and pages as Python has them.


def site_pages_of(site: Site) -> tuple[Page, ...]:
    """The pages of a validated site of protocol 2, in the order of their types on the air."""
    filters, earth = filter_pages_of(site), georeference_page_of(site)
    others: list[Page] = [filters[0], *([] if earth is None else [earth]), filters[1]]
    return (*others, SitePage(len(others) + 1, site.tags.height_m))


def filter_pages_of(site: Site) -> tuple[NoisePage, AccuracyPage]:
    """The pages for the filters of tags."""
    noise = site.noise
    return (
        NoisePage(noise.tx_stamp_ps * 1e-12, noise.rx_stamp_ps * 1e-12, noise.white_fm, noise.random_walk_fm),
        AccuracyPage(**asdict(site.accuracy)),
    )


def georeference_page_of(site: Site) -> GeoreferencePage | None:
    """The page with the site's position on the Earth; None if unknown."""
    earth = site.georeference
    if earth is None:
        return None
    return GeoreferencePage(earth.latitude_deg, earth.longitude_deg, earth.height_m, earth.heading_deg % 360.0)


def stated_position(site: Site, anchor: AnchorSite) -> StatedPosition:
    """The position that an anchor of a site states."""
    std_m = site.accuracy.survey_std_m if anchor.std_m is None else anchor.std_m
    return StatedPosition(anchor.x_m, anchor.y_m, anchor.z_m, std_m, anchor.floor, anchor.zone)


def site_page_for(pages: tuple[Page, ...], sequence: int, anchor: int) -> Page:
    """The page that a frame carries: an anchor's successive frames cycle through them."""
    return pages[(sequence + anchor) % len(pages)]


# What an anchor with keys adds to its frames, and how it verifies those of others: it knows all keys, so at once.

CERTIFICATE_S: Final = 0.5
CERTIFICATE_EVERY: Final = (8, 16, 32)
"""An anchor sends a certificate about twice a second, in one of 8, 16 or 32 frames, which then has no relays. Every
fourth certificate is that of the next section or chain."""
_SUCCESSOR_EVERY: Final = 4

FAR_S: Final = 10.0
"""Codes of intervals farther from the present are not checked: anybody can state any, and their keys take long."""

NO_KEYS_S: Final = 2.0
"""Time without disclosing keys after a start and after a step of the host's clock: others may find it wrong."""

RECENT_S: Final = 2.0
SPACINGS: Final = 3.0
"""An anchor's first frame in an interval comes within this many of its mean times between frames."""
MIN_OTHERS: Final = 2
"""Number of other clocks that prove the own one wrong: with a single one, either may be."""


class Contents(Struct, frozen=True, gc=False):
    """What authentication adds to the next frame."""

    interval: int | None = None
    """The interval whose key authenticates the frame; None without authentication."""
    certificate: bytes | None = None
    key: KeyPage | None = None

    def page(self, pages: tuple[Page, ...], sequence: int, anchor: int) -> Page | None:
        """The page of the frame: a key, otherwise one of the site's; none with a certificate."""
        if self.certificate is not None:
            return None
        return self.key or site_page_for(pages, sequence if self.interval is None else sequence >> 1, anchor)


class _Offset(Struct):
    """By how much another anchor's clock is behind the own one, from its frames of this second and the last.

    A frame gives the time since the beginning of its interval, and the smallest of many is hardly more than the clocks'
    difference. Repeated old frames give larger values, so they do no harm.
    """

    since_s: float
    present_s: float = math.inf
    before_s: float = math.inf
    frames: int = 0
    frames_before: int = 0

    def add(self, unix_s: float, offset_s: float) -> None:
        if abs(unix_s - self.since_s) > 1.0:
            self.since_s, self.before_s, self.frames_before = unix_s, self.present_s, self.frames
            self.present_s, self.frames = math.inf, 0
        self.present_s = min(self.present_s, offset_s)
        self.frames += 1

    def is_far(self, timing: ChainTiming) -> bool:
        """Whether the clocks are too far apart, whenever the anchor sends within its interval."""
        least_s = min(self.present_s, self.before_s)
        latest_s = min(SPACINGS / self.frames_before, timing.interval_s) if self.frames_before else timing.interval_s
        return least_s < -timing.anchors_apart_s or least_s > timing.anchors_apart_s + latest_s


class BeaconAuthentication:
    """Keys, time and neighbours of one anchor, as needed for authentication. No I/O, no clock of its own."""

    def __init__(self, chains: Iterable[Chain], no_keys_s: float = NO_KEYS_S) -> None:
        """``no_keys_s``: time without disclosing keys after a start; 0 for an anchor that was on before."""
        self.faults: dict[int, tuple[Fault, float]] = {}
        """The last fault of each other anchor, or of frames in its name, with its Unix time in seconds."""
        self._ring = ChainRing(chains)
        self._now: tuple[int, float] | None = None
        self._offsets: dict[int, _Offset] = {}
        self._no_keys_s, self._no_keys_until_s = no_keys_s, 0.0

    def set_chains(self, chains: Iterable[Chain]) -> None:
        """Use these chains from now on: a successor, or a replacement of a revoked one."""
        self._ring = ChainRing(chains)

    def set_time(self, now_ticks: int, unix_s: float) -> None:
        """Set the own counter (40 bits) and the host's clock at the same moment; needed every few seconds."""
        timing = self._ring.timing
        step_s = math.inf if self._now is None else abs(unix_s - self._unix_s(now_ticks))
        if timing is not None and step_s > timing.anchors_apart_s:
            self._no_keys_until_s = unix_s + self._no_keys_s
        self._now = (now_ticks, unix_s)

    def fault(self) -> Fault | None:
        """Why own frames are sent without a code; None if they have one."""
        timing = self._ring.timing
        if self._now is None or timing is None:
            return Fault.NO_TIME if self._now is None else Fault.NO_CHAIN
        far, near = self._clocks(timing, self._now[1])
        if far > near and near < MIN_OTHERS <= far:
            return Fault.CLOCK_WRONG
        return None if self._ring.at(timing.interval_at(self._now[1])) is not None else Fault.NO_CHAIN

    def contents(self, tx_ticks: int, sequence: int, anchor: int, period_s: float) -> Contents:
        """What to put into the frame with this TX stamp (40 bits); ``period_s``: mean time between two frames."""
        timing = self._ring.timing
        if timing is None or self.fault() is not None:
            return Contents()
        every = min(CERTIFICATE_EVERY, key=lambda every: abs(every * period_s - CERTIFICATE_S))
        has_certificate = (sequence - anchor) % every == 0
        interval = timing.interval_at(self._unix_s(tx_ticks))
        keys = self._ring.at(interval)
        if keys is None:
            return Contents(certificate=self._ring.successor(interval) if has_certificate else None)
        self._ring.prepare(interval)
        if has_certificate:
            is_next = sequence // every % _SUCCESSOR_EVERY == _SUCCESSOR_EVERY - 1
            successor = self._ring.successor(interval) if is_next else None
            return Contents(interval, certificate=successor or keys.certificate(interval))
        disclosed = interval - timing.lag
        disclosing = self._ring.at(disclosed)
        if not sequence & 1 or disclosing is None or not self._may_disclose(timing):
            return Contents(interval)
        return Contents(interval, key=KeyPage(disclosing.key(disclosed)))

    def seal(self, frame: bytes, interval: int | None) -> bytes:
        """The frame with its code filled in."""
        keys = None if interval is None else self._ring.at(interval)
        if keys is None or interval is None:
            return frame
        key = keys.mac_key(interval)
        return with_authentication(frame, interval & (1 << INTERVAL_BITS) - 1, lambda signed: mac_of(signed, key))

    def fault_of(self, beacon: Beacon, reception: Reception) -> Fault | None:
        """Why a beacon of another anchor is refused; None if it is genuine, or if own chains do not hold now."""
        timing = self._ring.timing
        if self._now is None or timing is None:
            return Fault.NO_TIME if self._now is None else None
        unix_s = self._unix_s(reception.rx_ticks)
        fault = self._fault_of(beacon, reception.frame, unix_s, timing)
        if fault is not None:
            self.faults[beacon.anchor] = (fault, unix_s)
        return fault

    def recent_faults(self, unix_s: float) -> dict[int, Fault]:
        """Faults of other anchors within the last seconds."""
        return {anchor: fault for anchor, (fault, when_s) in self.faults.items() if abs(unix_s - when_s) <= RECENT_S}

    def _fault_of(self, beacon: Beacon, frame: bytes, unix_s: float, timing: ChainTiming) -> Fault | None:
        present = timing.interval_at(unix_s)
        stated = beacon.authentication
        if stated is None:
            return Fault.NO_CODE if self._ring.at(present) is not None else None
        interval = nearest(stated.interval, present, INTERVAL_BITS)
        offset_s = unix_s - timing.start_s(interval)
        if abs(offset_s) > FAR_S:
            return Fault.LATE if offset_s > 0.0 else Fault.EARLY
        keys = self._ring.at(interval)
        if keys is None:
            return None if self._ring.at(present) is None else Fault.LATE
        signed = signed_bytes(frame)
        if not is_mac(signed, stated.mac, keys.mac_key(interval)):
            return self._code_fault(signed, stated.mac, interval)
        self._note_offset(beacon.anchor, unix_s, offset_s)
        if offset_s + timing.anchors_apart_s + timing.anchor_lead_s >= timing.interval_s * timing.lag:
            return Fault.LATE
        return Fault.EARLY if offset_s < -timing.anchors_apart_s else None

    def _code_fault(self, signed: bytes, mac: bytes, interval: int) -> Fault:
        revoked: tuple[ChainKeys, ...] = self._ring.revoked(interval)
        is_revoked = any(is_mac(signed, mac, keys.mac_key(interval)) for keys in revoked)
        return Fault.REVOKED_CHAIN if is_revoked else Fault.BAD_CODE

    def _note_offset(self, anchor: int, unix_s: float, offset_s: float) -> None:
        known = self._offsets.get(anchor)
        if known is None or abs(unix_s - known.since_s) > RECENT_S:
            known = self._offsets[anchor] = _Offset(unix_s)
        known.add(unix_s, offset_s)

    def _clocks(self, timing: ChainTiming, unix_s: float) -> tuple[int, int]:
        """Number of other anchors' clocks far from the own one, and near it."""
        recent = [one for one in self._offsets.values() if abs(unix_s - one.since_s) <= RECENT_S]
        far = sum(one.is_far(timing) for one in recent)
        return far, len(recent) - far

    def _may_disclose(self, timing: ChainTiming) -> bool:
        """Whether other anchors confirm the own clock: a key disclosed too early lets anybody make codes.

        Nobody misses this anchor's keys, as others disclose the same ones.
        """
        assert self._now is not None
        unix_s = self._now[1]
        far, near = self._clocks(timing, unix_s)
        return unix_s >= self._no_keys_until_s and near > 0 and near >= far

    def _unix_s(self, ticks: int) -> float:
        assert self._now is not None
        return self._now[1] + difference(ticks, self._now[0]) * TICK_S


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
