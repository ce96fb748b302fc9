"""Batches of fixes in binary form, exchanged by gather, history and the page of a large site.

A batch is a header of 32 bytes and records of 48 bytes, little-endian (``docs/batches.md``). Readers skip unknown parts
of both, by the sizes in the header.
"""

import math
import struct
from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from skyless.core.alert import Alert
from skyless.run.mqtt.messages import FixMessage

MAGIC: Final = b"SKB2"
_HEADER: Final = struct.Struct("<4sHHIIQII")
HEADER_BYTES: Final = _HEADER.size

RECORD: Final = np.dtype(
    [
        ("tag", "<u4"),
        ("flags", "<u2"),
        ("anchors", "u1"),
        ("method", "u1"),
        ("unix_us", "<u8"),
        ("position_mm", "<i4", 3),
        ("covariance_m2", "<f4", 3),
        ("std_z_mm", "<u2"),
        ("hpl_cm", "<u2"),
        ("velocity_cmps", "<i2", 2),
    ]
)
"""One fix: the tag's number, flags, anchors used, method (0: not stated), time, position, covariance xx, xy, yy,
standard deviation of z, protection level and velocity."""

FIELDS: Final = struct.Struct("<IHBBQiiifffHHhh")
"""The same record, for ``struct``."""

MAX_RECORDS: Final = 1000
NONE_U16: Final = 65535
"""Marks a missing standard deviation of z or protection level."""

ALERT_BITS: Final = 0b111
HEIGHT_GIVEN: Final = 1 << 3
VERIFIED: Final = 1 << 4
VELOCITY_KNOWN: Final = 1 << 5
SIMULATED: Final = 1 << 6

ALERTS: Final = tuple(Alert)
"""A record's alert is its index here plus one; 0 for none."""

_ALERT_NUMBERS: Final[dict[str | None, int]] = {None: 0} | {alert: number for number, alert in enumerate(ALERTS, 1)}

_MAX_I64: Final = 2**63 - 1
_MAX_I32: Final = 2**31 - 1
_MAX_I16: Final = 2**15 - 1

Records = NDArray[Any]
"""Array of dtype ``RECORD``."""


class BadBatchError(ValueError):
    """The bytes are not a batch."""


class Batch(Struct, frozen=True):
    """Fixes of many tags."""

    run: int
    """Random number of the sender's start."""
    sequence: int
    """Number of the batch in this run."""
    sent_unix_us: int
    names_issue: int
    """Number of the table of names to which the records' tag numbers refer."""
    records: Records

    @property
    def id(self) -> str:
        """Message ID: streams drop a second message with the same ID."""
        return f"{self.run}-{self.sequence}"


def encode_batch(batch: Batch) -> bytes:
    """Encode a batch."""
    head = _HEADER.pack(
        *(MAGIC, HEADER_BYTES, RECORD.itemsize, batch.run, batch.sequence),
        *(batch.sent_unix_us, batch.names_issue, len(batch.records)),
    )
    return head + batch.records.tobytes()


def decode_batch(data: bytes) -> Batch:
    """Decode a batch. Raises BadBatchError."""
    if len(data) < HEADER_BYTES:
        raise BadBatchError(f"{len(data)} bytes are shorter than a header")
    magic, header_bytes, record_bytes, run, sequence, sent, issue, count = _HEADER.unpack_from(data)
    if magic != MAGIC:
        raise BadBatchError(f"it begins with {magic!r}")
    if header_bytes < HEADER_BYTES or record_bytes < RECORD.itemsize:
        raise BadBatchError(f"its header has {header_bytes} bytes and its records {record_bytes}")
    if count > MAX_RECORDS or len(data) != header_bytes + count * record_bytes:
        raise BadBatchError(f"{len(data)} bytes are not {count} records")
    return Batch(run, sequence, sent, issue, np.ndarray(count, RECORD, data, header_bytes, record_bytes))


