"""A listener's knowledge of a site's certificates and keys, and of when its anchors' frames are due."""

from collections.abc import Iterable, Sequence
from enum import Enum, auto
from hmac import compare_digest
from typing import TYPE_CHECKING, Final

from msgspec import Struct

from skyless.core.keys.chain import (
    SECTION_BITS,
    SECTION_INTERVALS,
    Certificate,
    ChainTiming,
    SectionName,
    earlier_key,
    is_signed,
    mac_key,
    read_certificate,
)
from skyless.core.keys.fault import Fault
from skyless.core.ticks import MAX_DRIFT, difference, from_seconds

if TYPE_CHECKING:
    from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey

KEPT_KEYS: Final = 256
"""Keys kept per section. Frames wait only seconds for their key."""
MAX_CERTIFICATES: Final = 6

NEAR_STEPS: Final = 16
"""Keys within this number of intervals after a verified one are checked at once, others within an allowance of hashes:
forged keys must not keep the processor busy. Keys sent by two anchors have an allowance of their own, so that many
different forged ones cannot block the genuine one."""
STEPS_PER_S: Final = 50_000.0
MAX_STEPS: Final = 40_000.0
MAX_SENDERS: Final = 4096
"""Most far keys whose first sender is remembered."""

CHECKS_PER_S: Final = 100.0
MAX_CHECKS: Final = 100.0
"""The same for signatures, of which each takes 0.1 to 0.4 ms."""


class KeyUse(Enum):
    """Outcomes of a certificate or a disclosed key."""

    KNOWN = auto()
    """It was known already; of a key also: it cannot be checked yet."""
    NEW = auto()
    FORGED = auto()
    IGNORED = auto()
    """A certificate beyond the allowance for checks."""
    REVOKED = auto()
    """A certificate signed by the site, but replaced by a later chain."""


class _Section(Struct):
    """A known section."""

    certificate: Certificate
    sent: bytes
    newest: int
    """The newest interval with a known key; that before the section's first for its root."""
    keys: dict[int, bytes]
    """Keys of the last intervals, the newest last."""


class KnownKeys:
    """The known chains of a site. Nothing forged is kept."""

    def __init__(
        self, site: int, public: "Ed25519PublicKey", least_serial: int = 0, certificates: Iterable[bytes] = ()
    ) -> None:
        """``least_serial``: chains with lower serial numbers are revoked.

        ``certificates``: those of an earlier run, whose signatures are checked again.
        """
        self._site, self._public = site, public
        self.serial = least_serial
        """The highest serial number of a chain known to be valid."""
        self.timing: ChainTiming | None = None
        """Timing of the keys; None before the first certificate."""
        self.newest = -1
        """The newest interval with a known key."""
        self._sections: dict[SectionName, _Section] = {}
        self._present = 0
        self._steps = {False: MAX_STEPS, True: MAX_STEPS}
        """Allowances of hashes, by whether two anchors sent the key."""
        self._checks, self._refilled_s = MAX_CHECKS, 0.0
        self._senders: dict[bytes, int] = {}
        """The anchor that first sent each far key."""
        for sent in certificates:
            read = read_certificate(site, sent)
            if read is not None and is_signed(*read, public):
                self._add(read[0], sent)

    @property
    def certificates(self) -> tuple[bytes, ...]:
        """Encoded certificates, with which a listener can start at once the next time."""
        return tuple(section.sent for section in self._sections.values())

    def on_certificate(self, sent: bytes, now_s: float) -> KeyUse:
        """Process a certificate received at ``now_s``, as far as the time is known."""
        known = next((one.certificate for one in self._sections.values() if one.sent == sent), None)
        if known is not None:
            return KeyUse.REVOKED if self._is_replaced(known, now_s) else KeyUse.KNOWN
        read = read_certificate(self._site, sent)
        if read is None:
            return KeyUse.FORGED
        self._refill(now_s)
        if self._checks < 1.0:
            return KeyUse.IGNORED
        self._checks -= 1.0
        certificate, signature = read
        if not is_signed(certificate, signature, self._public):
            return KeyUse.FORGED
        if certificate.name.serial < self.serial:
            return KeyUse.REVOKED
        self._present = certificate.timing.interval_at(now_s) >> SECTION_BITS
        self._add(certificate, sent)
        return KeyUse.NEW

    def on_key(self, key: bytes, interval: int, now_s: float, anchor: int, *, is_expected: bool = True) -> KeyUse:
        """Process the key of an interval that somebody disclosed in an anchor's name.

        ``is_expected``: whether this is about the time of its disclosure.
        """
        section = self._section_of(interval)
        if section is None:
            return KeyUse.KNOWN
        steps = interval - section.newest
        if steps <= 0:
            known = section.keys.get(interval)
            return KeyUse.FORGED if known is not None and not compare_digest(known, key) else KeyUse.KNOWN
        if steps > NEAR_STEPS or not is_expected:
            self._refill(now_s)
            if len(self._senders) >= MAX_SENDERS:
                self._senders.clear()
            by_two = self._senders.setdefault(key, anchor) != anchor
            if self._steps[by_two] < SECTION_INTERVALS:
                return KeyUse.KNOWN
            self._steps[by_two] -= SECTION_INTERVALS  # whatever it takes, so that short ones do not displace long ones
        name = section.certificate.name
        between = {interval: key}
        oldest = max(section.newest + 1, interval - KEPT_KEYS + 1)
        for earlier in range(interval - 1, oldest - 1, -1):
            key = between[earlier] = earlier_key(key, name)
        if not compare_digest(earlier_key(key, name, oldest - section.newest), section.keys[section.newest]):
            return KeyUse.FORGED
        for one in sorted(between):
            section.keys[one] = between[one]
        section.newest = interval
        for old in list(section.keys)[:-KEPT_KEYS]:
            del section.keys[old]
        self.newest = max(self.newest, interval)
        self.serial = max(self.serial, name.serial)
        self._present = max(self._present, name.section)
        return KeyUse.NEW

    def mac_key(self, interval: int) -> bytes | None:
        """The key for codes of an interval; None while unknown."""
        section = self._section_of(interval)
        key = None if section is None else section.keys.get(interval)
        return None if section is None or key is None else mac_key(key, section.certificate.name)

    def _section_of(self, interval: int) -> _Section | None:
        """The section of the chain valid in an interval; None if its certificate is unknown."""
        serials = [one.certificate.name.serial for one in self._sections.values() if one.certificate.first <= interval]
        serial = max(serials, default=0)
        return self._sections.get(SectionName(self._site, serial, interval >> SECTION_BITS))

    def _is_replaced(self, own: Certificate, now_s: float) -> bool:
        """Whether a later chain has replaced that of a certificate at this time."""
        disclosed = own.timing.interval_at(now_s) - own.timing.lag
        others = (one.certificate for one in self._sections.values())
        return any(one.name.serial > own.name.serial and one.first <= disclosed for one in others)

    def _add(self, certificate: Certificate, sent: bytes) -> None:
        name = certificate.name
        if name in self._sections:
            return
        root_at = name.first_interval - 1
        self._sections[name] = _Section(certificate, sent, root_at, {root_at: certificate.root})
        while len(self._sections) > MAX_CERTIFICATES:
            del self._sections[
                min(self._sections, key=lambda one: (one.section >= self._present, one.serial, one.section))
            ]
        self.timing = self._sections[max(self._sections, key=lambda one: one.serial)].certificate.timing
        counting = [one.newest for one in self._sections.values() if self._section_of(one.newest) is one]
        self.newest = max(counting, default=-1)  # keys of a chain that was revoked show nothing any more

    def _refill(self, now_s: float) -> None:
        """Refill the allowances for the time that has passed."""
        elapsed_s = min(max(now_s - self._refilled_s, 0.0), 1.0)
        self._refilled_s = now_s
        for by_two, steps in self._steps.items():
            self._steps[by_two] = min(steps + elapsed_s * STEPS_PER_S, MAX_STEPS)
        self._checks = min(self._checks + elapsed_s * CHECKS_PER_S, MAX_CHECKS)


