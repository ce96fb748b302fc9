"""The state of the site as pages show it, gathered from messages. No I/O; the time is passed in."""

import math
from collections.abc import Mapping
from typing import Any, Final

import msgspec

from skyless.mqtt.messages import (
    AnchorHealth,
    EtherHealth,
    FixMessage,
    StatusMessage,
    TagHealth,
    TruthMessage,
    Vector,
)
from skyless.mqtt.truth_buffer import TruthBuffer

MAX_NAMES: Final = 2000
"""Tags, and nodes, that are kept; a broker that invents names cannot fill the memory."""

EXPIRY_S: Final = 600.0
"""Fixes and health messages older than this are dropped."""

MAX_CLOCK_ERROR_S: Final = 0.5
"""The time of a fix by its tag's clock is replaced where it is wrong by more than this."""

_MAX_ENCODED: Final = 16
_AGES: Final = {"AnchorHealth": "anchors", "TagHealth": "tags", "EtherHealth": "ether"}


class _Tag:
    """The last fix of a tag, and its row once one was requested."""

    __slots__ = ("ended_unix_s", "fix", "received_s", "row", "serial")

    def __init__(self, fix: FixMessage, serial: int, received_s: float, ended_unix_s: float) -> None:
        self.fix, self.serial, self.received_s, self.ended_unix_s = fix, serial, received_s, ended_unix_s
        self.row: list[Any] | None = None


class SiteState:
    """The newest fix, health and status by name."""

    def __init__(self) -> None:
        self.serial = 0
        """Counts fixes; a reader that has the state at one serial requests what came since."""
        self.statuses: dict[tuple[str, str], StatusMessage] = {}
        """By kind and name."""
        self.unix_s = 0.0
        """Time of the next ``state`` message; set by the owner."""
        self._tags: dict[str, _Tag] = {}
        self._truths = TruthBuffer()
        self._healths: dict[tuple[str, str], tuple[float, TagHealth | AnchorHealth | EtherHealth]] = {}
        self._encoded: dict[tuple[int, int], bytes] = {}

    def add_fix(self, fix: FixMessage, now_s: float, unix_s: float) -> None:
        """Add a fix; ``now_s`` is its time of arrival, by the clock of ``expire``.

        ``unix_s`` is the time of the fix, the end of its last frame, by the owner's clock of the day.
        """
        if fix.tag not in self._tags and len(self._tags) >= MAX_NAMES:
            return
        self.serial += 1
        self._tags[fix.tag] = _Tag(fix, self.serial, now_s, unix_s)

    def add_truth(self, truth: TruthMessage) -> None:
        """Add true positions of simulated tags."""
        self._truths.add(truth)

    def add_status(self, status: StatusMessage) -> None:
        """Update whether a node is online."""
        key = status.kind, status.name
        if key in self.statuses or len(self.statuses) < MAX_NAMES:
            self.statuses[key] = status

    def add_health(self, name: str, health: TagHealth | AnchorHealth | EtherHealth, now_s: float) -> None:
        """Update a node's health."""
        key = type(health).__name__, name
        if key in self._healths or len(self._healths) < MAX_NAMES:
            self._healths[key] = now_s, health

    def expire(self, now_s: float) -> None:
        """Drop what is older than ``EXPIRY_S``."""
        self._encoded.clear()
        for name in [name for name, tag in self._tags.items() if now_s - tag.received_s > EXPIRY_S]:
            del self._tags[name]
        for key in [key for key, (received_s, _) in self._healths.items() if now_s - received_s > EXPIRY_S]:
            del self._healths[key]

    def fixes_since(self, now_s: float, longest_s: float) -> list[tuple[FixMessage, float]]:
        """The newest fix of each tag that came within the last ``longest_s``, and when it ended, by ``unix_s``."""
        found = [tag for tag in self._tags.values() if now_s - tag.received_s <= longest_s]
        return [(tag.fix, tag.ended_unix_s) for tag in found]

    def methods(self) -> list[str]:
        """The positioning method of each tag whose health is known."""
        return [health.method for _, health in self._healths.values() if isinstance(health, TagHealth)]

    def state_since(self, serial: int) -> bytes:
        """The ``state`` message with all tags that have a fix since; readers at the same serial share its bytes."""
        key = serial, self.serial
        if key not in self._encoded:
            if len(self._encoded) >= _MAX_ENCODED:
                self._encoded.clear()
            self._encoded[key] = encode("state", {"unix_s": round(self.unix_s, 3), "tags": self.rows_since(serial)})
        return self._encoded[key]

    def rows_since(self, serial: int) -> list[list[Any]]:
        """Rows of the ``state`` message, the fields of each in the order of ``page/tracks.js``."""
        rows = []
        for tag in self._tags.values():
            if tag.serial > serial:
                if tag.row is None:
                    tag.row = _row(tag.fix, self._truths.at(tag.fix.tag, tag.fix.unix_s), tag.ended_unix_s)
                rows.append(tag.row)
        return rows

    def health_message(self, dropped: Mapping[str, int], now_s: float) -> bytes:
        """The ``health`` message; ``dropped`` counts wrong messages by kind, and ``ages`` are since each arrived."""
        healths = [health for _, health in self._healths.values()]
        ages: dict[str, dict[str, float]] = {"anchors": {}, "tags": {}, "ether": {}}
        for (kind, name), (received_s, _) in self._healths.items():
            ages[_AGES[kind]][name] = round(now_s - received_s, 2)
        return encode(
            "health",
            {
                "anchors": [health for health in healths if isinstance(health, AnchorHealth)],
                "tags": [health for health in healths if isinstance(health, TagHealth)],
                "ether": next((health for health in healths if isinstance(health, EtherHealth)), None),
                "nodes": list(self.statuses.values()),
                "dropped": dict(dropped),
                "ages": ages,
            },
        )


