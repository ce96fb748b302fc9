"""``TrustedReceiver``: a tag that verifies beacons with its site's public key. Like ``Receiver`` it does no I/O.

It runs a ``Receiver`` on verified frames, 0.4 to 0.6 s behind. With trust ``verified``, the fixes are those of this
receiver. With trust ``open``, a second, live receiver processes each plausible frame at once and gives the fixes. If a
frame that it used turns out to be forged, it continues from the state of the first receiver: at once if forged frames
are few, otherwise once they have become few. Until then the fixes are those of verified frames.
"""

import copy
from collections import Counter, deque
from collections.abc import Iterable
from enum import StrEnum
from typing import TYPE_CHECKING, Final

from msgspec import Struct
from msgspec.structs import replace

from skyless.core.air.beacon import Beacon
from skyless.core.air.frame import Malformed, Reception
from skyless.core.any_receiver import decode_any
from skyless.core.fix import Fix
from skyless.core.keys.chain import public_key
from skyless.core.keys.fault import NOT_FORGED, Fault
from skyless.core.keys.verifier import LONGEST_WAIT_TICKS, ReceivedFrame, Verifier
from skyless.core.tag.receiver import Receiver
from skyless.core.ticks import TICK_S, FixTime, from_seconds

if TYPE_CHECKING:
    from collections.abc import Callable

SHARE_TICKS: Final = from_seconds(1.0)
"""Shares refer to the beacons of this time."""

MAX_IN_SHARE: Final = 4096
"""More frames than a radio receives in that time."""

MAX_FORGED: Final = 0.1
"""Largest ratio of forged to genuine plausible frames at which live fixes are given. So few are left to the gates and
consistency checks of the estimator; with more, only verified frames give fixes."""


class Trust(StrEnum):
    """Which fixes a tag gives."""

    OPEN = "open"
    """Each one at once, unless frames are forged; each states how far it is verified."""
    VERIFIED = "verified"
    """Only those of verified beacons, 0.4 to 0.6 s later."""


class SiteTrust(Struct, frozen=True):
    """Which beacons a tag accepts."""

    site: int
    public: bytes
    """The site's public key, 32 bytes."""
    least_serial: int = 0
    """Key chains with lower serial numbers are revoked."""
    trust: Trust = Trust.OPEN
    clock_bound_s: float = 0.1
    """Largest difference between the tag's clock and those of the anchors."""


class GivenFix(Struct, frozen=True, gc=False):
    """A fix and the reception that made it, the last one used."""

    fix: Fix
    reception: Reception


