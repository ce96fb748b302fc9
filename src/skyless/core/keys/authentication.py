"""What an anchor with keys adds to its frames, and how it verifies those of others: it knows all keys, so at once."""

import math
from collections.abc import Iterable
from typing import Final

from msgspec import Struct

from skyless.core.air.almanac import KeyPage, Page
from skyless.core.air.beacon import INTERVAL_BITS, Beacon, signed_bytes, with_authentication
from skyless.core.air.frame import Reception
from skyless.core.keys.chain import Chain, ChainKeys, ChainRing, ChainTiming, is_mac, mac_of
from skyless.core.keys.fault import Fault
from skyless.core.pages import site_page_for
from skyless.core.ticks import TICK_S, difference, nearest

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