def records_of(fixes: Sequence[tuple[int, FixMessage]], *, simulated: bool) -> Records:
    """Convert fixes to records, each with its tag's number. Values beyond a field's range are clipped to it."""
    rows = [_row(number, fix, simulated=simulated) for number, fix in fixes]
    with np.errstate(over="ignore"):  # a covariance beyond 32 bits becomes infinite
        return np.array(rows, RECORD)


def _row(number: int, fix: FixMessage, *, simulated: bool) -> tuple[Any, ...]:
    flags = SIMULATED if simulated else 0
    flags |= _ALERT_NUMBERS.get(fix.alert, _ALERT_NUMBERS[Alert.UNAVAILABLE])  # also for alerts of later versions
    flags |= HEIGHT_GIVEN if fix.height_known else 0
    flags |= VERIFIED if fix.verified_until_s is not None else 0
    velocity = (0, 0)
    if fix.velocity_mps is not None:
        flags |= VELOCITY_KNOWN
        velocity = _scaled(fix.velocity_mps[0], 100.0, _MAX_I16), _scaled(fix.velocity_mps[1], 100.0, _MAX_I16)
    xx, xy, _, _, yy, _, _, _, zz = fix.covariance_m2
    std_z_mm = NONE_U16 if fix.height_known else _counted(math.sqrt(max(zz, 0.0)), 1000.0)
    hpl_cm = NONE_U16 if fix.hpl_m is None else _counted(fix.hpl_m, 100.0)
    position_mm = tuple(_scaled(value, 1000.0, _MAX_I32) for value in fix.position_m)
    unix_us = max(0, _scaled(fix.unix_s, 1e6, _MAX_I64))
    return number, flags, min(len(fix.anchors), 255), 0, unix_us, position_mm, (xx, xy, yy), std_z_mm, hpl_cm, velocity


def fix_of(name: str, record: tuple[Any, ...]) -> FixMessage:
    """Convert a record unpacked by ``FIELDS`` to a fix. Missing fields are empty, 0 or NaN."""
    _, flags, _, _, unix_us, x_mm, y_mm, z_mm, xx, xy, yy, std_z_mm, hpl_cm, vx_cmps, vy_cmps = record
    zz = 0.0 if std_z_mm == NONE_U16 else (0.001 * std_z_mm) ** 2
    alert = min(flags & ALERT_BITS, len(ALERTS))
    is_verified = bool(flags & VERIFIED)
    return FixMessage(
        tag=name,
        serial=0,
        unix_s=1e-6 * unix_us,
        time_s=0.0,
        position_m=(0.001 * x_mm, 0.001 * y_mm, 0.001 * z_mm),
        covariance_m2=(xx, xy, 0.0, xy, yy, 0.0, 0.0, 0.0, zz),
        velocity_mps=(0.01 * vx_cmps, 0.01 * vy_cmps, 0.0) if flags & VELOCITY_KNOWN else None,
        velocity_covariance=None,
        std_m=math.sqrt(max(xx + yy + zz, 0.0)),
        gdop=None,
        pdop=None,
        hdop=None,
        vdop=None,
        anchors=(),
        chi2=math.nan,
        dof=0,
        residual_rms_m=math.nan,
        method="",
        height_known=bool(flags & HEIGHT_GIVEN),
        latency_s=0.0,
        hpl_m=None if hpl_cm == NONE_U16 else 0.01 * hpl_cm,
        alert=ALERTS[alert - 1] if alert else None,
        verified_until_s=0.0 if is_verified else None,
        unverified=0.0 if is_verified else 1.0,
    )


def _scaled(value: float, scale: float, most: int) -> int:
    scaled = scale * value
    return min(max(round(scaled), -most), most) if math.isfinite(scaled) else 0


def _counted(value: float, scale: float) -> int:
    """Scale a non-negative value, and clip it to stay below ``NONE_U16``."""
    scaled = scale * value
    return min(max(round(scaled), 0), NONE_U16 - 1) if math.isfinite(scaled) else NONE_U16
