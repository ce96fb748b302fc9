"""What the page is told of the site, gathered from messages. No I/O; the time is passed in."""

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
from skyless.positioning.integrity import Alert

MOST_NAMES: Final = 2000
"""Tags, and nodes, that are remembered; a broker that makes up names fills no memory."""

FORGET_S: Final = 600.0
"""A tag or health message is forgotten after so long."""

_ENCODED: Final = 16


class _Tag:
    """The last fix of a tag, and the row of it once somebody has asked."""

    __slots__ = ("fix", "heard_s", "row", "serial")

    def __init__(self, fix: FixMessage, serial: int, heard_s: float) -> None:
        self.fix, self.serial, self.heard_s = fix, serial, heard_s
        self.row: list[Any] | None = None


class Board:
    """The newest of everything, by name."""

    def __init__(self) -> None:
        self.serial = 0
        """Counts fixes; a reader who saw the state at one serial asks for what came since."""
        self.statuses: dict[tuple[str, str], StatusMessage] = {}
        """By kind and name."""
        self.unix_s = 0.0
        """What a ``state`` says of its time; whoever keeps the board sets it."""
        self._tags: dict[str, _Tag] = {}
        self._truths = TruthBuffer()
        self._healths: dict[tuple[str, str], tuple[float, TagHealth | AnchorHealth | EtherHealth]] = {}
        self._encoded: dict[tuple[int, int], bytes] = {}

    def fix(self, fix: FixMessage, now_s: float) -> None:
        """Take a fix; ``now_s`` is when it came, by the clock that ``forget`` is given."""
        if fix.tag not in self._tags and len(self._tags) >= MOST_NAMES:
            return
        self.serial += 1
        self._tags[fix.tag] = _Tag(fix, self.serial, now_s)

    def truth(self, truth: TruthMessage) -> None:
        """Take where simulated tags truly are."""
        self._truths.add(truth)

    def status(self, status: StatusMessage) -> None:
        """Take whether a node lives."""
        key = status.kind, status.name
        if key in self.statuses or len(self.statuses) < MOST_NAMES:
            self.statuses[key] = status

    def health(self, name: str, health: TagHealth | AnchorHealth | EtherHealth, now_s: float) -> None:
        """Take how a node does."""
        key = type(health).__name__, name
        if key in self._healths or len(self._healths) < MOST_NAMES:
            self._healths[key] = now_s, health

    def forget(self, now_s: float) -> None:
        """Drop what is older than ``FORGET_S``."""
        self._encoded.clear()
        for name in [name for name, tag in self._tags.items() if now_s - tag.heard_s > FORGET_S]:
            del self._tags[name]
        for key in [key for key, (heard_s, _) in self._healths.items() if now_s - heard_s > FORGET_S]:
            del self._healths[key]

    def methods(self) -> list[str]:
        """The positioning method of each tag whose health is known."""
        return [health.method for _, health in self._healths.values() if isinstance(health, TagHealth)]

    def state_since(self, serial: int) -> bytes:
        """The ``state`` message with all tags that have a fix since; its bytes are shared by all who ask the same."""
        key = serial, self.serial
        if key not in self._encoded:
            if len(self._encoded) >= _ENCODED:
                self._encoded.clear()
            self._encoded[key] = encode("state", {"unix_s": round(self.unix_s, 3), "tags": self.rows_since(serial)})
        return self._encoded[key]

    def rows_since(self, serial: int) -> list[list[Any]]:
        """Rows of the ``state`` message, the fields of each in the order of the contract."""
        rows = []
        for tag in self._tags.values():
            if tag.serial > serial:
                if tag.row is None:
                    tag.row = _row(tag.fix, self._truths.at(tag.fix.tag, tag.fix.unix_s))
                rows.append(tag.row)
        return rows

    def health_message(self, wrong: Mapping[str, int]) -> bytes:
        """The ``health`` message; ``wrong`` counts messages that were dropped, by kind."""
        healths = [health for _, health in self._healths.values()]
        return encode(
            "health",
            {
                "anchors": [health for health in healths if isinstance(health, AnchorHealth)],
                "tags": [health for health in healths if isinstance(health, TagHealth)],
                "ether": next((health for health in healths if isinstance(health, EtherHealth)), None),
                "nodes": list(self.statuses.values()),
                "dropped": dict(wrong),
            },
        )


def encode(kind: str, fields: dict[str, Any]) -> bytes:
    """One message to the page."""
    return msgspec.json.encode({"type": kind, **fields})


def error_m(fix: FixMessage, true_m: Vector) -> float:
    """Distance from the truth in the axes that the fix estimates: a height that is given is no merit."""
    axes = 2 if fix.height_known else 3
    return math.dist(fix.position_m[:axes], true_m[:axes])


_ALERTS: Final = [alert.value for alert in Alert]
"""Rows tell an alert by its number."""


def _row(fix: FixMessage, true_m: Vector | None) -> list[Any]:
    """One tag in a ``state``, rounded to what a page can show, which halves its bytes."""
    x, y, z = fix.position_m
    xx, xy, _, _, yy = fix.covariance_m2[:5]
    vx, vy, _ = fix.velocity_mps or (None, None, None)
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
        round(fix.unix_s, 4),
        None if fix.hpl_m is None else round(fix.hpl_m, 4),
        _ALERTS.index(fix.alert) if fix.alert in _ALERTS else None,
    ]
