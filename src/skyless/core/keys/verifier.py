"""``Verifier``: verification of beacons with the site's public key. Frames in, decisions about them out.

A frame waits until the key of its interval is disclosed; its code then shows whether an anchor of the site made it. A
frame is accepted only if it was received before any anchor can have disclosed that key: afterwards anybody could have
made it.
"""

import math
from collections import Counter, deque
from typing import TYPE_CHECKING, Final

from msgspec import Struct

from skyless.core.air.almanac import KeyPage
from skyless.core.air.beacon import INTERVAL_BITS, Authentication, Beacon, signed_bytes
from skyless.core.air.frame import Reception
from skyless.core.keys.chain import SECTION_BITS, SECTION_INTERVALS, ChainTiming, is_mac, section_of
from skyless.core.keys.fault import NOT_FORGED, Fault
from skyless.core.keys.known_keys import Arrivals, KeyUse, KnownKeys, Stamps
from skyless.core.ticks import TICK_S, Unwrapper, from_seconds, nearest

if TYPE_CHECKING:
    from collections.abc import Iterable

    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey

# What a listener knows of the site's time: how late it may be, and whether its own clock is right.

DRIFT: Final = 50e-6
"""Largest relative error of the own counter's rate."""

KEY_WAIT_INTERVALS: Final = 2
"""The newest key was disclosed within this number of intervals, judged by the fastest recent one."""

RECENT_KEYS: Final = 10
"""Number of recent keys. The one received soonest after its disclosure shows the error of the host's clock."""

AHEAD_S: Final = 1.0
"""A host's clock further ahead of the lower bound has been set; without keys that bound loses 0.2 s an hour."""

RESTART_S: Final = 1.0
"""A counter that goes back further has restarted."""


class SiteClock(Struct):
    """Bounds of the site's time, that of the anchor whose clock is furthest ahead, in Unix seconds.

    Only keys prove a lower bound, which the own counter continues. The upper bound comes from the host's clock and its
    stated error. A host's clock that is set or dragged back lowers it no further than to shortly after the lower bound.
    One that is ahead raises it only while it is ahead: frames are refused as late then, with no effect afterwards.
    """

    bound_s: float
    """Largest error of the host's clock."""
    lower_s: float = -math.inf
    """Lower bound; none before the first key, and after a restart of the counter."""
    rx_ticks: int | None = None
    """Own counter, unwrapped, at the lower bound."""
    is_late: bool = False
    """Whether a verified key proved the site's time to be beyond the upper bound: nothing can be verified then."""
    host_s: float = 0.0
    """The host's clock at the last frame."""
    section_offset_s: float = 0.0
    """Host's clock minus the beginning of the last certificate's section, if far from it."""
    offsets_s: deque[float] = deque()
    """Host's clock minus the disclosure of recent keys, at their first reception."""

    def advance(self, rx_ticks: int, unix_s: float) -> None:
        """Advance to the reception of a frame: own counter, unwrapped, and host's clock."""
        self.host_s = unix_s
        elapsed_s = 0.0 if self.rx_ticks is None else (rx_ticks - self.rx_ticks) * TICK_S
        if elapsed_s < -RESTART_S:
            self.lower_s = -math.inf
        elif elapsed_s < 0.0:
            return  # out of order
        self.lower_s += elapsed_s * (1.0 - DRIFT)
        self.rx_ticks = rx_ticks

    def upper_s(self, timing: ChainTiming) -> float:
        """Upper bound of the site's time."""
        return max(self.upper_at(self.host_s, timing), self.lower_s + KEY_WAIT_INTERVALS * timing.interval_s)

    def upper_at(self, unix_s: float, timing: ChainTiming) -> float:
        """Upper bound from the host's clock alone, at the time when it showed ``unix_s``."""
        return unix_s + self.bound_s + timing.anchor_lead_s

    def on_key(self, interval: int, timing: ChainTiming) -> None:
        """A key was verified for the first time: the site's time is not before its disclosure."""
        disclosed_s = timing.start_s(interval + timing.lag)
        self.offsets_s.append(self.host_s - disclosed_s)
        if len(self.offsets_s) > RECENT_KEYS:
            self.offsets_s.popleft()
        self.is_late = disclosed_s > self.upper_s(timing)
        if not self.is_late:
            self.lower_s = max(self.lower_s, disclosed_s)

    def on_section(self, section: int, timing: ChainTiming) -> None:
        """A certificate was received, which anchors send during its section or the one before."""
        offset_s = self.host_s - timing.start_s(section << SECTION_BITS)
        length_s = SECTION_INTERVALS * timing.interval_s
        self.section_offset_s = 0.0 if -length_s - self.bound_s <= offset_s <= length_s + self.bound_s else offset_s

    @property
    def is_verified(self) -> bool:
        """Whether a key has been verified since the counter started."""
        return self.lower_s > -math.inf

    @property
    def present_s(self) -> float:
        """The host's clock, but not before the lower bound."""
        return max(self.host_s, self.lower_s)

    @property
    def error_s(self) -> float | None:
        """Error of the host's clock if it exceeds the bound: positive if ahead; None if within it or unknown.

        If it is ahead, frames may also be late because somebody has delayed them.
        """
        if not self.is_verified and self.section_offset_s:
            return self.section_offset_s
        ahead_s = self.host_s - self.lower_s
        if self.is_verified and ahead_s > self.bound_s + AHEAD_S:
            return ahead_s
        if not self.offsets_s:
            return None
        offset_s = min(self.offsets_s)
        return offset_s if abs(offset_s) > self.bound_s else None


