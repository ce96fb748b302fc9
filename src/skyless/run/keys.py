"""A site's keys: their files, and how the programs of anchors and tags follow changes in them.

``site.private`` (PEM) stays with the operator, who makes chains with it. ``site.public`` (TOML) goes to tags and to the
hosts of anchors; ``chain-N.public`` and ``chain-N.seed`` go to the hosts of anchors. A seed may come from the
environment instead. Secret files are readable only by their owner, and no message shows their contents.
"""

import contextlib
import hmac
import os
import re
import stat
import struct
import time
import tomllib
from collections.abc import Iterable, Mapping
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING, Final

import msgspec
from msgspec import Struct
from msgspec.structs import replace

from skyless.core.air.beacon import CERTIFICATE_BYTES
from skyless.core.errors import ConfigurationError, SkylessError
from skyless.core.keys.authentication import RECENT_S, BeaconAuthentication
from skyless.core.keys.chain import (
    CERTIFICATE_SIGNATURE_BYTES,
    MIN_LAG,
    PUBLIC_KEY_BYTES,
    SECTION_BITS,
    SEED_BYTES,
    Chain,
    ChainKeys,
    ChainRing,
    ChainTiming,
    is_signed,
    public_key,
    read_certificate,
)
from skyless.core.keys.fault import Fault
from skyless.core.trusted_receiver import SiteTrust, TrustedReceiver
from skyless.files import write_whole
from skyless.run.process import Log

if TYPE_CHECKING:
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

SITE_PRIVATE: Final = "site.private"
SITE_PUBLIC: Final = "site.public"
SEEDS_VARIABLE: Final = "SKYLESS_CHAIN_SEEDS"
"""The environment variable with seeds, as ``1:HEX 2:HEX``."""

MAX_SERIAL: Final = 0xFFFF
_MAX_BYTES: Final = 1 << 26
"""Size limit of each file, because devices never end. Ten years of keys take 25 MB."""

_CHAIN_FILE: Final = re.compile(r"chain-([1-9]\d{0,4})\.public")
_MAGIC: Final = b"skyless chain 1\n"
_HEADER: Final = struct.Struct("<16sHHHBQ")
_DIGEST_BYTES: Final = 32
_ENTRY: Final = re.compile(rf"([1-9]\d{{0,4}}):([0-9a-fA-F]{{{2 * SEED_BYTES}}})")


class SitePublic(Struct, frozen=True):
    """The public part of a site's keys."""

    site: int
    public: bytes
    """The public key, 32 bytes."""
    least_serial: int = 1
    """Key chains with lower serial numbers have been revoked."""

    @property
    def fingerprint(self) -> str:
        """A few digits, for two people to compare."""
        digits = sha256(self.public).hexdigest()[:16]
        return " ".join(digits[at : at + 4] for at in range(0, 16, 4))


class SiteKeys(Struct, frozen=True):
    """The keys on an anchor's host."""

    public: SitePublic
    chains: tuple[Chain, ...]
    without_seed: tuple[int, ...] = ()
    """Serial numbers of chains without a seed."""


class _PublicDocument(Struct, frozen=True, forbid_unknown_fields=True):
    """The contents of ``site.public``."""

    site: int
    public_key: str
    least_serial: int


# Names


def chain_public_file(folder: Path, serial: int) -> Path:
    """Path of the public part of a chain."""
    return folder / f"chain-{serial}.public"


def chain_seed_file(folder: Path, serial: int) -> Path:
    """Path of the seed of a chain."""
    return folder / f"chain-{serial}.seed"


def serials_in(folder: Path) -> tuple[int, ...]:
    """Sorted serial numbers of the chains in a folder. Raises OSError."""
    found = (_CHAIN_FILE.fullmatch(entry.name) for entry in folder.iterdir())
    return tuple(sorted(int(match[1]) for match in found if match is not None and int(match[1]) <= MAX_SERIAL))


# From values to bytes


def site_public_bytes(public: SitePublic) -> bytes:
    """The contents of ``site.public``."""
    return (
        "# Public key of a Skyless site, by which tags verify its beacons. It is no secret.\n"
        f"site = {public.site}\n"
        f'public_key = "{public.public.hex()}"\n'
        "# Key chains with lower serial numbers have been revoked.\n"
        f"least_serial = {public.least_serial}\n"
    ).encode()


