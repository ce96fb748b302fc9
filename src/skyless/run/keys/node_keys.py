"""Keys in the programs: an anchor's chains from files, a tag's memory of them, and what both log of codes."""

import contextlib
import os
import time
from collections.abc import Iterable, Mapping
from hashlib import sha256
from pathlib import Path
from typing import Final

import msgspec
from msgspec import Struct

from skyless.core.air.beacon import CERTIFICATE_BYTES
from skyless.core.anchor import BeaconAuthentication
from skyless.core.errors import SkylessError
from skyless.core.keys.chain import Chain, ChainRing
from skyless.core.keys.verifier import Fault
from skyless.core.trusted_receiver import SiteTrust, TrustedReceiver
from skyless.core.whole_files import write_whole
from skyless.run.keys.key_files import MAX_SERIAL, SEEDS_VARIABLE, SiteKeys, parse_seeds, read_keys
from skyless.run.process import Log

KEYS_S: Final = 3.0
"""Interval at which files are looked at."""

RECENT_S: Final = 2.0
"""Faults that are older do not count."""

LASTING_S: Final = 4.0
"""Faults that last for a shorter time, as a moment after a start, are not logged."""

CALM_S: Final = 30.0
"""An anchor is said to be accepted again after this time without a fault."""

MAX_NAMED: Final = 8
"""Anchors that are named at the same time: forged frames can name any."""

UNVERIFIED_S: Final = 10.0
"""After this time without verified beacons the cause is logged: a certificate comes every second or so."""

_DAY_S: Final = 86_400.0
_LITTLE_LEFT_S: Final = 60.0 * _DAY_S
_MAX_MEMORY_BYTES: Final = 1 << 16
_WRONG: Final = (Fault.BAD_CODE, Fault.LATE, Fault.EARLY)

_NOT_ACCEPTED: Final = {
    Fault.NO_CODE: "they carry no codes: it has no keys, or somebody forges its beacons",
    Fault.BAD_CODE: "their codes are wrong: it has a wrong seed, or somebody forges its beacons",
    Fault.REVOKED_CHAIN: "it uses a key chain that the site has replaced (copy the new one to its host), or somebody "
    "repeats old beacons",
    Fault.LATE: "they come too late: its clock or this one is wrong, or somebody repeats old beacons",
    Fault.EARLY: "they come too early: its clock or this one is wrong",
    Fault.REPEATED: "somebody repeats them",
}

_WITHOUT_CODES: Final = {
    Fault.NO_TIME: "the radio's counter has not been read yet",
    Fault.NO_CHAIN: "no key chain counts now (skyless site keys show)",
    Fault.CLOCK_WRONG: "this host's clock differs from the other anchors' clocks: set it with chrony or NTP",
}

_NOT_VERIFIED: Final = {
    "no-code": "the beacons carry no codes: the site's anchors have no keys, or these are not its anchors",
    "no-certificate": "no certificate of the site's key was received: the key file may be of another site",
    "no-key": "no key was disclosed that fits: too few beacons are received",
}


# An anchor


