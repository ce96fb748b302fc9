"""Open Sound Control over UDP, for TouchDesigner, Unreal, Max and the like: ``/skyless/TAG/xyz`` with three floats.

Format: https://opensoundcontrol.stanford.edu/spec-1_0.html.
"""

import struct
from collections import Counter
from typing import cast

from skyless.bridges.target import UPS, BridgeContext, Encoder, TargetUrl, Up, turned
from skyless.run.mqtt.messages import FixMessage


class OscEncoder(Encoder):
    """A message for each fix; and ``/skyless/TAG/fix``, at a change and each second: 1 with a fix, 0 without one."""

    def __init__(self, up: Up = "z") -> None:
        self._up = up
        self._fixed: set[str] = set()
        self.dropped: Counter[str] = Counter()

    def on_fix(self, fix: FixMessage) -> list[bytes]:
        """Where it is, in m; first that there is a fix, if there was none."""
        try:
            xyz = message(f"/skyless/{fix.tag}/xyz", turned(fix.position_m, self._up))
        except OverflowError:
            self.dropped["osc-value"] += 1  # beyond a 32-bit float
            return []
        if fix.tag in self._fixed:
            return [xyz]
        self._fixed.add(fix.tag)
        return [_state(fix.tag, 1), xyz]

    def on_no_fix(self, tag: str, unix_s: float, reason: str) -> list[bytes]:  # noqa: ARG002 - no field for them
        """That there is none."""
        self._fixed.discard(tag)
        return [_state(tag, 0)]

    def on_second(self, unix_s: float) -> list[bytes]:  # noqa: ARG002 - no field for it
        """Which tags have a fix, for programs that began later or lost a datagram."""
        return [_state(tag, 1) for tag in sorted(self._fixed)]


def _state(tag: str, fixed: int) -> bytes:
    return message(f"/skyless/{tag}/fix", (fixed,))


def message(address: str, values: tuple[float, ...]) -> bytes:
    """An OSC message: integers as 32-bit integers, other numbers as 32-bit floats.

    Raises:
        OverflowError, struct.error: a value does not fit.
    """
    types = "".join("i" if isinstance(value, int) else "f" for value in values)
    return _padded(address) + _padded("," + types) + struct.pack(f">{types}", *values)


def _padded(text: str) -> bytes:
    data = text.encode() + b"\0"
    return data.ljust(-(-len(data) // 4) * 4, b"\0")


def make_encoder(url: TargetUrl, _context: BridgeContext) -> OscEncoder:
    """Key: ``up``, the axis that points up (z, or y as in TouchDesigner). Raises SkylessError."""
    return OscEncoder(cast(Up, url.choice("up", UPS, "z")))