def private_bytes(private: "Ed25519PrivateKey") -> bytes:
    """The contents of ``site.private``: PKCS 8 in PEM."""
    from cryptography.hazmat.primitives import serialization  # noqa: PLC0415 - loads OpenSSL

    return private.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )


def seed_bytes(chain: Chain) -> bytes:
    """The contents of ``chain-N.seed``."""
    return f"{chain.seed.hex()}\n".encode()


def chain_public_bytes(chain: Chain) -> bytes:
    """The contents of ``chain-N.public``: a header, the signatures, and a digest against damage."""
    timing = chain.timing
    header = _HEADER.pack(_MAGIC, chain.site, chain.serial, timing.interval_ms, timing.lag, chain.first)
    body = header + chain.signatures
    return body + sha256(body).digest()


# From files to values


def read_site_public(file: Path) -> SitePublic:
    """Read the public key in a file. Raises SkylessError."""
    try:
        document = tomllib.loads(_read(file).decode())
        read = msgspec.convert(document, _PublicDocument)
    except (UnicodeDecodeError, tomllib.TOMLDecodeError, RecursionError):
        raise ConfigurationError(file, "", None, "the site.public that skyless site keys new makes") from None
    except msgspec.ValidationError as error:
        raise SkylessError(f"{file}: {error}; it should be the site.public that skyless site keys new makes") from None
    if not 0 <= read.site <= 0xFFFF:
        raise ConfigurationError(file, "site", read.site, "0 to 65535")
    if not 0 <= read.least_serial <= MAX_SERIAL:
        raise ConfigurationError(file, "least_serial", read.least_serial, f"0 to {MAX_SERIAL}")
    if not re.fullmatch(rf"[0-9a-fA-F]{{{2 * PUBLIC_KEY_BYTES}}}", read.public_key):
        raise ConfigurationError(file, "public_key", read.public_key, f"{2 * PUBLIC_KEY_BYTES} hexadecimal digits")
    return SitePublic(read.site, bytes.fromhex(read.public_key), read.least_serial)


def read_private(folder: Path, public: SitePublic) -> "Ed25519PrivateKey":
    """Read the site's private key. Raises SkylessError, also if it does not match the public key."""
    from cryptography.exceptions import UnsupportedAlgorithm  # noqa: PLC0415 - loads OpenSSL
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey  # noqa: PLC0415
    from cryptography.hazmat.primitives.serialization import load_pem_private_key  # noqa: PLC0415

    file = folder / SITE_PRIVATE
    try:
        private = load_pem_private_key(_read(file, is_secret=True), None)
    except (ValueError, TypeError, UnsupportedAlgorithm):
        private = None
    if not isinstance(private, Ed25519PrivateKey):
        raise ConfigurationError(file, "", None, "the site.private that skyless site keys new made, unencrypted")
    if private.public_key().public_bytes_raw() != public.public:
        raise SkylessError(f"{file} is not the private key of {folder / SITE_PUBLIC}; they should be of one site")
    return private


def read_chain_public(folder: Path, serial: int, site: int) -> Chain:
    """Read a chain without its seed, which is left empty. Raises SkylessError."""
    file = chain_public_file(folder, serial)
    data = _read(file)
    rest = len(data) - _HEADER.size - _DIGEST_BYTES
    body = data[:-_DIGEST_BYTES]
    if (
        not data.startswith(_MAGIC)
        or rest <= 0
        or rest % CERTIFICATE_SIGNATURE_BYTES
        or not hmac.compare_digest(sha256(body).digest(), data[-_DIGEST_BYTES:])
    ):
        raise ConfigurationError(
            file, "", None, "a whole file of skyless site keys; this one is damaged: copy it again"
        )
    _, found_site, found_serial, interval_ms, lag, first = _HEADER.unpack_from(data)
    timing = ChainTiming(interval_ms, lag)
    if found_site != site or found_serial != serial:
        raise SkylessError(
            f"{file} is chain {found_serial} of site {found_site}; it should be chain {serial} of site {site}"
        )
    sections = rest // CERTIFICATE_SIGNATURE_BYTES
    if interval_ms and lag < MIN_LAG:
        right = (
            f"{MIN_LAG} or more: make new keys (skyless site keys new); those of version 0.2 leave no room for clocks"
        )
        raise ConfigurationError(file, "lag", lag, right)
    if not timing.is_possible() or first >= 1 << 40 or (first >> SECTION_BITS) + sections > 1 << 32:
        raise ConfigurationError(file, "", None, "a key chain; its timing is impossible")
    return Chain(site, serial, timing, first, body[_HEADER.size :], b"")


