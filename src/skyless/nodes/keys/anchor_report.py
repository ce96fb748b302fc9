"""What an anchor's program logs of codes: when its own begin and end, and whose beacons are not accepted."""

from typing import Final

from skyless.anchors.authentication import BeaconAuthentication
from skyless.authentication.fault import Fault
from skyless.nodes.keys.faults import FaultLines, Log

RECENT_S: Final = 2.0
"""Faults that are older do not count."""

_WRONG: Final = (Fault.BAD_CODE, Fault.LATE, Fault.EARLY)

_WORDS: Final = {
    Fault.NO_TIME: "the radio's counter has not been read yet",
    Fault.NO_CHAIN: "no key chain counts now (skyless site keys show)",
    Fault.CLOCK_WRONG: "this host's clock is not that of the other anchors: set it with chrony or NTP",
}


class AnchorReport:
    """Of one anchor; ``update`` is called once a second."""

    def __init__(self, anchor: int, log: Log) -> None:
        self._name, self._log = f"anchor {anchor}", log
        self._lines = FaultLines(self._name, log)
        self._said: str | None = None
        self._is_alone = False

    def update(
        self, authentication: BeaconAuthentication, serial: int | None, accepted_s: float, unix_s: float, now_s: float
    ) -> None:
        """Log what has changed. ``serial``: of the chain that counts.

        ``accepted_s`` is when a beacon of another anchor was accepted last, ``now_s`` the present, both by the host's
        monotonic clock.
        """
        self._on_own(authentication.fault(), serial)
        faults = recent_faults(authentication, unix_s)
        is_alone = now_s - accepted_s > RECENT_S and any(fault in _WRONG for fault in faults.values())
        if is_alone and not self._is_alone:
            self._log(f"{self._name}: no other anchor's code fits: the own seed or this host's clock is probably wrong")
        self._is_alone = is_alone
        self._lines.update({} if is_alone else faults, now_s)

    def _on_own(self, fault: Fault | None, serial: int | None) -> None:
        if fault is Fault.NO_TIME:
            return  # that is so for a moment after each start
        line = (
            f"beacons carry codes of key chain {serial}"
            if fault is None
            else f"beacons carry no codes: {_WORDS.get(fault, fault)}"
        )
        if line != self._said:
            self._said = line
            self._log(f"{self._name}: {line}")


def recent_faults(authentication: BeaconAuthentication, unix_s: float) -> dict[int, Fault]:
    """Other anchors with a fault within the last seconds."""
    faults = authentication.faults.items()
    return {anchor: fault for anchor, (fault, when_s) in faults if abs(unix_s - when_s) <= RECENT_S}
