"""The key chain as the site's anchors have it: with the seed, from which every key follows, and how it is made."""

import multiprocessing
import os
import secrets
import signal
import threading
from collections.abc import Callable, Iterable
from concurrent.futures import ProcessPoolExecutor
from itertools import repeat
from typing import TYPE_CHECKING, Final

from msgspec import Struct

from skyless.core.keys.key_chain import (
    CERTIFICATE_SIGNATURE_BYTES,
    SECTION_BITS,
    SECTION_INTERVALS,
    SEED_BYTES,
    USUAL_TIMING,
    Certificate,
    ChainTiming,
    SectionName,
    earlier_key,
    last_key,
    mac_key,
    root_of,
    sign,
)
from skyless.core.processors import cores

if TYPE_CHECKING:
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

STEPS_AHEAD: Final = 256
"""Keys of the next section that are made with each frame: 0.2 ms, so that no frame waits for the whole section."""

_MAX_SECTIONS: Final = 3


class Chain(Struct, frozen=True, repr_omit_defaults=True):
    """A key chain and its signatures; its ``repr`` does not show the seed."""

    site: int
    serial: int
    timing: ChainTiming
    first: int
    """The first interval in which it counts."""
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
        """The first interval after its last."""
        return (self.first >> SECTION_BITS) + self.sections << SECTION_BITS

    def holds(self, interval: int) -> bool:
        """Whether it has a key for an interval."""
        return self.first <= interval < self.end

    def name(self, interval: int) -> SectionName:
        """The section of an interval."""
        return SectionName(self.site, self.serial, interval >> SECTION_BITS)


def section_signatures(
    seed: bytes, site: int, serial: int, timing: ChainTiming, first: int, sections: range, private: "Ed25519PrivateKey"
) -> bytes:
    """Signatures of some sections of a chain: 5 to 20 ms for each."""
    names = (SectionName(site, serial, section) for section in sections)
    return b"".join(sign(Certificate(name, timing, first, root_of(seed, name)), private) for name in names)


class ChainKeys:
    """Keys and certificates of one chain, made as they are needed."""

    def __init__(self, chain: Chain) -> None:
        self.chain = chain
        self._sections: dict[int, list[bytes]] = {}
        """Keys of sections, that of the last interval first, the root at the end."""

    def key(self, interval: int) -> bytes:
        """The key of an interval that the chain holds."""
        keys = self._section(interval >> SECTION_BITS)
        return keys[SECTION_INTERVALS - 1 - (interval & SECTION_INTERVALS - 1)]

    def mac_key(self, interval: int) -> bytes:
        """What codes of that interval are made with."""
        return mac_key(self.key(interval), self.chain.name(interval))

    def certificate(self, interval: int) -> bytes:
        """The certificate of the section of an interval, as it is sent."""
        chain, section = self.chain, interval >> SECTION_BITS
        at = (section - (chain.first >> SECTION_BITS)) * CERTIFICATE_SIGNATURE_BYTES
        root = self._section(section)[-1]
        certificate = Certificate(chain.name(interval), chain.timing, chain.first, root)
        return certificate.sent_bytes(chain.signatures[at : at + CERTIFICATE_SIGNATURE_BYTES])

    def prepare(self, interval: int) -> None:
        """Make a few keys of the section of an interval that is soon needed."""
        if self.chain.holds(interval):
            self._extend(interval >> SECTION_BITS, STEPS_AHEAD)

    def _section(self, section: int) -> list[bytes]:
        return self._extend(section, SECTION_INTERVALS)

    def _extend(self, section: int, steps: int) -> list[bytes]:
        """Keys of a section, up to that number of them made now."""
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
    """The chains of one site that an anchor has."""

    def __init__(self, chains: Iterable[Chain]) -> None:
        ordered = sorted(chains, key=lambda chain: -chain.serial)
        self._chains = tuple(ChainKeys(chain) for chain in ordered)

    def at(self, interval: int) -> ChainKeys | None:
        """The chain that counts in an interval: of those that have begun the last one made; None where it has ended."""
        begun = next((keys for keys in self._chains if keys.chain.first <= interval), None)
        return begun if begun is not None and begun.chain.holds(interval) else None

    def revoked(self, interval: int) -> tuple[ChainKeys, ...]:
        """Chains that hold a key for an interval, but do not count any more."""
        present = self.at(interval)
        return tuple(keys for keys in self._chains if keys is not present and keys.chain.holds(interval))

    @property
    def timing(self) -> ChainTiming | None:
        """Timing of the newest chain; None without any."""
        return self._chains[0].chain.timing if self._chains else None

    def successor(self, interval: int) -> bytes | None:
        """The certificate of what comes after the section of an interval: another chain, or the next section."""
        present = self.at(interval)
        later = [keys for keys in self._chains if keys.chain.first > interval]
        next_interval = (interval >> SECTION_BITS) + 1 << SECTION_BITS
        if later and later[-1].chain.first < next_interval + SECTION_INTERVALS:
            return later[-1].certificate(later[-1].chain.first)
        if present is not None and present.chain.holds(next_interval):
            return present.certificate(next_interval)
        return later[-1].certificate(later[-1].chain.first) if later else None

    def prepare(self, interval: int) -> None:
        """Make keys that are needed soon."""
        present = self.at(interval)
        if present is not None:
            present.prepare((interval >> SECTION_BITS) + 1 << SECTION_BITS)
        for keys in self._chains:
            if keys.chain.first > interval:
                keys.prepare(keys.chain.first)


