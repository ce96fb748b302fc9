"""A tag's receptions for recorders, in segments that begin with the receiver's settings.

A segment begins when a new requester asks, and after every gap; within it nothing is missing. No I/O and no clock:
times are passed in, by any monotonic clock.
"""

from collections import Counter, deque
from typing import Final

import msgspec
from msgspec import Struct

from skyless.core.air.frame import Diagnostics, Reception
from skyless.core.any_receiver import AnyReceiver
from skyless.core.integrity import RISK, IntegrityRequirement
from skyless.core.method_names import METHODS
from skyless.core.tag.receiver import TagReceiver
from skyless.run.mqtt.messages import Leases, RawReception, ReceptionsMessage, RequestMessage, SegmentStart

EVERY_TAG: Final = "*"
INTERVAL_S: Final = 0.1
"""Receptions of this period go into one message."""
MAX_PENDING_RECEPTIONS: Final = 4096
"""Largest number of uncollected receptions; beyond it the segment ends."""

Settings = dict[str, str | float | int | None]


class ReceptionLog:
    """The receptions of one tag, kept while somebody requests them."""

    def __init__(self, tag: str, settings: Settings, run: str) -> None:
        """``settings``: the receiver's arguments (``receiver_settings``); ``run`` names this start of the tag."""
        self.counters: Counter[str] = Counter()
        self._tag = tag
        self._settings = settings
        self._run = run
        self._leases = Leases()
        self._segments = 0
        self._open = False
        self._receiver: TagReceiver | None = None
        self._start: SegmentStart | None = None
        self._first = 0
        self._pending: list[RawReception] = []
        self._ready: deque[ReceptionsMessage] = deque()
        self._sent_s = 0.0
        self._unix_less_host_s = 0.0

    @property
    def wanted(self) -> bool:
        """Whether any lease is held."""
        return self._leases.are_held

    def request(self, message: RequestMessage, now_s: float) -> None:
        """Process a request; a new requester, or one whose lease has ended, begins another segment."""
        self._end_leases(now_s)
        if not {self._tag, EVERY_TAG} & set(message.receptions):
            self._leases.end(message.by)
            return
        is_new = not self._leases.holds(message.by)
        if not self._leases.grant(message.by, message.lease_s, now_s):
            self.counters["lease-refused"] += 1
        elif is_new:
            self.interrupt()

    def add(self, receiver: TagReceiver, reception: Reception) -> None:
        """Add a reception before the receiver hears it."""
        if not self._leases.are_held:
            return
        if len(self._pending) >= MAX_PENDING_RECEPTIONS:
            self.counters["not-collected"] += len(self._pending)
            self._pending.clear()
            self._open = False
        if receiver is not self._receiver:  # the radio was restarted, and the tag with it
            self.interrupt()
            self._receiver = receiver
        if not self._open:
            self._open, self._first = True, 0
            self._segments += 1
            self._start = SegmentStart(self._settings)
        self._pending.append(raw(reception))

    def collect(self, now_s: float, unix_less_host_s: float) -> ReceptionsMessage | None:
        """Return the next message that is due; call this until it returns None, some twenty times a second.

        ``unix_less_host_s`` is added to the receptions' ``host_s`` to get Unix time.
        """
        self._unix_less_host_s = unix_less_host_s
        self._end_leases(now_s)
        if not 0.0 <= now_s - self._sent_s < INTERVAL_S:
            self._sent_s = now_s
            self._close_message()
        return self._ready.popleft() if self._ready else None

    def interrupt(self) -> None:
        """End the segment, because a message was lost or a requester joined."""
        self._close_message()
        self._open = False

    def _close_message(self) -> None:
        """Make a message from the pending receptions."""
        if not self._pending:
            return
        self._ready.append(
            ReceptionsMessage(
                tag=self._tag,
                segment=f"{self._run}-{self._segments}",
                first=self._first,
                unix_less_host_s=self._unix_less_host_s,
                receptions=tuple(self._pending),
                start=self._start,
            )
        )
        self._first += len(self._pending)
        self._pending.clear()
        self._start = None

    def _end_leases(self, now_s: float) -> None:
        self._leases.expire(now_s)
        if not self._leases.are_held and self._open:
            self.interrupt()


class _TagSettings(Struct, frozen=True):
    """Settings of a tag's program, with defaults for those that a recording lacks; older ones hold more, of no use."""

    method: str | None = None
    site: int | None = None
    z_low_m: float | None = None
    z_high_m: float | None = None
    integrity_risk: float = RISK
    alert_limit_m: float | None = None
    height_std_m: float = 0.0


def receiver_settings(
    method: str,
    site: int | None = None,
    integrity: IntegrityRequirement = IntegrityRequirement(),  # noqa: B008 - a frozen value
) -> Settings:
    """The receiver's arguments as a segment states them."""
    risk, limit_m, std_m = integrity.risk, integrity.alert_limit_m, integrity.height_std_m
    asked = _TagSettings(method, site, integrity_risk=risk, alert_limit_m=limit_m, height_std_m=std_m)
    return msgspec.structs.asdict(asked)


def receiver_of(
    settings: Settings, method: str | None = None, integrity: IntegrityRequirement | None = None
) -> AnyReceiver | None:
    """A receiver with the settings of a segment, or this method and requirement; None if they are invalid."""
    try:
        known = msgspec.convert(settings, _TagSettings)
        integrity = integrity or IntegrityRequirement(known.integrity_risk, known.alert_limit_m, known.height_std_m)
    except (msgspec.ValidationError, ValueError, TypeError):
        return None
    name = method or known.method
    if name not in METHODS:
        return None
    bounds_m = None if known.z_low_m is None or known.z_high_m is None else (known.z_low_m, known.z_high_m)
    return AnyReceiver(name, site=known.site, z_bounds_m=bounds_m, integrity=integrity)


def raw(reception: Reception) -> RawReception:
    """Convert a reception to its published form."""
    diagnostics = reception.diagnostics or Diagnostics()
    return RawReception(
        reception.frame,
        reception.rx_ticks,
        reception.host_s,
        diagnostics.rx_power_dbm,
        diagnostics.first_path_power_dbm,
        diagnostics.carrier_offset_ppm,
        reception.carrier_phase_cycles,
    )