class AnchorKeys:
    """Key chains of a site, shared by the anchors of a process and read again whenever their files change."""

    def __init__(self, folder: Path, site: int, log: Log, environment: Mapping[str, str] = os.environ) -> None:
        """Read them. Raises SkylessError: they cannot be used."""
        self._folder, self._site, self._log = folder, site, log
        self._seeds = parse_seeds(environment.get(SEEDS_VARIABLE, ""))
        self._seen = self._state()
        self._trouble = ""
        self._warned_day: int | None = None
        self._use(read_keys(folder, site, self._seeds))

    def update(self) -> bool:
        """Read the files again if they have changed. Returns whether the chains have changed.

        Files that cannot be used, as while they are copied, are logged once, and what was read before stays in use.
        """
        state = self._state()
        if state == self._seen:
            return False
        self._seen, before = state, self.chains
        try:
            keys = read_keys(self._folder, self._site, self._seeds)
        except SkylessError as error:
            if str(error) != self._trouble:
                self._trouble = str(error)
                self._log(f"keys: the earlier ones stay in use: {error}")
            return False
        self._trouble = ""
        self._use(keys)
        return self.chains != before

    def _use(self, keys: SiteKeys) -> None:
        self.chains: tuple[Chain, ...] = keys.chains
        self._ring = ChainRing(keys.chains)
        newest = keys.chains[-1]
        waiting = [serial for serial in keys.without_seed if serial > newest.serial]
        if waiting:
            self._log(f"keys: chain {waiting[-1]} has no seed in {self._folder}; chain {newest.serial} stays in use")

    def present(self, unix_s: float) -> int | None:
        """Serial number of the chain in use at a Unix time."""
        timing = self._ring.timing
        keys = None if timing is None else self._ring.at(timing.interval_at(unix_s))
        return None if keys is None else keys.chain.serial

    @property
    def ends_s(self) -> float:
        """Unix time at which the last chain ends."""
        return max(chain.timing.start_s(chain.end) for chain in self.chains)

    def warn(self, unix_s: float) -> None:
        """Log once a day when little is left of the last chain."""
        left_s = self.ends_s - unix_s
        day = int(left_s // _DAY_S)
        if left_s > _LITTLE_LEFT_S or day == self._warned_day:
            return
        self._warned_day = day
        until = time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(self.ends_s))
        days = f"in {day} days" if day else "within a day"
        what = f"ends {days} ({until})" if left_s > 0.0 else f"has ended ({until})"
        self._log(f"keys: the last key chain {what}: skyless site keys rotate makes another one")

    def _state(self) -> tuple[tuple[str, int, int, int], ...]:
        """What shows that a file has changed."""
        try:
            with os.scandir(self._folder) as entries:
                known = [(entry.name, entry.stat()) for entry in entries if entry.name.endswith((".public", ".seed"))]
        except OSError:
            return ()
        return tuple(sorted((name, one.st_mtime_ns, one.st_size, one.st_mode) for name, one in known))


class AnchorReport:
    """Logs when an anchor's codes begin and end, and whose beacons are not accepted."""

    def __init__(self, anchor: int, log: Log) -> None:
        self._name, self._log = f"anchor {anchor}", log
        self._lines = FaultLines(self._name, log)
        self._logged: str | None = None
        self._is_alone = False

    def update(
        self, authentication: BeaconAuthentication, serial: int | None, accepted_s: float, unix_s: float, now_s: float
    ) -> None:
        """Log what has changed. Call it once a second.

        ``serial`` is the number of the chain in use, ``accepted_s`` when a beacon of another anchor was accepted last,
        ``now_s`` the present, both by the host's monotonic clock.
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
            else f"beacons carry no codes: {_WITHOUT_CODES.get(fault, fault)}"
        )
        if line != self._logged:
            self._logged = line
            self._log(f"{self._name}: {line}")


def recent_faults(authentication: BeaconAuthentication, unix_s: float) -> dict[int, Fault]:
    """Other anchors with a fault within the last seconds."""
    faults = authentication.faults.items()
    return {anchor: fault for anchor, (fault, when_s) in faults if abs(unix_s - when_s) <= RECENT_S}


# A tag


class Remembered(Struct, frozen=True):
    """What a tag remembers of a site's keys for its next start. Signatures are checked again when it is used."""

    serial: int = 0
    """Key chains with lower serial numbers have been revoked."""
    certificates: tuple[bytes, ...] = ()


class TagMemory:
    """The file of one site and public key. One that is damaged, or cannot be written, is ignored."""

    def __init__(self, trust: SiteTrust, folder: Path) -> None:
        """``folder``: the user's data folder of Skyless."""
        key = sha256(trust.public).hexdigest()[:16]
        self.file = folder / "trust" / f"{trust.site}-{key}.json"
        self.remembered = self._read()

    def keep(self, serial: int, certificates: Iterable[bytes]) -> None:
        """Write what is known now, if it has changed. The serial number never decreases."""
        known = Remembered(serial, tuple(certificates))
        if known == self.remembered:
            return
        self.remembered, others = known, self._read()
        known = Remembered(max(serial, others.serial), known.certificates or others.certificates)
        if known != others:
            with contextlib.suppress(OSError):
                self.file.parent.mkdir(exist_ok=True)
                write_whole(self.file, msgspec.json.encode(known))

    def _read(self) -> Remembered:
        try:
            with self.file.open("rb") as file:
                read = msgspec.json.decode(file.read(_MAX_MEMORY_BYTES), type=Remembered)
        except (OSError, msgspec.MsgspecError):
            return Remembered()
        if not 0 <= read.serial <= MAX_SERIAL or any(len(one) != CERTIFICATE_BYTES for one in read.certificates):
            return Remembered()
        return read