def encode(kind: str, fields: dict[str, Any]) -> bytes:
    """One message to the page."""
    return msgspec.json.encode({"type": kind, **fields})


def error_m(fix: FixMessage, true_m: Vector) -> float:
    """Distance from the true position in the axes that the fix estimates, so without a given height."""
    axes = 2 if fix.height_known else 3
    return math.dist(fix.position_m[:axes], true_m[:axes])


def _row(fix: FixMessage, true_m: Vector | None, ended_unix_s: float) -> list[Any]:
    """One tag in a ``state``, rounded to what a page can show, which halves the bytes."""
    unix_s = fix.unix_s if abs(fix.unix_s - ended_unix_s) <= MAX_CLOCK_ERROR_S else ended_unix_s
    x, y, z = fix.position_m
    xx, xy, _, _, yy = fix.covariance_m2[:5]
    vx, vy, _ = fix.velocity_mps or (None, None, None)
    verified_s = fix.verified_until_s
    return [
        fix.tag,
        round(x, 4),
        round(y, 4),
        round(z, 4),
        None if vx is None else round(vx, 3),
        None if vy is None else round(vy, 3),
        round(xx, 8),
        round(xy, 8),
        round(yy, 8),
        round(fix.std_m, 5),
        None if true_m is None else round(error_m(fix, true_m), 4),
        None if true_m is None else round(true_m[0], 4),
        None if true_m is None else round(true_m[1], 4),
        len(fix.anchors),
        round(fix.chi2, 3),
        round(unix_s, 4),
        None if fix.hpl_m is None else round(fix.hpl_m, 4),
        fix.alert,
        int(fix.height_known),
        None if fix.height_known else round(math.sqrt(max(fix.covariance_m2[8], 0.0)), 5),
        None if verified_s is None else round(fix.time_s - verified_s, 2),
        None if verified_s is None else round(fix.unverified, 3),
    ]
