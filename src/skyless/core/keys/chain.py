"""A site's key chain as its anchors hold it: with the seed, from which every key follows."""

import hmac
import struct
from collections.abc import Iterable
from hashlib import sha256
from typing import TYPE_CHECKING, Final

from msgspec import Struct

from skyless.core.air.beacon import CERTIFICATE_BYTES, MAC_BYTES

if TYPE_CHECKING:
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey

# Keys of a site's chain, codes made with them, and signed certificates (Ed25519): ``docs/authentication.md``.
#
# Time is divided into intervals, counted from the beginning of Unix time, and every interval has a key of 16 bytes.
# The keys of ``SECTION_INTERVALS`` intervals form a section: a one-way chain of its own, in which each key is a hash
# of the one after it. The key before a section's first is its root, which a certificate states. No state is kept
# here.

KEY_BYTES: Final = 16
SEED_BYTES: Final = 32
SECTION_BITS: Final = 13
SECTION_INTERVALS: Final = 1 << SECTION_BITS
"""Most steps that a listener hashes from a root to a key; 14 minutes with intervals of 100 ms."""

_SECTION: Final = struct.Struct("<HHI")
_KEY_LABEL: Final = b"skyless key"
_MAC_LABEL: Final = b"skyless mac"
_SEED_LABEL: Final = b"skyless seed"


class SectionName(Struct, frozen=True, gc=False):
    """Identifies a section: site, chain and first interval."""

    site: int
    """16 bits."""
    serial: int
    """Number of the chain, 16 bits; later chains of a site have higher ones."""
    section: int
    """Number of its first interval divided by ``SECTION_INTERVALS``, 32 bits."""

    @property
    def first_interval(self) -> int:
        """Its first interval."""
        return self.section << SECTION_BITS

    @property
    def packed(self) -> bytes:
        """Eight bytes, little endian."""
        return _SECTION.pack(self.site, self.serial, self.section)


def last_key(seed: bytes, name: SectionName) -> bytes:
    """The key of a section's last interval, from which all others follow."""
    return hmac.digest(seed, _SEED_LABEL + name.packed, "sha256")[:KEY_BYTES]


def earlier_key(key: bytes, name: SectionName, steps: int = 1) -> bytes:
    """The key ``steps`` intervals before that of ``key``."""
    label = _KEY_LABEL + name.packed
    for _ in range(steps):
        key = sha256(label + key).digest()[:KEY_BYTES]
    return key


def root_of(seed: bytes, name: SectionName) -> bytes:
    """The root of a section."""
    return earlier_key(last_key(seed, name), name, SECTION_INTERVALS)


def mac_key(key: bytes, name: SectionName) -> bytes:
    """The key for codes of an interval: derived from the chain's key, so that each serves one purpose."""
    return sha256(_MAC_LABEL + name.packed + key).digest()[:KEY_BYTES]


def mac_of(signed: bytes, key_of_macs: bytes) -> bytes:
    """Authentication code of a frame's bytes; ``key_of_macs`` comes from ``mac_key``."""
    return hmac.digest(key_of_macs, signed, "sha256")[:MAC_BYTES]


def is_mac(signed: bytes, mac: bytes, key_of_macs: bytes) -> bool:
    """Whether the code matches these bytes; in constant time."""
    return hmac.compare_digest(mac, mac_of(signed, key_of_macs))


MIN_LAG: Final = 4
"""Shorter lags leave no tolerance for the clocks of tags."""

CERTIFICATE_SIGNATURE_BYTES: Final = 64
PUBLIC_KEY_BYTES: Final = 32

_STATEMENT: Final = struct.Struct("<HIBIHB16s")
_LABEL: Final = b"skyless chain"
_SITE: Final = struct.Struct("<H")
assert _STATEMENT.size + CERTIFICATE_SIGNATURE_BYTES == CERTIFICATE_BYTES


class ChainTiming(Struct, frozen=True, gc=False):
    """When keys are valid and when disclosed, and the budget of clock errors that follows.

    A frame is sent up to the end of its interval, T, by a clock that may be behind by ``anchors_apart_s``. A tag must
    have received it before any anchor, whose clock may be ahead by ``anchor_lead_s``, discloses its key, and knows the
    time to ± B. So every genuine frame is accepted, and no other, if lag · T >= T + apart + lead + 2 B.
    """

    interval_ms: int = 100
    """Length of an interval, 10 to 10000."""
    lag: int = 5
    """Intervals from a key's own to its disclosure, 4 to 255."""

    @property
    def interval_s(self) -> float:
        """Length of an interval."""
        return self.interval_ms * 1e-3

    @property
    def anchors_apart_s(self) -> float:
        """Largest difference of two anchors' clocks. An anchor further ahead is reported and left out."""
        return 0.5 * self.interval_s

    @property
    def anchor_lead_s(self) -> float:
        """How far an anchor may be ahead of others and still disclose keys.

        It notices leads beyond ``anchors_apart_s``, and knows the others' sending times only to an interval.
        """
        return self.anchors_apart_s + self.interval_s

    def interval_at(self, unix_s: float) -> int:
        """Number of the interval at a Unix time."""
        return int(unix_s * 1000.0) // self.interval_ms

    def start_s(self, interval: int) -> float:
        """Unix time at which an interval begins."""
        return interval * self.interval_ms * 1e-3

    def is_possible(self) -> bool:
        """Whether the values are within their limits."""
        return 10 <= self.interval_ms <= 10_000 and MIN_LAG <= self.lag <= 255


