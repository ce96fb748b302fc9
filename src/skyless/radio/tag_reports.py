"""Reports of a board that computes its own position: fixes, state, anchors, georeference.

The bytes are those of structs in ``firmware/source/fix.h``; records contain them from ``BODY_AT`` on.
"""

import struct
from collections import Counter
from collections.abc import Sequence
from math import inf, isfinite, nan
from typing import Final

import numpy as np
from msgspec import Struct
from msgspec.structs import astuple, replace

from skyless.core.air.almanac import GeoreferencePage
from skyless.core.fix import Fix, NoFixReason
from skyless.core.integrity import UNAVAILABLE, IntegrityRequirement
from skyless.core.method_names import DEFAULT_METHOD
from skyless.core.tag.receiver import HeardSite
from skyless.core.ticks import TICK_RATE_HZ

BODY_AT: Final = 2
"""Offset of a record's body, after kind and number."""

_FIX: Final = struct.Struct("<2qQ7I6i16fI2fI")
_STATUS: Final = struct.Struct("<8I")
_PLACE: Final = struct.Struct("<I3i")
_EARTH: Final = struct.Struct("<3iI")
_NO_SITE: Final = 0xFFFF
_ROWS: Final = struct.Struct("<30d")
_SQUARE: Final = (0, 1, 2, 1, 3, 4, 2, 4, 5)
"""Indices of a full covariance, row by row, into xx, xy, xz, yy, yz, zz."""
_UPPER: Final = (0, 1, 2, 4, 5, 8)
"""The inverse."""
_REASONS: Final = (None, *NoFixReason)


class BoardFix(Struct, frozen=True):
    """A fix computed by the board, without the anchors' positions."""

    fix: Fix
    site: int
    latency_s: float
    """From the end of its last frame until it was computed."""


class BoardStatus(Struct, frozen=True):
    """The state of a tag on a board, once a second."""

    site: int | None
    reason: NoFixReason | None
    """Why there is no fix; None if there is one."""
    counters: dict[str, int]
    """Frames by outcome, and fixes, since the board's start."""


class AnchorPlace(Struct, frozen=True):
    """Where an anchor is that the board uses."""

    anchor: int
    position_m: tuple[float, float, float]


TagReport = BoardFix | BoardStatus | AnchorPlace | GeoreferencePage


class Reported(Struct, frozen=True, gc=False):
    """What a board has said, and when it came by the host's monotonic clock."""

    report: TagReport
    host_s: float


# Values of records; one that is too short raises struct.error


def board_fix(record: bytes) -> BoardFix | None:
    """The fix of a record; None where there is none."""
    ticks, _, _, latency_us, _, reason, site, _, height, verified, *rest, count = _FIX.unpack_from(record, BODY_AT)
    place, velocity, covariance, velocity_covariance = rest[:3], rest[3:6], rest[6:12], rest[12:18]
    chi2, mean_square_m2, hpl_m, vpl_m, levels, risk, limit_m = rest[18:]
    is_whole = len(record) == BODY_AT + _FIX.size + 2 * count and not reason and levels <= UNAVAILABLE
    is_finite = all(map(isfinite, (*covariance, *velocity_covariance, chi2)))
    is_right = 0.0 < risk <= 0.1 and 0.0 <= limit_m < inf and 0.0 <= mean_square_m2 < inf
    if not (is_whole and is_finite and is_right):
        return None
    rows = _ROWS.pack(
        *(coordinate / 1000 for coordinate in place),
        *(covariance[at] for at in _SQUARE),
        *(chi2, mean_square_m2, nan),
        *(speed / 1000 for speed in velocity),
        *(velocity_covariance[at] for at in _SQUARE),
        *(hpl_m, vpl_m, levels),
    )
    time_s = ticks / TICK_RATE_HZ
    fix = Fix(
        time_s,
        rows,
        struct.unpack_from(f"<{count}H", record, BODY_AT + _FIX.size),
        np.empty((0, 3)),
        DEFAULT_METHOD,
        bool(height),
        requirement=IntegrityRequirement(float(f"{risk:.7g}"), limit_m or None),
        verified_until_s=time_s if verified else None,
        unverified=0.0 if verified else 1.0,
    )
    return BoardFix(fix, site, latency_us / 1e6)


def board_status(record: bytes) -> BoardStatus | None:
    """The state of a record; None where there is none."""
    site, reason, _, *counts = _STATUS.unpack_from(record, BODY_AT)
    if reason >= len(_REASONS):
        return None
    names = ("heard", "fixes", "overload", "overload-superframe", "dropped-on-board")
    return BoardStatus(None if site == _NO_SITE else site, _REASONS[reason], dict(zip(names, counts, strict=True)))