def read_keys(folder: Path, site: int, seeds: Mapping[int, bytes]) -> SiteKeys:
    """Read the keys of an anchor's host: the chains, with seeds from the folder or from ``seeds``.

    The first section of each chain is used to verify that seed, signatures and public key belong together.

    Raises SkylessError: a file is missing, damaged, of another site, or a secret that others can read.
    """
    public = read_folder_public(folder, site)
    chains, without = [], []
    for serial in serials_in(folder):
        seed = seeds.get(serial) or _read_seed(chain_seed_file(folder, serial))
        if seed is None:
            without.append(serial)
            continue
        chain = replace(read_chain_public(folder, serial, site), seed=seed)
        _check_chain(folder, chain, public)
        chains.append(chain)
    if not chains or chains[-1].serial < public.least_serial:
        wanted = without[-1] if without else max(public.least_serial, 1)
        missing = [
            str(file)
            for file in (chain_public_file(folder, wanted), chain_seed_file(folder, wanted))
            if not file.exists()
        ]
        raise SkylessError(
            f"{' and '.join(missing)} {'is' if len(missing) == 1 else 'are'} missing; copy them from the folder of "
            f"keys of the site's operator, or put the seed in {SEEDS_VARIABLE}"
        )
    return SiteKeys(public, tuple(chains), tuple(without))


def read_folder_public(folder: Path, site: int) -> SitePublic:
    """Read the public key in a site's folder of keys. Raises SkylessError."""
    if not folder.is_dir():
        raise SkylessError(f"{folder} is no folder; it should be one with keys, which skyless site keys new makes")
    public = read_site_public(folder / SITE_PUBLIC)
    if public.site != site:
        raise SkylessError(f"{folder / SITE_PUBLIC} is of site {public.site}; it should be of site {site}")
    return public


def parse_seeds(text: str) -> dict[int, bytes]:
    """Parse seeds by serial number from the environment. Raises SkylessError, whose message does not show them."""
    seeds = {}
    for number, entry in enumerate(text.split(), start=1):
        match = _ENTRY.fullmatch(entry)
        if match is None or int(match[1]) > MAX_SERIAL:
            raise SkylessError(
                f"{SEEDS_VARIABLE}: entry {number} cannot be read; it should be a chain's serial number, a colon and "
                f"{2 * SEED_BYTES} hexadecimal digits, as chain-1.seed has them"
            )
        seeds[int(match[1])] = bytes.fromhex(match[2])
    return seeds


def _check_chain(folder: Path, chain: Chain, public: SitePublic) -> None:
    """Check that seed, signatures and public key belong together. Raises SkylessError."""
    read = read_certificate(chain.site, ChainKeys(chain).certificate(chain.first))
    if read is None or not is_signed(*read, public_key(public.public)):
        raise SkylessError(
            f"{chain_public_file(folder, chain.serial)} does not belong to its seed or to {SITE_PUBLIC}; all three "
            "should be copied from one folder of keys"
        )


def _read_seed(file: Path) -> bytes | None:
    """Read the seed in a file; None if the file does not exist. Raises SkylessError."""
    if not file.exists():
        return None
    text = _read(file, is_secret=True).strip()
    if not re.fullmatch(rb"[0-9a-fA-F]{%d}" % (2 * SEED_BYTES), text):
        raise ConfigurationError(file, "", None, f"{2 * SEED_BYTES} hexadecimal digits")
    return bytes.fromhex(text.decode())