USUAL_TIMING: Final = ChainTiming()
"""A key is known 0.4 to 0.6 s after its frame. Clocks of tags may be off by 0.1 s, those of anchors by 25 ms."""


class Certificate(Struct, frozen=True, gc=False):
    """The signed statement about one section of a chain."""

    name: SectionName
    timing: ChainTiming
    first: int
    """The first interval in which this chain replaces those with lower serial numbers; 40 bits."""
    root: bytes
    """16 bytes."""

    def signed_bytes(self) -> bytes:
        """The signed bytes: a label, the site, and everything that is sent but the signature."""
        return _LABEL + _SITE.pack(self.name.site) + self._statement()

    def _statement(self) -> bytes:
        name, timing = self.name, self.timing
        return _STATEMENT.pack(
            name.serial, self.first & 0xFFFFFFFF, self.first >> 32, name.section,
            timing.interval_ms, timing.lag, self.root,
        )  # fmt: skip

    def sent_bytes(self, signature: bytes) -> bytes:
        """The bytes in a frame."""
        return self._statement() + signature


def read_certificate(site: int, sent: bytes) -> tuple[Certificate, bytes] | None:
    """Decode a certificate in a frame of a site and its unverified signature; None if a value is impossible."""
    if len(sent) != CERTIFICATE_BYTES:
        return None
    serial, low, high, section, interval_ms, lag, root = _STATEMENT.unpack_from(sent)
    timing = ChainTiming(interval_ms, lag)
    first = low | high << 32
    if not timing.is_possible() or first >> SECTION_BITS > section:
        return None
    return Certificate(SectionName(site, serial, section), timing, first, root), sent[_STATEMENT.size :]


def section_of(sent: bytes) -> int:
    """The section number in an encoded certificate."""
    section: int = _STATEMENT.unpack_from(sent)[3]
    return section


def sign(certificate: Certificate, private: "Ed25519PrivateKey") -> bytes:
    """Sign a certificate with the site's private key."""
    return private.sign(certificate.signed_bytes())


def public_key(data: bytes) -> "Ed25519PublicKey":
    """A public key from 32 bytes. Raises ValueError for any other number."""
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey  # noqa: PLC0415 - loads OpenSSL

    return Ed25519PublicKey.from_public_bytes(data)


def is_signed(certificate: Certificate, signature: bytes, public: "Ed25519PublicKey") -> bool:
    """Whether the signature is valid for this public key."""
    from cryptography.exceptions import InvalidSignature  # noqa: PLC0415 - loads OpenSSL

    try:
        public.verify(signature, certificate.signed_bytes())
    except InvalidSignature:
        return False
    return True


STEPS_AHEAD: Final = 256
"""Keys of the next section made with each frame: 0.2 ms, so that no frame waits for the whole section."""

_MAX_SECTIONS: Final = 3


class Chain(Struct, frozen=True, repr_omit_defaults=True):
    """A key chain with its signatures; its ``repr`` hides the seed."""

    site: int
    serial: int
    timing: ChainTiming
    first: int
    """The first interval in which it is valid."""
    signatures: bytes
    """Signatures of its sections in order, from the section of ``first`` on, 64 bytes each."""
    seed: bytes
    """32 bytes, secret."""

    def __repr__(self) -> str:
        return f"Chain(site={self.site}, serial={self.serial}, first={self.first}, sections={self.sections})"

    @property
    def sections(self) -> int:
        """Number of sections."""
        return len(self.signatures) // CERTIFICATE_SIGNATURE_BYTES

    @property
    def end(self) -> int:
        """The first interval after its last section."""
        return (self.first >> SECTION_BITS) + self.sections << SECTION_BITS

    @property
    def begins_s(self) -> float:
        """Unix time at which it begins."""
        return self.timing.start_s(self.first)

    @property
    def ends_s(self) -> float:
        """Unix time at which it ends."""
        return self.timing.start_s(self.end)

    def holds(self, interval: int) -> bool:
        """Whether the chain has a key for an interval."""
        return self.first <= interval < self.end

    def name(self, interval: int) -> SectionName:
        """The section of an interval."""
        return SectionName(self.site, self.serial, interval >> SECTION_BITS)