class TrustedReceiver:
    """A listening tag with its site's public key."""

    def __init__(
        self, trust: SiteTrust, new_receiver: "Callable[[], Receiver]", certificates: Iterable[bytes] = ()
    ) -> None:
        """``new_receiver`` creates a receiver that has heard nothing; ``certificates``: those of an earlier run.

        Raises:
            ValueError: the public key is not 32 bytes long.
        """
        self.trust = trust
        self.counters: Counter[str] = Counter()
        """Frames that were refused, by the reason."""
        self.verifier = Verifier(
            trust.site,
            public_key(trust.public),
            trust.clock_bound_s,
            self.counters,
            least_serial=trust.least_serial,
            certificates=certificates,
        )
        self._verified = new_receiver()
        self._live = new_receiver() if trust.trust is Trust.OPEN else None
        """None with trust ``verified``, and after forged frames."""
        self._forged_ticks: deque[int] = deque(maxlen=MAX_IN_SHARE)
        """Reception times of the last seconds' plausible frames that turned out to be forged."""
        self._genuine_ticks: deque[int] = deque(maxlen=MAX_IN_SHARE)
        """Reception times of the last second's verified frames."""
        self._verified_ticks: int | None = None
        """Reception time of the newest verified frame."""
        self._used = 0
        """Number of waiting frames that the live receiver has used."""
        self._live_ticks: int | None = None
        """Reception time of the last of these."""
        self._given_ticks: int | None = None
        self._first_time: FixTime | None = None
        """Origin of the times of fixes."""

    @property
    def receiver(self) -> Receiver:
        """The receiver whose fixes are given."""
        return self._verified if self._live is None else self._live

    @property
    def is_verified(self) -> bool:
        """Whether any beacon of the last seconds is verified."""
        until_ticks = self._verified_ticks
        return until_ticks is not None and self.verifier.newest_ticks - until_ticks < LONGEST_WAIT_TICKS

    def faults(self) -> dict[int, Fault]:
        """Anchors whose beacons, or beacons in whose name, were refused within the last seconds."""
        return self.verifier.faults()

    def hear(self, reception: Reception, unix_s: float) -> list[GivenFix]:
        """Process a frame from the air, received at this time of the host's clock. Returns new fixes in order of time.

        No frame raises.
        """
        beacon = decode_any(reception.frame)
        if isinstance(beacon, Malformed):
            self.counters[beacon] += 1
            return []
        if not isinstance(beacon, Beacon) or beacon.site != self.trust.site:
            self.counters["foreign-site"] += 1
            return []
        frame = self.verifier.add(beacon, reception, unix_s)
        given = self._verify()
        if frame is not None:
            given += self._use(frame)
        later = []
        for rx_ticks, one in given:
            if self._given_ticks is None or rx_ticks > self._given_ticks:
                self._given_ticks = rx_ticks
                later.append(one)
        return later

    def _use(self, frame: ReceivedFrame) -> list[tuple[int, GivenFix]]:
        """Pass a plausible frame that the live receiver has not processed yet to it. Returns its fix."""
        if self._live is None or not frame.is_plausible or frame.rx_ticks == self._live_ticks:
            return []
        self._used += 1
        self._live_ticks = frame.rx_ticks
        fix = self._live.hear_beacon(frame.beacon, frame.reception)
        if fix is None:
            return []
        self._first_time = self._first_time or copy.copy(self._live.admission.time)
        return [(frame.rx_ticks, GivenFix(self._with_trust(fix, frame.rx_ticks), frame.reception))]

    def _verify(self) -> list[tuple[int, GivenFix]]:
        """Process the decided frames. Returns the fixes of genuine ones, and of a live receiver that returns."""
        given, is_other = [], False
        for one, fault in self.verifier.decided():
            if self._live is not None and one.is_plausible:
                self._used -= 1
            is_other |= one.is_plausible is not (fault is None)
            if fault is not None:
                if one.is_plausible and fault not in NOT_FORGED:
                    self._forged_ticks.append(one.rx_ticks)
                continue
            if self._verified_ticks is None:
                self._begin_verified()
            self._verified_ticks = one.rx_ticks
            self._genuine_ticks.append(one.rx_ticks)
            fix = self._verified.hear_beacon(one.beacon, one.reception)
            if fix is not None:
                given.append((one.rx_ticks, GivenFix(self._with_trust(fix, one.rx_ticks), one.reception)))
        if self.trust.trust is Trust.OPEN:
            if self._is_attacked():
                self._leave_live()
            elif self._live is None or is_other:
                given += self._return_live()
        return given

    def _begin_verified(self) -> None:
        """Let the verified receiver count time from the live one's first fix."""
        if self._live is None or self._first_time is None or self._verified.counters["fixes"]:
            return
        self._verified.continue_time_of(self._live, self._first_time)

    def _is_attacked(self) -> bool:
        """Whether many of the last seconds' plausible frames have turned out to be forged."""
        oldest_ticks = self.verifier.newest_ticks - SHARE_TICKS
        return _since(oldest_ticks, self._forged_ticks) > MAX_FORGED * _since(oldest_ticks, self._genuine_ticks)

    def _leave_live(self) -> None:
        """Give fixes of verified frames only, because the live receiver has used forged ones or would have."""
        if self._live is not None:
            self._begin_verified()
            self._verified.counters |= self._live.counters  # what is reported must not go back
        self._live, self._used = None, 0

    def _return_live(self) -> list[tuple[int, GivenFix]]:
        """Continue the live receiver from the verified one with the plausible frames that wait. Returns its fixes."""
        self._live = self._verified.copied()
        self._used, self._live_ticks = 0, None
        return [given for one in self.verifier.waiting() for given in self._use(one)]

    def _with_trust(self, fix: Fix, rx_ticks: int) -> Fix:
        """The fix with the extent of its verification filled in."""
        until_ticks = self._verified_ticks
        if until_ticks is None:
            return fix
        unverified = self._used if rx_ticks > until_ticks else 0
        share = unverified / max(unverified + _since(rx_ticks - SHARE_TICKS, self._genuine_ticks), 1)
        return replace(fix, verified_until_s=fix.time_s - max(rx_ticks - until_ticks, 0) * TICK_S, unverified=share)


def _since(oldest_ticks: int, ticks: deque[int]) -> int:
    """Number of receptions since a time; drops earlier ones."""
    while ticks and ticks[0] < oldest_ticks:
        ticks.popleft()
    return len(ticks)
