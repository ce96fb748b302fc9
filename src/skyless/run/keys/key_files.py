"""Files of a site's keys: one folder with the site's key pair and, for each key chain, its seed and its public part.

``site.private`` (PEM) stays with the operator, who makes chains with it. ``site.public`` (TOML) goes to tags and to the
hosts of anchors; ``chain-N.public`` and ``chain-N.seed`` go to the hosts of anchors. A seed may come from the
environment instead. Secret files are readable by their owner only, and their contents stand in no message.
"""

import hmac
import os
import re
import stat
import struct
import tomllib
from collections.abc import Mapping
from hashlib import sha256
from pathlib import Path
from typing import TYPE_CHECKING, Final

import msgspec
from msgspec import Struct
from msgspec.structs import replace

from skyless.core.errors import ConfigurationError, SkylessError
from skyless.core.keys.chain import (
    CERTIFICATE_SIGNATURE_BYTES,
    MIN_LAG,
    PUBLIC_KEY_BYTES,
    SECTION_BITS,
    SEED_BYTES,
    Certificate,
    Chain,
    ChainTiming,
    SectionName,
    is_signed,
    public_key,
    root_of,
)

if TYPE_CHECKING:
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

SITE_PRIVATE: Final = "site.private"
SITE_PUBLIC: Final = "site.public"
SEEDS_VARIABLE: Final = "SKYLESS_CHAIN_SEEDS"
"""The environment variable with seeds, as ``1:HEX 2:HEX``."""

MAX_SERIAL: Final = 0xFFFF
_MAX_BYTES: Final = 1 << 26
"""Largest size of any of the files, as devices never end. Ten years take 25 MB."""

_CHAIN_FILE: Final = re.compile(r"chain-([1-9]\d{0,4})\.public")
_MAGIC: Final = b"skyless chain 1\n"
_HEADER: Final = struct.Struct("<16sHHHBQ")
_DIGEST_BYTES: Final = 32
_ENTRY: Final = re.compile(rf"([1-9]\d{{0,4}}):([0-9a-fA-F]{{{2 * SEED_BYTES}}})")


class SitePublic(Struct, frozen=True):
    """What everybody may know of a site's keys."""

    site: int
    public: bytes
    """The public key, 32 bytes."""
    least_serial: int = 1
    """Key chains with lower serial numbers have been revoked."""

    @property
    def fingerprint(self) -> str:
        """A few digits that two people can compare."""
        digits = sha256(self.public).hexdigest()[:16]
        return " ".join(digits[at : at + 4] for at in range(0, 16, 4))


class SiteKeys(Struct, frozen=True):
    """What an anchor's host has."""

    public: SitePublic
    chains: tuple[Chain, ...]
    without_seed: tuple[int, ...] = ()
    """Serial numbers of chains whose seed is not there."""


class _PublicDocument(Struct, frozen=True, forbid_unknown_fields=True):
    """``site.public`` as it is written."""

    site: int
    public_key: str
    least_serial: int


# Names


def chain_public_file(folder: Path, serial: int) -> Path:
    """Where the public part of a chain is."""
    return folder / f"chain-{serial}.public"


def chain_seed_file(folder: Path, serial: int) -> Path:
    """Where the seed of a chain is."""
    return folder / f"chain-{serial}.seed"


def serials_in(folder: Path) -> tuple[int, ...]:
    """Serial numbers of the chains in a folder, in their order. Raises OSError."""
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
    """The public key in a file. Raises SkylessError."""
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
    """The site's private key. Raises SkylessError, also where it does not belong to the public key."""
    from cryptography.exceptions import UnsupportedAlgorithm  # noqa: PLC0415 - loads OpenSSL
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey  # noqa: PLC0415
    from cryptography.hazmat.primitives.serialization import load_pem_private_key  # noqa: PLC0415

    file = folder / SITE_PRIVATE
    try:
        private = load_pem_private_key(_read_secret(file), None)
    except (ValueError, TypeError, UnsupportedAlgorithm):
        private = None
    if not isinstance(private, Ed25519PrivateKey):
        raise ConfigurationError(file, "", None, "the site.private that skyless site keys new made, unencrypted")
    if private.public_key().public_bytes_raw() != public.public:
        raise SkylessError(f"{file} is not the private key of {folder / SITE_PUBLIC}; they should be of one site")
    return private


def read_chain_public(folder: Path, serial: int, site: int) -> Chain:
    """A chain without its seed, which is empty. Raises SkylessError."""
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
    """What an anchor's host needs: the chains with their seeds, which are in the folder or in ``seeds``.

    That seed, signatures and public key belong together is verified with the first section of each chain.

    Raises:
        SkylessError: something is missing, damaged, of another site, or a secret that others can read.
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
    """The public key in a folder of keys of a site. Raises SkylessError."""
    if not folder.is_dir():
        raise SkylessError(f"{folder} is no folder; it should be one with keys, which skyless site keys new makes")
    public = read_site_public(folder / SITE_PUBLIC)
    if public.site != site:
        raise SkylessError(f"{folder / SITE_PUBLIC} is of site {public.site}; it should be of site {site}")
    return public


def parse_seeds(text: str) -> dict[int, bytes]:
    """Seeds in the environment, by serial number. Raises SkylessError, whose message does not show them."""
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
    """Whether seed, signatures and public key belong together. Raises SkylessError."""
    name = SectionName(chain.site, chain.serial, chain.first >> SECTION_BITS)
    certificate = Certificate(name, chain.timing, chain.first, root_of(chain.seed, name))
    if not is_signed(certificate, chain.signatures[:CERTIFICATE_SIGNATURE_BYTES], public_key(public.public)):
        raise SkylessError(
            f"{chain_public_file(folder, chain.serial)} does not belong to its seed or to {SITE_PUBLIC}; all three "
            "should be copied from one folder of keys"
        )


def _read_seed(file: Path) -> bytes | None:
    """The seed in a file; None where there is no such file. Raises SkylessError."""
    if not file.exists():
        return None
    text = _read_secret(file).strip()
    if not re.fullmatch(rb"[0-9a-fA-F]{%d}" % (2 * SEED_BYTES), text):
        raise ConfigurationError(file, "", None, f"{2 * SEED_BYTES} hexadecimal digits")
    return bytes.fromhex(text.decode())


def _read_secret(file: Path) -> bytes:
    """A file that nobody but its owner can read. Raises SkylessError."""
    return _read(file, is_secret=True)


def _read(file: Path, *, is_secret: bool = False) -> bytes:
    """The bytes of a file. Raises SkylessError."""
    try:
        with open(file, "rb", opener=_open_at_once) as opened:
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


def _open_at_once(path: str, flags: int) -> int:
    """Does not wait for a writer if the name belongs to a pipe."""
    return os.open(path, flags | os.O_NONBLOCK)