def anchor_place(record: bytes) -> AnchorPlace:
    """The anchor of a record."""
    anchor, x_mm, y_mm, z_mm = _PLACE.unpack_from(record, BODY_AT)
    return AnchorPlace(anchor, (x_mm / 1000, y_mm / 1000, z_mm / 1000))


def georeference(record: bytes) -> GeoreferencePage:
    """The place on the Earth of a record, as on the air."""
    latitude, longitude, height_mm, heading = _EARTH.unpack_from(record, BODY_AT)
    return GeoreferencePage(latitude / 1e7, longitude / 1e7, height_mm / 1000, heading / 1e7)


# What an emulated board sends: the inverses


def fix_body(fix: Fix, unix_s: float, rx_ticks: int, latency_s: float, serial: int, site: int, tag: int) -> bytes:
    """The body of FIX; ``serial`` is the number of the fix, ``tag`` that of the tag."""
    rows, required = _ROWS.unpack_from(fix.rows), fix.requirement or IntegrityRequirement()
    fixed = _FIX.pack(
        *(round(fix.time_s * TICK_RATE_HZ), round(1e6 * unix_s), rx_ticks, round(1e6 * latency_s), serial, 0),
        *(site, tag, fix.height_known, fix.verified_until_s is not None),
        *(round(1000 * value) for value in (*rows[:3], *rows[15:18])),
        *(rows[begin + at] for begin in (3, 18) for at in _UPPER),
        *(*rows[12:14], *rows[27:29], int(rows[29])),
        *(required.risk, required.alert_limit_m or 0.0, len(fix.anchors)),
    )
    return fixed + struct.pack(f"<{len(fix.anchors)}H", *fix.anchors)


def status_body(site: int | None, reason: NoFixReason | None, counts: Sequence[int], receiver_on_s: float) -> bytes:
    """The body of TAG_STATUS, of a tag that does not sleep; ``counts`` are in the order of the record."""
    number = _NO_SITE if site is None else site
    return _STATUS.pack(number, _REASONS.index(reason), 0, *counts) + struct.pack("<2I", round(1000 * receiver_on_s), 0)


def place_body(anchor: int, position_m: Sequence[float]) -> bytes:
    """The body of ANCHOR_PLACE."""
    return _PLACE.pack(anchor, *(round(1000 * value) for value in position_m))


def georeference_body(earth: GeoreferencePage) -> bytes:
    """The body of GEOREFERENCE."""
    latitude, longitude, height_m, heading = astuple(earth)
    return _EARTH.pack(round(1e7 * latitude), round(1e7 * longitude), round(1000 * height_m), round(1e7 * heading))


class BoardReceiver:
    """Stands in for the receiver of a tag whose board computes (``skyless.core.tag.receiver.SiteListener``)."""

    def __init__(self) -> None:
        self.counters: Counter[str] = Counter()
        self.reason = NoFixReason.NO_BEACONS
        self.site: int | None = None
        self.multipath_m: tuple[float, float] | None = None
        self.motion_note: str | None = None
        self.phase_anchors: tuple[int, ...] = ()
        self._anchors_m: dict[int, tuple[float, float, float]] = {}
        self._georeference: GeoreferencePage | None = None

    @property
    def heard_site(self) -> HeardSite | None:
        """The anchors that the board has used, and the georeference; None before any."""
        earth = self._georeference
        return HeardSite(self._anchors_m, earth, is_complete=earth is not None) if self._anchors_m else None

    def take(self, report: TagReport) -> Fix | None:
        """Process a report of the board; return the fix if it is one."""
        if isinstance(report, BoardFix):
            self._enter(report.site)
            known = all(anchor in self._anchors_m for anchor in report.fix.anchors)
            places = [self._anchors_m[anchor] for anchor in report.fix.anchors] if known else []
            return replace(report.fix, anchors_m=np.array(places).reshape(-1, 3))
        if isinstance(report, BoardStatus):
            self._enter(report.site)
            self.reason = report.reason or self.reason
            self.counters = Counter(report.counters)
        elif isinstance(report, AnchorPlace):
            self._anchors_m = self._anchors_m | {report.anchor: report.position_m}
        else:
            self._georeference = report
        return None

    def _enter(self, site: int | None) -> None:
        """Switch to another site, which has other anchors."""
        if self.site is not None and site not in (None, self.site):
            self._anchors_m, self._georeference = {}, None
        self.site = self.site if site is None else site