def trust_reason(trusted: TrustedReceiver) -> str | None:
    """Why no beacon has been verified within the last second, or None where some have, or none has come at all."""
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
    """Logs why a tag verifies no beacons, and which anchors it does not accept."""

    def __init__(self, tag: str, site: int, log: Log) -> None:
        self._name, self._site, self._log = f"tag {tag}", site, log
        self._lines = FaultLines(self._name, log)
        self._serial: int | None = None
        self._clock_s: float | None = None
        self._unverified_s: float | None = None
        self._logged = ""

    def update(self, trusted: TrustedReceiver, now_s: float, *, is_verified: bool) -> None:
        """Log what has changed. Call it once a second. ``now_s`` is the host's monotonic clock."""
        self._on_clock(trusted)
        if is_verified:
            self._unverified_s, self._logged = None, ""
            if trusted.verifier.keys.serial != self._serial:
                self._serial = trusted.verifier.keys.serial
                self._log(f"{self._name}: beacons of site {self._site} are verified (key chain {self._serial})")
            self._lines.update(trusted.faults(), now_s)
            return
        reason = trust_reason(trusted)
        self._unverified_s = now_s if self._unverified_s is None else self._unverified_s
        if reason in _NOT_VERIFIED and reason != self._logged and now_s - self._unverified_s >= UNVERIFIED_S:
            self._logged, self._serial = reason, None
            self._log(f"{self._name}: no beacon is verified: {_NOT_VERIFIED[reason]}")

    def _on_clock(self, trusted: TrustedReceiver) -> None:
        error_s = trusted.verifier.clock.error_s
        if error_s is not None and self._clock_s is None:
            side = "ahead of" if error_s > 0.0 else "behind"
            self._log(
                f"{self._name}: this host's clock is {abs(error_s):.1f} s {side} site {self._site}'s: set it "
                "with chrony or NTP"
            )
        elif error_s is None and self._clock_s is not None:
            self._log(f"{self._name}: this host's clock agrees with site {self._site} again")
        self._clock_s = error_s


# Both


class _Known(Struct):
    """An anchor with faults."""

    fault: Fault
    first_s: float
    last_s: float
    is_logged: bool = False


class FaultLines:
    """Logs whose beacons are not accepted: one line when that begins, one when it is over."""

    def __init__(self, name: str, log: Log) -> None:
        """``name`` is that of the anchor or tag whose log this is."""
        self._name, self._log = name, log
        self._known: dict[int, _Known] = {}

    def update(self, faults: Mapping[int, Fault], now_s: float) -> None:
        """Log what has changed. ``faults`` are those of the last seconds, ``now_s`` is the host's monotonic clock."""
        for anchor, fault in sorted(faults.items()):
            known = self._known.get(anchor)
            if known is None and len(self._known) >= MAX_NAMED:
                continue
            if known is None or known.fault is not fault:
                known = self._known[anchor] = _Known(fault, now_s, now_s)
            known.last_s = now_s
            if not known.is_logged and now_s - known.first_s >= LASTING_S:
                known.is_logged = True
                why = _NOT_ACCEPTED.get(fault, fault)
                self._log(f"{self._name}: beacons of anchor {anchor} are not accepted: {why}")
        for anchor, known in list(self._known.items()):
            calm_s = now_s - known.last_s
            if calm_s >= (CALM_S if known.is_logged else LASTING_S):
                del self._known[anchor]
                if known.is_logged:
                    self._log(f"{self._name}: no beacon of anchor {anchor} was refused for {CALM_S:.0f} s")