# When frames arrive by the counters of both ends: a genuine frame that somebody sends again comes too late.

SLACK_TICKS: Final = from_seconds(1e-6)
"""Receiving a whole frame and sending it again takes at least 100 times this."""

SILENCE_TICKS: Final = from_seconds(1.0)
"""An anchor without a fitting frame for this time may have a restarted counter."""


class Stamps(Struct, frozen=True, gc=False):
    """Stamps of one genuine frame."""

    anchor: int
    rx_ticks: int
    """Own counter, unwrapped."""
    tx_ticks: int
    """The anchor's, 40 bits."""


class _Reference(Struct):
    """An anchor's last frame that agrees with its earliest one by both counters."""

    rx_ticks: int
    tx_ticks: int
    frames: int
    """Number of agreeing frames."""


class Arrivals:
    """When frames of each anchor are due."""

    def __init__(self) -> None:
        self._references: dict[int, _Reference] = {}

    def is_plausible(self, one: Stamps) -> bool:
        """Whether an unverified frame arrived when a frame of its anchor with this stamp is due.

        Before the first genuine frame of any anchor, every frame is plausible.
        """
        last = self._references.get(one.anchor)
        if last is None:
            return not self._references
        return not _delay_ticks(last, one)

    def faults(self, frames: Sequence[Stamps]) -> list[Fault | None]:
        """Judge the arrival of genuine frames that become known together, in order of reception.

        The fault is ``FIRST`` while no other frame of the anchor agrees, ``LATE``, or None. Nobody can send a frame
        before its anchor does. So if two of an anchor disagree, the later one is late.
        """
        references, late = self._references, set[int]()
        for number, one in enumerate(frames):
            last = references.get(one.anchor)
            if last is None:
                references[one.anchor] = _Reference(one.rx_ticks, one.tx_ticks, 1)
                continue
            delay_ticks = _delay_ticks(last, one)
            if not delay_ticks:
                last.frames += 1
                last.rx_ticks, last.tx_ticks = one.rx_ticks, one.tx_ticks
            elif delay_ticks > 0 and one.rx_ticks - last.rx_ticks <= SILENCE_TICKS:
                late.add(number)
            else:
                late.update(before for before in range(number) if frames[before].anchor == one.anchor)
                references[one.anchor] = _Reference(one.rx_ticks, one.tx_ticks, 1)
        confirmed = [None if references[one.anchor].frames > 1 else Fault.FIRST for one in frames]
        return [Fault.LATE if number in late else fault for number, fault in enumerate(confirmed)]


def _delay_ticks(last: _Reference, one: Stamps) -> int:
    """How much later than due a frame arrived; 0 if crystals and noise explain it."""
    elapsed = one.rx_ticks - last.rx_ticks
    delay_ticks = difference(last.tx_ticks + elapsed, one.tx_ticks)
    return 0 if abs(delay_ticks) <= SLACK_TICKS + MAX_DRIFT * abs(elapsed) else delay_ticks
