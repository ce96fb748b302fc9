"""Lines about anchors whose beacons are not accepted: one when that begins, one when it is over."""

from collections.abc import Callable, Mapping
from typing import Final

from msgspec import Struct

from skyless.authentication.fault import Fault

Log = Callable[[str], None]
"""Called with one line for a person to read."""

LASTING_S: Final = 4.0
"""Faults that last for a shorter time, as a moment after a start, are not logged."""

CALM_S: Final = 30.0
"""An anchor is said to be accepted again after this time without a fault."""

MOST_NAMED: Final = 8
"""Anchors that are named at the same time: forged frames can name any."""

_WORDS: Final = {
    Fault.NO_CODE: "they carry no codes: it has no keys, or somebody forges its beacons",
    Fault.BAD_CODE: "their codes are wrong: it has a wrong seed, or somebody forges its beacons",
    Fault.REVOKED_CHAIN: "it uses a key chain that the site has replaced (copy the new one to its host), or somebody "
    "repeats old beacons",
    Fault.LATE: "they come too late: its clock or this one is wrong, or somebody repeats old beacons",
    Fault.EARLY: "they come too early: its clock or this one is wrong",
    Fault.REPEATED: "somebody repeats them",
}


class _Known(Struct):
    """An anchor with faults."""

    fault: Fault
    first_s: float
    last_s: float
    is_logged: bool = False


class FaultLines:
    """Of one program; ``name`` is whose lines these are."""

    def __init__(self, name: str, log: Log) -> None:
        self._name, self._log = name, log
        self._known: dict[int, _Known] = {}

    def update(self, faults: Mapping[int, Fault], now_s: float) -> None:
        """Log what has changed; ``faults``: of the last seconds. ``now_s`` is the host's monotonic clock."""
        for anchor, fault in sorted(faults.items()):
            known = self._known.get(anchor)
            if known is None and len(self._known) >= MOST_NAMED:
                continue
            if known is None or known.fault is not fault:
                known = self._known[anchor] = _Known(fault, now_s, now_s)
            known.last_s = now_s
            if not known.is_logged and now_s - known.first_s >= LASTING_S:
                known.is_logged = True
                why = _WORDS.get(fault, fault)
                self._log(f"{self._name}: beacons of anchor {anchor} are not accepted: {why}")
        for anchor, known in list(self._known.items()):
            calm_s = now_s - known.last_s
            if calm_s >= (CALM_S if known.is_logged else LASTING_S):
                del self._known[anchor]
                if known.is_logged:
                    self._log(f"{self._name}: no beacon of anchor {anchor} was refused for {CALM_S:.0f} s")