def _read(file: Path, *, is_secret: bool = False) -> bytes:
    """Read a file. Raises SkylessError."""
    try:
        # O_NONBLOCK: do not wait for a writer if it is a pipe
        with open(file, "rb", opener=lambda path, flags: os.open(path, flags | os.O_NONBLOCK)) as opened:
            status = os.fstat(opened.fileno())
            if not stat.S_ISREG(status.st_mode):
                raise SkylessError(f"{file} is no file")
            if is_secret and status.st_mode & (stat.S_IRWXG | stat.S_IRWXO):
                raise SkylessError(f"{file} is a secret that others can read; run: chmod 600 {file}")
            data = opened.read(_MAX_BYTES + 1)
    except FileNotFoundError:
        raise SkylessError(f"{file} is missing") from None
    except OSError as error:
        raise SkylessError(f"{file} cannot be read: {error.strerror}") from None
    if len(data) > _MAX_BYTES:
        raise ConfigurationError(file, "", None, "a file of skyless site keys; this one is too large")
    return data


# Keys in the programs: an anchor's chains, a tag's memory of them, and log lines about codes.

KEYS_S: Final = 3.0
"""Interval at which files are checked for changes."""

LASTING_S: Final = 4.0
"""Faults that last for less than this, as after a start, are not logged."""

CALM_S: Final = 30.0
"""An anchor counts as accepted again after this time without a fault."""

MAX_NAMED: Final = 8
"""Largest number of anchors with faults at a time, as forged frames can name any."""

UNVERIFIED_S: Final = 10.0
"""After this time without verified beacons the cause is logged; a certificate comes every second or so."""

DAY_S: Final = 86_400.0
LITTLE_LEFT_S: Final = 60.0 * DAY_S
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
    """A site's key chains, shared by the anchors of a process and reloaded when their files change."""

    def __init__(self, folder: Path, site: int, log: Log, environment: Mapping[str, str] = os.environ) -> None:
        """Read the keys. Raises SkylessError if they cannot be used."""
        self._folder, self._site, self._log = folder, site, log
        self._seeds = parse_seeds(environment.get(SEEDS_VARIABLE, ""))
        self._seen = self._state()
        self._trouble = ""
        self._warned_day: int | None = None
        self._use(read_keys(folder, site, self._seeds))

    def update(self) -> bool:
        """Reload the files if they have changed. Returns whether the chains have changed.

        Unusable files, as during copying, are logged once, and the previous chains stay in use.
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
        """Serial number of the chain in use at a Unix time; None if there is none."""
        return self._ring.serial_at(unix_s)

    @property
    def ends_s(self) -> float:
        """Unix time at which the last chain ends."""
        return max(chain.ends_s for chain in self.chains)

    def warn(self, unix_s: float) -> None:
        """Log once a day when the last chain ends soon."""
        left_s = self.ends_s - unix_s
        day = int(left_s // DAY_S)
        if left_s > LITTLE_LEFT_S or day == self._warned_day:
            return
        self._warned_day = day
        until = time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(self.ends_s))
        days = f"in {day} days" if day else "within a day"
        what = f"ends {days} ({until})" if left_s > 0.0 else f"has ended ({until})"
        self._log(f"keys: the last key chain {what}: skyless site keys rotate makes another one")

    def _state(self) -> tuple[tuple[str, int, int, int], ...]:
        """Attributes of the files that reveal a change."""
        try:
            with os.scandir(self._folder) as entries:
                known = [(entry.name, entry.stat()) for entry in entries if entry.name.endswith((".public", ".seed"))]
        except OSError:
            return ()
        return tuple(sorted((name, one.st_mtime_ns, one.st_size, one.st_mode) for name, one in known))


class AnchorReport:
    """Logs when an anchor's codes start and stop, and whose beacons are not accepted."""

    def __init__(self, anchor: int, log: Log) -> None:
        self._lines = KeyLines(f"anchor {anchor}", log)

    def update(
        self, authentication: BeaconAuthentication, serial: int | None, accepted_s: float, unix_s: float, now_s: float
    ) -> None:
        """Log changes; call this once a second.

        ``serial`` is the chain in use, ``accepted_s`` when a beacon of another anchor was last accepted, ``now_s`` the
        present, both by the host's monotonic clock.
        """
        fault = authentication.fault()
        if fault is None:
            self._lines.say("codes", f"beacons carry codes of key chain {serial}")
        elif fault is not Fault.NO_TIME:  # normal for a moment after each start
            self._lines.say("codes", f"beacons carry no codes: {_WITHOUT_CODES.get(fault, fault)}")
        faults = authentication.recent_faults(unix_s)
        is_alone = now_s - accepted_s > RECENT_S and any(fault in _WRONG for fault in faults.values())
        alone = "no other anchor's code fits: the own seed or this host's clock is probably wrong"
        self._lines.say("alone", alone if is_alone else None)
        self._lines.update({} if is_alone else faults, now_s)


