"""What an anchor with keys adds to its frames, and how it verifies those of others: it knows all keys, so at once."""

import math
from collections.abc import Iterable
from typing import Final

from msgspec import Struct

from skyless.core.air.almanac import KeyPage, Page
from skyless.core.air.beacon import Beacon
from skyless.core.air.codec import INTERVAL_BITS, signed_bytes, with_authentication
from skyless.core.air.local_almanac import site_page_for
from skyless.core.air.reception import Reception
from skyless.core.constants import TICK_S
from skyless.core.keys.chain import Chain, ChainKeys, ChainRing
from skyless.core.keys.fault import Fault
from skyless.core.keys.key_chain import ChainTiming, is_mac, mac_of
from skyless.core.ticks import difference, nearest

CERTIFICATE_S: Final = 0.5
CERTIFICATE_EVERY: Final = (8, 16, 32)
"""An anchor sends a certificate about twice a second, in one of 8, 16 or 32 frames: such a frame has no relays. Every
fourth certificate is that of what comes next."""
_SUCCESSOR_EVERY: Final = 4

FAR_S: Final = 10.0
"""Codes of intervals farther from the present are not checked: anybody can state any, and their keys take long."""

NO_KEYS_S: Final = 2.0
"""No key is disclosed for this time after a start and after a step of the host's clock: others may find it wrong."""

RECENT_S: Final = 2.0
SPACINGS: Final = 3.0
"""An anchor's first frame in an interval comes within this number of its mean times between two frames."""
MIN_OTHERS: Final = 2
"""Own clock against this number of others: with one it is not known which of the two is wrong."""


class Contents(Struct, frozen=True, gc=False):
    """What authentication puts in the next frame."""

    interval: int | None = None
    """Under whose key the frame is; None without authentication."""
    certificate: bytes | None = None
    key: KeyPage | None = None

    def page(self, pages: tuple[Page, ...], sequence: int, anchor: int) -> Page | None:
        """The page of the frame: a key, else one of the site's; none with a certificate."""
        if self.certificate is not None:
            return None
        return self.key or site_page_for(pages, sequence if self.interval is None else sequence >> 1, anchor)


class _Offset(Struct):
    """How far another anchor's clock is behind the own one, by its frames of the present second and the one before.

    A frame shows what it is after the beginning of its interval, and the least of many is hardly more than the clocks'
    difference. Repeated old frames show more, so they do no harm.
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
        """Whether the clocks are too far apart for any instants at which that anchor may send."""
        least_s = min(self.present_s, self.before_s)
        latest_s = min(SPACINGS / self.frames_before, timing.interval_s) if self.frames_before else timing.interval_s
        return least_s < -timing.anchors_apart_s or least_s > timing.anchors_apart_s + latest_s


class BeaconAuthentication:
    """Keys, time and neighbours of one anchor, as far as authentication needs them. No I/O, no clock of its own."""

    def __init__(self, chains: Iterable[Chain], no_keys_s: float = NO_KEYS_S) -> None:
        """``no_keys_s``: how long no key is disclosed after a start; 0 for an anchor that has been on before."""
        self.faults: dict[int, tuple[Fault, float]] = {}
        """The last fault of each other anchor, or of frames in its name, and when it was, in Unix seconds."""
        self._ring = ChainRing(chains)
        self._now: tuple[int, float] | None = None
        self._offsets: dict[int, _Offset] = {}
        self._no_keys_s, self._no_keys_until_s = no_keys_s, 0.0

    def set_chains(self, chains: Iterable[Chain]) -> None:
        """Use these chains from now on: a successor, or one instead of a revoked one."""
        self._ring = ChainRing(chains)

    def set_time(self, now_ticks: int, unix_s: float) -> None:
        """The own counter (40 bits) and the host's clock at the same moment; needed every few seconds."""
        timing = self._ring.timing
        step_s = math.inf if self._now is None else abs(unix_s - self._unix_s(now_ticks))
        if timing is not None and step_s > timing.anchors_apart_s:
            self._no_keys_until_s = unix_s + self._no_keys_s
        self._now = (now_ticks, unix_s)

    def fault(self) -> Fault | None:
        """Why own frames are sent without a code; None where they have one."""
        timing = self._ring.timing
        if self._now is None or timing is None:
            return Fault.NO_TIME if self._now is None else Fault.NO_CHAIN
        far, near = self._clocks(timing, self._now[1])
        if far > near and near < MIN_OTHERS <= far:
            return Fault.CLOCK_WRONG
        return None if self._ring.at(timing.interval_at(self._now[1])) is not None else Fault.NO_CHAIN

    def contents(self, tx_ticks: int, sequence: int, anchor: int, period_s: float) -> Contents:
        """What the frame with this TX stamp (40 bits) is to hold; ``period_s``: mean time between two frames."""
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
        """The frame with its code."""
        keys = None if interval is None else self._ring.at(interval)
        if keys is None or interval is None:
            return frame
        key = keys.mac_key(interval)
        return with_authentication(frame, interval & (1 << INTERVAL_BITS) - 1, lambda signed: mac_of(signed, key))

    def fault_of(self, beacon: Beacon, reception: Reception) -> Fault | None:
        """Why a beacon of another anchor is not used; None where it is genuine, or the own chains do not hold now."""
        timing = self._ring.timing
        if self._now is None or timing is None:
            return Fault.NO_TIME if self._now is None else None
        unix_s = self._unix_s(reception.rx_ticks)
        fault = self._fault_of(beacon, reception.frame, unix_s, timing)
        if fault is not None:
            self.faults[beacon.anchor] = (fault, unix_s)
        return fault

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
        """How many of the other anchors' clocks are far from the own one, and how many near."""
        recent = [one for one in self._offsets.values() if abs(unix_s - one.since_s) <= RECENT_S]
        far = sum(one.is_far(timing) for one in recent)
        return far, len(recent) - far

    def _may_disclose(self, timing: ChainTiming) -> bool:
        """Whether other anchors confirm the own clock: a key that is disclosed too early lets anybody make codes.

        Without keys of this anchor nobody lacks any, as others disclose the same ones.
        """
        assert self._now is not None
        unix_s = self._now[1]
        far, near = self._clocks(timing, unix_s)
        return unix_s >= self._no_keys_until_s and near > 0 and near >= far

    def _unix_s(self, ticks: int) -> float:
        assert self._now is not None
        return self._now[1] + difference(ticks, self._now[0]) * TICK_S
