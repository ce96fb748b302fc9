"""Keys of a site's chain, and codes made with them: the arithmetic of ``docs/authentication.md``, without any state.

Time is divided into intervals, counted from the beginning of Unix time, and every interval has a key of 16 bytes. The
keys of ``SECTION_INTERVALS`` intervals form a section: a one-way chain of its own, in which each key is a hash of the
one after it. The key before a section's first is its root, which a certificate states.
"""

import hmac
import struct
from hashlib import sha256
from typing import Final

from msgspec import Struct

from skyless.air.codec2 import MAC_BYTES

KEY_BYTES: Final = 16
SEED_BYTES: Final = 32
SECTION_BITS: Final = 13
SECTION_INTERVALS: Final = 1 << SECTION_BITS
"""Steps that a listener hashes at most to come from a root to a key; 14 minutes with intervals of 100 ms."""

_SECTION: Final = struct.Struct("<HHI")
_KEY_LABEL: Final = b"skyless key"
_MAC_LABEL: Final = b"skyless mac"
_SEED_LABEL: Final = b"skyless seed"


class SectionName(Struct, frozen=True, gc=False):
    """Which section of which chain of which site."""

    site: int
    """16 bits."""
    serial: int
    """Number of the chain, 16 bits: a later chain of a site has a higher one."""
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
    """The key of an interval that many intervals before that of ``key``."""
    label = _KEY_LABEL + name.packed
    for _ in range(steps):
        key = sha256(label + key).digest()[:KEY_BYTES]
    return key


def root_of(seed: bytes, name: SectionName) -> bytes:
    """The root of a section."""
    return earlier_key(last_key(seed, name), name, SECTION_INTERVALS)


def mac_key(key: bytes, name: SectionName) -> bytes:
    """What codes of an interval are made with: not the chain's key itself, so that each serves one purpose."""
    return sha256(_MAC_LABEL + name.packed + key).digest()[:KEY_BYTES]


def mac_of(signed: bytes, key_of_macs: bytes) -> bytes:
    """Code of a frame's bytes; ``key_of_macs`` as ``mac_key`` gives it."""
    return hmac.digest(key_of_macs, signed, "sha256")[:MAC_BYTES]


def is_mac(signed: bytes, mac: bytes, key_of_macs: bytes) -> bool:
    """Whether a code is that of these bytes; takes the same time wherever they differ."""
    return hmac.compare_digest(mac, mac_of(signed, key_of_macs))