MAX_UNDECIDED: Final = 8192
"""Most waiting frames: more than a radio can receive before their keys come, one after the other, 0.1 ms each."""

LONGEST_WAIT_TICKS: Final = from_seconds(2.0)
"""A frame without a key after this time is dropped, so that fixes continue with later ones."""

FAULT_TICKS: Final = from_seconds(2.0)
"""A fault is reported for this time after its last occurrence."""

CODES_KEPT: Final = 2048
"""Codes remembered, at least: more than in all intervals whose frames are still accepted."""

MAX_FAULTY_ANCHORS: Final = 64
"""Most anchors with remembered faults: forged frames can name any."""


class ReceivedFrame(Struct, frozen=True, gc=False):
    """A frame with a code, waiting for its key or decided."""

    beacon: Beacon
    authentication: Authentication
    reception: Reception
    rx_ticks: int
    """Own counter, unwrapped."""
    unix_s: float
    """The host's clock at reception."""
    interval: int | None
    """Number of the interval; None without a certificate so far, so that the frame's time is still to be checked."""
    is_plausible: bool
    """Whether its stamps continue its anchor's genuine frames; also True before any genuine frame."""


class _AnchorFault(Struct, frozen=True, gc=False):
    """The last fault of an anchor, or of frames that name it."""

    fault: Fault
    rx_ticks: int