_PIECE: Final = 64
"""Sections that a process makes at a time: 0.3 s."""

_FEW: Final = 128
"""Sections that are made sooner than processes start."""


def new_chain(
    site: int,
    serial: int,
    starts_s: float,
    ends_s: float,
    private: bytes,
    reached: Callable[[float], None],
    timing: ChainTiming = USUAL_TIMING,
) -> Chain:
    """A chain with a new seed between two Unix times, whose end is rounded up to whole sections (14 minutes).

    ``private``: the site's private key, 32 bytes. ``reached`` is called with the share of the work that is done.
    An interrupt ends all processes.
    """
    seed = secrets.token_bytes(SEED_BYTES)
    first = timing.interval_at(starts_s)
    begin, end = first >> SECTION_BITS, (timing.interval_at(ends_s) >> SECTION_BITS) + 1
    pieces = [range(at, min(at + _PIECE, end)) for at in range(begin, end, _PIECE)]
    signatures = bytearray()

    def add(piece: bytes) -> None:
        signatures.extend(piece)
        reached(len(signatures) / CERTIFICATE_SIGNATURE_BYTES / (end - begin))

    work = (repeat(seed), repeat(site), repeat(serial), repeat(timing), repeat(first), pieces, repeat(private))
    if end - begin <= _FEW:
        for piece in map(_signatures, *work):
            add(piece)
    else:
        context = multiprocessing.get_context("spawn")
        with ProcessPoolExecutor(min(cores(), len(pieces)), context, _start_worker) as pool:
            try:
                for piece in pool.map(_signatures, *work):
                    add(piece)
            except BaseException:
                pool.shutdown(wait=True, cancel_futures=True)
                raise
    return Chain(site, serial, timing, first, bytes(signatures), seed)


def _signatures(
    seed: bytes, site: int, serial: int, timing: ChainTiming, first: int, sections: range, private: bytes
) -> bytes:
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey  # noqa: PLC0415 - loads OpenSSL

    key = Ed25519PrivateKey.from_private_bytes(private)
    return section_signatures(seed, site, serial, timing, first, sections, key)


def _start_worker() -> None:
    """An interrupt reaches all processes of a terminal; the parent alone acts on it. A worker ends with its parent."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()
    assert parent is not None

    def watch() -> None:
        parent.join()
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