# A tag


class Remembered(Struct, frozen=True):
    """A tag's knowledge of a site's keys, stored for its next start, which checks the signatures again."""

    serial: int = 0
    """Key chains with lower serial numbers have been revoked."""
    certificates: tuple[bytes, ...] = ()


class TagMemory:
    """The memory file for one site and public key. A damaged or unwritable file is ignored."""

    def __init__(self, trust: SiteTrust, folder: Path) -> None:
        """``folder``: the user's data folder of Skyless."""
        key = sha256(trust.public).hexdigest()[:16]
        self.file = folder / "trust" / f"{trust.site}-{key}.json"
        self.remembered = self._read()

    def keep(self, serial: int, certificates: Iterable[bytes]) -> None:
        """Store the keys known now if they have changed. The serial number never decreases."""
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
                read = msgspec.json.decode(file.read(1 << 16), type=Remembered)
        except (OSError, msgspec.MsgspecError):
            return Remembered()
        if not 0 <= read.serial <= MAX_SERIAL or any(len(one) != CERTIFICATE_BYTES for one in read.certificates):
            return Remembered()
        return read


def trust_reason(trusted: TrustedReceiver) -> str | None:
    """Why no beacon was verified within the last second; None if some were, or none was received at all."""
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
        self._site = site
        self._lines = KeyLines(f"tag {tag}", log)
        self._is_clock_wrong = False
        self._unverified_s: float | None = None

    def update(self, trusted: TrustedReceiver, now_s: float, *, is_verified: bool) -> None:
        """Log changes; call this once a second. ``now_s`` is the host's monotonic clock."""
        self._on_clock(trusted)
        if is_verified:
            self._unverified_s = None
            chain = f"key chain {trusted.verifier.keys.serial}"
            self._lines.say("beacons", f"beacons of site {self._site} are verified ({chain})")
            self._lines.update(trusted.faults(), now_s)
            return
        reason = trust_reason(trusted)
        self._unverified_s = now_s if self._unverified_s is None else self._unverified_s
        if reason in _NOT_VERIFIED and now_s - self._unverified_s >= UNVERIFIED_S:
            self._lines.say("beacons", f"no beacon is verified: {_NOT_VERIFIED[reason]}")

    def _on_clock(self, trusted: TrustedReceiver) -> None:
        error_s = trusted.verifier.clock.error_s
        if error_s is not None and not self._is_clock_wrong:
            off = f"{abs(error_s):.1f} s {'ahead of' if error_s > 0.0 else 'behind'} site {self._site}'s"
            self._lines.say("clock", f"this host's clock is {off}: set it with chrony or NTP")
        elif error_s is None and self._is_clock_wrong:
            self._lines.say("clock", f"this host's clock agrees with site {self._site} again")
        self._is_clock_wrong = error_s is not None


# Both


class _Known(Struct):
    """An anchor with faults."""

    fault: Fault
    first_s: float
    last_s: float
    is_logged: bool = False


class KeyLines:
    """Logs what changes: each line once, and whose beacons are not accepted when that begins and ends."""

    def __init__(self, name: str, log: Log) -> None:
        """``name`` is the name of the anchor or tag that logs."""
        self._name, self._log = name, log
        self._said: dict[str, str | None] = {}
        self._known: dict[int, _Known] = {}

    def say(self, about: str, line: str | None) -> None:
        """Log a line unless it is the last one of its subject; None: there is nothing to say of it now."""
        if line is not None and line != self._said.get(about):
            self._log(f"{self._name}: {line}")
        self._said[about] = line

    def update(self, faults: Mapping[int, Fault], now_s: float) -> None:
        """Log changes. ``faults`` are those of the last seconds; ``now_s`` is the host's monotonic clock."""
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