class Verifier:
    """Verifies the beacons of one site. No I/O; reads no clock."""

    def __init__(
        self,
        site: int,
        public: "Ed25519PublicKey",
        clock_bound_s: float,
        counters: Counter[str],
        *,
        least_serial: int = 0,
        certificates: "Iterable[bytes]" = (),
    ) -> None:
        """``clock_bound_s``: largest difference of the host's clock from those of anchors.

        ``certificates``: those of an earlier run.
        """
        self.keys = KnownKeys(site, public, least_serial, certificates)
        self.clock = SiteClock(clock_bound_s, offsets_s=deque())
        self._counters = counters
        self._own_ticks = Unwrapper()
        self._waiting: deque[ReceivedFrame] = deque()
        self._faults: dict[int, _AnchorFault] = {}
        self._arrivals = Arrivals()
        self._codes: set[bytes] = set()
        self._codes_before: set[bytes] = set()
        """Codes of recent genuine frames; a second frame with one of them is a repetition."""
        self._anchors: set[int] = set()
        """Anchors that have sent a genuine frame."""
        self.newest_ticks = 0
        """Reception of the site's last frame: own counter, unwrapped."""
        self._has_new_key = False

    def waiting(self) -> "Iterable[ReceivedFrame]":
        """Undecided frames in order of reception."""
        return tuple(self._waiting)

    def faults(self) -> dict[int, Fault]:
        """Anchors with a fault within the last seconds."""
        oldest = self.newest_ticks - FAULT_TICKS
        return {anchor: one.fault for anchor, one in self._faults.items() if one.rx_ticks > oldest}

    def add(self, beacon: Beacon, reception: Reception, unix_s: float) -> ReceivedFrame | None:
        """Process a beacon of the site, received at this time of the host's clock.

        Returns the frame if it now waits for its key, None if it was refused.
        """
        rx_ticks = self._own_ticks.unwrap(reception.rx_ticks, reception.host_s)
        self.newest_ticks = rx_ticks
        clock = self.clock
        clock.advance(rx_ticks, unix_s)
        if beacon.certificate is not None:
            self._on_certificate(beacon.anchor, beacon.certificate, rx_ticks)
        stated = beacon.authentication
        if stated is None:
            self._refuse(beacon.anchor, Fault.NO_CODE, rx_ticks)
            return None
        timing, interval = self.keys.timing, None
        if timing is not None:
            present = timing.interval_at(clock.upper_s(timing))
            interval = nearest(stated.interval, present, INTERVAL_BITS)
            fault = _time_fault(interval, present, timing.lag)
            if isinstance(beacon.page, KeyPage):
                self._on_key(
                    beacon.page.key, interval - timing.lag, beacon.anchor, timing, is_early=fault is Fault.EARLY
                )
            if fault is None and interval <= self.keys.newest:
                fault = Fault.LATE
            if fault is not None:
                self._refuse(beacon.anchor, fault, rx_ticks)
                return None
        if len(self._waiting) >= MAX_UNDECIDED:
            self._counters[Fault.TOO_MANY] += 1
            return None
        is_plausible = self._arrivals.is_plausible(Stamps(beacon.anchor, rx_ticks, beacon.tx_ticks))
        frame = ReceivedFrame(beacon, stated, reception, rx_ticks, unix_s, interval, is_plausible)
        self._waiting.append(frame)
        return frame

    def decided(self) -> list[tuple[ReceivedFrame, Fault | None]]:
        """Newly decided frames in order of reception, each once. The fault is None for a genuine frame."""
        by_code: list[tuple[ReceivedFrame, Fault | None]] = []
        waiting = self._waiting
        oldest = self.newest_ticks - LONGEST_WAIT_TICKS
        if not self._has_new_key and (not waiting or waiting[0].rx_ticks > oldest):
            return []
        self._has_new_key, timing = False, self.keys.timing
        can_decide = timing is not None and not self.clock.is_late
        while waiting:
            one = waiting[0]
            fault = self._fault(one, timing) if can_decide and timing is not None else Fault.NO_KEY
            if fault is Fault.NO_KEY and one.rx_ticks > oldest and not self._is_key_lost(one):
                break
            waiting.popleft()
            by_code.append((one, fault))
        genuine = [one for one, fault in by_code if fault is None]
        stamps = [Stamps(one.beacon.anchor, one.rx_ticks, one.beacon.tx_ticks) for one in genuine]
        arrivals = iter(self._arrivals.faults(stamps))
        decided = [(one, next(arrivals) if fault is None else fault) for one, fault in by_code]
        for one, fault in decided:
            if fault in NOT_FORGED:
                self._counters[fault] += 1
            elif fault is not None:
                self._refuse(one.beacon.anchor, fault, one.rx_ticks)
        return decided

    def _fault(self, one: ReceivedFrame, timing: ChainTiming) -> Fault | None:
        """The fault of a frame; ``NO_KEY`` while the key of its interval is unknown."""
        interval = one.interval
        if interval is None:
            present = timing.interval_at(self.clock.upper_at(one.unix_s, timing))
            interval = nearest(one.authentication.interval, present, INTERVAL_BITS)
            fault = _time_fault(interval, present, timing.lag)
            if fault is not None:
                return fault
        key = self.keys.mac_key(interval)
        if key is None:
            return Fault.NO_KEY
        mac = one.authentication.mac
        if not is_mac(signed_bytes(one.reception.frame), mac, key):
            return Fault.BAD_CODE
        if mac in self._codes or mac in self._codes_before:
            return Fault.REPEATED
        self._codes.add(mac)
        if len(self._codes) >= CODES_KEPT:
            self._codes, self._codes_before = set(), self._codes
        self._anchors.add(one.beacon.anchor)
        return None

    def _is_key_lost(self, one: ReceivedFrame) -> bool:
        """Whether a later key is known but not this frame's: a section has ended, or begun, in between."""
        return one.interval is not None and one.interval <= self.keys.newest and not self.clock.is_late

    def _on_certificate(self, anchor: int, sent: bytes, rx_ticks: int) -> None:
        use = self.keys.on_certificate(sent, self.clock.present_s)
        if use is KeyUse.FORGED:
            self._counters["forged-certificate"] += 1
            return
        timing = self.keys.timing
        if use is KeyUse.REVOKED:
            self._refuse(anchor, Fault.REVOKED_CHAIN, rx_ticks)
        elif use is not KeyUse.IGNORED and timing is not None:
            self.clock.on_section(section_of(sent), timing)

    def _on_key(self, key: bytes, interval: int, anchor: int, timing: ChainTiming, *, is_early: bool) -> None:
        newest = self.keys.newest
        use = self.keys.on_key(key, interval, self.clock.present_s, anchor, is_expected=not is_early)
        if use is KeyUse.NEW:
            self._has_new_key = True
            if interval > newest:
                self.clock.on_key(interval, timing)
        elif use is KeyUse.FORGED:
            self._counters["forged-key"] += 1

    def _refuse(self, anchor: int, fault: Fault, rx_ticks: int) -> None:
        """Count a refused frame, and remember its anchor's fault."""
        self._counters[fault] += 1
        before = self._faults.pop(anchor, None)
        if before is not None and before.fault is Fault.REVOKED_CHAIN and rx_ticks - before.rx_ticks < FAULT_TICKS:
            self._faults[anchor] = before if fault is not Fault.REVOKED_CHAIN else _AnchorFault(fault, rx_ticks)
            return
        if len(self._faults) >= MAX_FAULTY_ANCHORS:
            strangers = (one for one in self._faults if one not in self._anchors)
            del self._faults[next(strangers, next(iter(self._faults)))]
        self._faults[anchor] = _AnchorFault(fault, rx_ticks)


def _time_fault(interval: int, present: int, lag: int) -> Fault | None:
    """The fault of a frame received in another interval than its own, or before it."""
    if interval + lag <= present:
        return Fault.LATE
    return Fault.EARLY if interval > present else None