def section_signatures(
    seed: bytes, site: int, serial: int, timing: ChainTiming, first: int, sections: range, private: "Ed25519PrivateKey"
) -> bytes:
    """Signatures of some sections of a chain: 5 to 20 ms each."""
    names = (SectionName(site, serial, section) for section in sections)
    return b"".join(sign(Certificate(name, timing, first, root_of(seed, name)), private) for name in names)


class ChainKeys:
    """Keys and certificates of one chain, computed on demand."""

    def __init__(self, chain: Chain) -> None:
        self.chain = chain
        self._sections: dict[int, list[bytes]] = {}
        """Keys of each section, that of the last interval first, the root last."""

    def key(self, interval: int) -> bytes:
        """The key of an interval of the chain."""
        keys = self._section(interval >> SECTION_BITS)
        return keys[SECTION_INTERVALS - 1 - (interval & SECTION_INTERVALS - 1)]

    def mac_key(self, interval: int) -> bytes:
        """The key for codes of that interval."""
        return mac_key(self.key(interval), self.chain.name(interval))

    def certificate(self, interval: int) -> bytes:
        """The encoded certificate of an interval's section."""
        chain, section = self.chain, interval >> SECTION_BITS
        at = (section - (chain.first >> SECTION_BITS)) * CERTIFICATE_SIGNATURE_BYTES
        root = self._section(section)[-1]
        certificate = Certificate(chain.name(interval), chain.timing, chain.first, root)
        return certificate.sent_bytes(chain.signatures[at : at + CERTIFICATE_SIGNATURE_BYTES])

    def prepare(self, interval: int) -> None:
        """Compute a few keys of the section of an interval that is needed soon."""
        if self.chain.holds(interval):
            self._section(interval >> SECTION_BITS, STEPS_AHEAD)

    def _section(self, section: int, steps: int = SECTION_INTERVALS) -> list[bytes]:
        """Keys of a section, after computing at most ``steps`` of them now."""
        name = SectionName(self.chain.site, self.chain.serial, section)
        keys = self._sections.get(section)
        if keys is None:
            if len(self._sections) >= _MAX_SECTIONS:
                del self._sections[min(self._sections)]
            keys = self._sections[section] = [last_key(self.chain.seed, name)]
        for _ in range(min(steps, SECTION_INTERVALS + 1 - len(keys))):
            keys.append(earlier_key(keys[-1], name))
        return keys


class ChainRing:
    """An anchor's chains of one site."""

    def __init__(self, chains: Iterable[Chain]) -> None:
        ordered = sorted(chains, key=lambda chain: -chain.serial)
        self._chains = tuple(ChainKeys(chain) for chain in ordered)

    def at(self, interval: int) -> ChainKeys | None:
        """The chain valid in an interval: the newest of those that have begun; None if that one has ended."""
        begun = next((keys for keys in self._chains if keys.chain.first <= interval), None)
        return begun if begun is not None and begun.chain.holds(interval) else None

    def serial_at(self, unix_s: float) -> int | None:
        """Serial number of the chain valid at a Unix time."""
        keys = None if self.timing is None else self.at(self.timing.interval_at(unix_s))
        return None if keys is None else keys.chain.serial

    def revoked(self, interval: int) -> tuple[ChainKeys, ...]:
        """Chains with a key for an interval in which they are no longer valid."""
        present = self.at(interval)
        return tuple(keys for keys in self._chains if keys is not present and keys.chain.holds(interval))

    @property
    def timing(self) -> ChainTiming | None:
        """Timing of the newest chain; None without chains."""
        return self._chains[0].chain.timing if self._chains else None

    def successor(self, interval: int) -> bytes | None:
        """The certificate of what follows an interval's section: another chain, or the next section."""
        present = self.at(interval)
        later = [keys for keys in self._chains if keys.chain.first > interval]
        next_interval = (interval >> SECTION_BITS) + 1 << SECTION_BITS
        if later and later[-1].chain.first < next_interval + SECTION_INTERVALS:
            return later[-1].certificate(later[-1].chain.first)
        if present is not None and present.chain.holds(next_interval):
            return present.certificate(next_interval)
        return later[-1].certificate(later[-1].chain.first) if later else None

    def prepare(self, interval: int) -> None:
        """Compute keys that are needed soon."""
        present = self.at(interval)
        if present is not None:
            present.prepare((interval >> SECTION_BITS) + 1 << SECTION_BITS)
        for keys in self._chains:
            if keys.chain.first > interval:
                keys.prepare(keys.chain.first)
