"""A tag's receptions for recorders, in segments that begin with the receiver's state.

A segment begins when a new requester asks, and after every gap; within it nothing is missing. The state lets a replay
start in the middle of a tag's life and continue bit for bit. No I/O and no clock: times are passed in, by any monotonic
clock.
"""

from collections import Counter, deque
from importlib.metadata import version
from typing import Final

import msgspec
import numpy as np
from msgspec import Struct

from skyless.core.air.frame import Diagnostics, Reception
from skyless.core.any_receiver import AnyReceiver, AnyReceiverState
from skyless.core.arrays import Array
from skyless.core.integrity import IntegrityRequirement
from skyless.core.tag.receiver import ReceiverState, TagReceiver
from skyless.run.mqtt.messages import Leases, RawReception, ReceptionsMessage, RequestMessage, SegmentStart

_FORMAT: Final = 21
_MAX_BYTES: Final = 1 << 23
"""Size limit of a checkpoint; enough for an estimator of a hundred anchors."""


class _Header(Struct, frozen=True):
    """Header of every checkpoint."""

    format: int
    version: str


class _Checkpoint(_Header, frozen=True):
    receiver: AnyReceiverState | ReceiverState


class RefusedError(Exception):
    """A checkpoint cannot be used. ``reason`` is the key under which it is counted."""

    def __init__(self, reason: str) -> None:
        super().__init__(reason)
        self.reason = reason


def save(receiver: TagReceiver) -> bytes:
    """Serialise the receiver's whole state."""
    checkpoint = _Checkpoint(_FORMAT, version("skyless"), receiver.state())  # type: ignore[arg-type]  # of these two
    return _ENCODER.encode(checkpoint)


def load(state: bytes) -> AnyReceiver:
    """Restore the receiver from ``state``.

    Raises:
        RefusedError: ``checkpoint-of-another-version``, ``checkpoint-damaged``.
    """
    if len(state) > _MAX_BYTES:
        raise RefusedError("checkpoint-damaged")
    try:
        header = msgspec.msgpack.decode(state, type=_Header)
        if header.format != _FORMAT or header.version != version("skyless"):
            raise RefusedError("checkpoint-of-another-version")
        return AnyReceiver.from_state(_DECODER.decode(state).receiver)
    except (msgspec.MsgspecError, ValueError, ArithmeticError, LookupError, AssertionError, RecursionError):
        raise RefusedError("checkpoint-damaged") from None


def _encode_array(value: object) -> bytes:
    """Encode a position, the only array in a state that is not bytes already."""
    assert isinstance(value, np.ndarray)
    return value.tobytes()


def _decode_array(_: type, data: object) -> Array:
    if not isinstance(data, bytes) or len(data) != 24:
        raise ValueError("a position is three numbers")
    return np.frombuffer(data, np.float64).copy()


_ENCODER: Final = msgspec.msgpack.Encoder(enc_hook=_encode_array)
_DECODER: Final = msgspec.msgpack.Decoder(_Checkpoint, dec_hook=_decode_array)

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

    def add(self, receiver: TagReceiver, reception: Reception, serial: int) -> None:
        """Add a reception before the receiver hears it; ``serial`` is the number of fixes made so far."""
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
            self._begin(receiver, serial)
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

    def _begin(self, receiver: TagReceiver, serial: int) -> None:
        self._open = True
        self._segments += 1
        self._first = 0
        try:
            state = save(receiver)
        except TypeError:  # a bug: the replay lacks its beginning, but the tag goes on
            self.counters["no-checkpoint"] += 1
            state = None
        self._start = SegmentStart(serial, self._settings, state)

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


def receiver_settings(
    method: str,
    site: int | None = None,
    qa: float = 0.3,
    z_bounds_m: tuple[float, float] | None = None,
    integrity: IntegrityRequirement = IntegrityRequirement(),  # noqa: B008 - a frozen value
) -> Settings:
    """The receiver's arguments as a segment states them."""
    low_m, high_m = (None, None) if z_bounds_m is None else z_bounds_m
    return {
        "method": method,
        "site": site,
        "qa": qa,
        "z_low_m": low_m,
        "z_high_m": high_m,
        "integrity_risk": integrity.risk,
        "alert_limit_m": integrity.alert_limit_m,
        "max_acceleration_mps2": integrity.max_acceleration_mps2,
        "height_std_m": integrity.height_std_m,
    }


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
