"""What a tag's program says of verified beacons: why there are none, and which anchors are not accepted."""

from typing import Final

from skyless.authentication.fault import Fault
from skyless.nodes.keys.faults import FaultLines, Log
from skyless.trusted_receiver import TrustedReceiver

PATIENCE_S: Final = 10.0
"""After this time without verified beacons the cause is logged: a certificate comes every second or so."""

_WORDS: Final = {
    "no-code": "the beacons carry no codes: the site's anchors have no keys, or these are not its anchors",
    "no-certificate": "no certificate of the site's key was received: the key file may be of another site",
    "no-key": "no key was disclosed that fits: too few beacons are received",
}


def trust_reason(trusted: TrustedReceiver) -> str | None:
    """Why no beacon has been verified within the last second; None where some have, or none has come at all."""
    if trusted.is_verified:
        return None
    verifier, faults = trusted.verifier, set(trusted.faults().values())
    if verifier.clock.error_s is not None or faults & {Fault.LATE, Fault.EARLY}:
        return "clock-wrong"
    if faults == {Fault.NO_CODE}:
        return "no-code"
    if not faults and not verifier.waiting():
        return None
    return "no-certificate" if verifier.keys.timing is None else "no-key"


class TagReport:
    """Of one tag; ``update`` is called once a second."""

    def __init__(self, tag: str, site: int, log: Log) -> None:
        self._name, self._site, self._log = f"tag {tag}", site, log
        self._lines = FaultLines(self._name, log)
        self._serial: int | None = None
        self._clock_s: float | None = None
        self._unverified_s: float | None = None
        self._said = ""

    def update(self, trusted: TrustedReceiver, now_s: float, *, is_verified: bool) -> None:
        """Log what has changed; ``now_s`` is the host's monotonic clock."""
        self._on_clock(trusted)
        if is_verified:
            self._unverified_s, self._said = None, ""
            if trusted.verifier.keys.serial != self._serial:
                self._serial = trusted.verifier.keys.serial
                self._log(f"{self._name}: beacons of site {self._site} are verified (key chain {self._serial})")
            self._lines.update(trusted.faults(), now_s)
            return
        reason = trust_reason(trusted)
        self._unverified_s = now_s if self._unverified_s is None else self._unverified_s
        if reason in _WORDS and reason != self._said and now_s - self._unverified_s >= PATIENCE_S:
            self._said, self._serial = reason, None
            self._log(f"{self._name}: no beacon is verified: {_WORDS[reason]}")

    def _on_clock(self, trusted: TrustedReceiver) -> None:
        error_s = trusted.verifier.clock.error_s
        if error_s is not None and self._clock_s is None:
            side = "ahead of" if error_s > 0.0 else "behind"
            self._log(
                f"{self._name}: this host's clock is {abs(error_s):.1f} s {side} that of site {self._site}: set it "
                "with chrony or NTP"
            )
        elif error_s is None and self._clock_s is not None:
            self._log(f"{self._name}: this host's clock is that of site {self._site} again")
        self._clock_s = error_s
