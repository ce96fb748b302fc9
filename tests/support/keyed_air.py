"""A simulated site with keys, maybe an attacker on its air, and what a tag makes of what it receives.

The attacker has some radios of its own among the anchors. Their frames overlap with genuine ones and reach tags and
anchors like any other. As noise they have the same times and lengths and mean nothing: the baseline of an attack.
"""

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from random import Random
from types import MappingProxyType
from typing import Final

import numpy as np
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from msgspec import Struct
from msgspec.structs import replace

from skyless.core.air.frame import Malformed, Reception, Transmission
from skyless.core.any_anchor import AnchorMachine, new_anchor
from skyless.core.any_receiver import SiteBeacon, decode_any
from skyless.core.arrays import Array
from skyless.core.fix import Fix
from skyless.core.keys.authentication import BeaconAuthentication
from skyless.core.keys.chain import SECTION_BITS, SEED_BYTES, USUAL_TIMING, Chain, ChainTiming, section_signatures
from skyless.core.site import AnchorSite, Site
from skyless.core.tag.receiver import Receiver
from skyless.core.ticks import TICK_RATE_HZ, TICK_S, Unwrapper, difference, from_seconds, wrap
from skyless.core.trusted_receiver import GivenFix, SiteTrust, Trust, TrustedReceiver
from skyless.sim.evaluation.scenarios import Request, impairments_of, trajectories_of
from skyless.sim.listening import TagSpec
from skyless.sim.world import World
from support.adversary import Adversary, Forgery

START_UNIX_S: Final = 1_800_000_000.0
"""Unix time at which simulated time begins."""

_FIRST_ID: Final = 0xF000
"""Identifiers of the attacker's radios, which are never sent."""
_RADIO_HZ: Final = 700.0
"""Frames that one radio can send: each is fetched a millisecond before."""
_LEAD_TICKS: Final = from_seconds(1.1e-3)
_NOISE_BYTES: Final = 40


# Anchors with keys


class MadeKeys(Struct, frozen=True):
    """Keys of a simulated site."""

    public: bytes
    chains: tuple[Chain, ...]


def made_keys(
    site: int, *starts_s: float, sections: int = 2, timing: ChainTiming = USUAL_TIMING, number: int = 1
) -> MadeKeys:
    """Keys of a site with a chain from each of these simulated times on. They follow from the number: no secret."""
    private = Ed25519PrivateKey.from_private_bytes(number.to_bytes(SEED_BYTES, "little"))
    chains = []
    for serial, start_s in enumerate(starts_s, start=1):
        first = timing.interval_at(START_UNIX_S + start_s)
        covered = range(first >> SECTION_BITS, (first >> SECTION_BITS) + sections)
        seed = (number << 16 | serial).to_bytes(SEED_BYTES, "big")
        signatures = section_signatures(seed, site, serial, timing, first, covered, private)
        chains.append(Chain(site, serial, timing, first, signatures, seed))
    return MadeKeys(private.public_key().public_bytes_raw(), tuple(chains))


class ClockedAnchor:
    """An anchor whose host has a clock: the simulation's, ahead by an error."""

    def __init__(self, machine: AnchorMachine, now_s: Callable[[], float], error_s: float = 0.0) -> None:
        self.id, self.machine = machine.id, machine
        self._now_s, self._error_s = now_s, error_s

    def hear(self, reception: Reception) -> None:
        """As ``AnchorMachine``."""
        self.machine.hear(reception)

    def next_transmission_ticks(self, now_ticks: int) -> int | None:
        """As ``AnchorMachine``; the host's clock is read as well."""
        authentication = getattr(self.machine, "authentication", None)
        if authentication is not None:
            authentication.set_time(now_ticks, START_UNIX_S + self._now_s() + self._error_s)
        return self.machine.next_transmission_ticks(now_ticks)

    def transmission(self, tx_ticks: int) -> Transmission:
        """As ``AnchorMachine``."""
        return self.machine.transmission(tx_ticks)


def anchors_with_keys(
    site: Site,
    now_s: Callable[[], float],
    chains: Sequence[Chain],
    *,
    others: Mapping[int, Sequence[Chain]] = MappingProxyType({}),
    errors_s: Mapping[int, float] = MappingProxyType({}),
) -> Callable[[int], ClockedAnchor]:
    """Makes a site's anchors: with these chains, some with others, and with clocks that are ahead."""

    def new(anchor: int) -> ClockedAnchor:
        authentication = BeaconAuthentication(others.get(anchor, chains), no_keys_s=0.0)
        return ClockedAnchor(new_anchor(site, anchor, 1e-3, authentication), now_s, errors_s.get(anchor, 0.0))

    return new


# The attacker


class Received(Struct, frozen=True, gc=False):
    """A reception of the tag."""

    anchor: int
    """The sender, or one of the attacker's radios."""
    reception: Reception
    is_genuine: bool
    """Whether an anchor of the site sent it."""
    position_m: Array
    """Where the tag was, shape (3,)."""


class Attack(Struct, frozen=True):
    """What the attacker does."""

    forgery: Forgery
    rate_hz: float
    from_s: float = 0.0
    """True time at which it begins."""
    is_noise: bool = False
    """Whether it only disturbs."""


class _Radio:
    """One of the attacker's radios, as a world uses anchors."""

    def __init__(self, air: "AttackedAir", number: int) -> None:
        self.id = _FIRST_ID + number
        self._air, self._number = air, number
        self._random = Random((air.seed << 8) + number)
        """Of times only, which are the same for noise."""
        self._ticks, self._next_ticks = Unwrapper(), 0

    def hear(self, reception: Reception) -> None:
        """Nothing: the attacker receives everything, even while it sends."""

    def next_transmission_ticks(self, now_ticks: int) -> int | None:
        """One after the other of the radios sends, at nearly even times."""
        attack, air = self._air.attack, self._air
        now = self._ticks.unwrap(now_ticks)
        if attack is None or air.world.now_s < attack.from_s:
            return None
        if not self._next_ticks:
            self._next_ticks = now + _LEAD_TICKS + round(self._number / attack.rate_hz * TICK_RATE_HZ)
        else:
            interval_s = (air.radios + self._random.uniform(-0.2, 0.2)) / attack.rate_hz
            self._next_ticks = max(self._next_ticks + round(interval_s * TICK_RATE_HZ), now + _LEAD_TICKS)
        return wrap(self._next_ticks)

    def transmission(self, tx_ticks: int) -> Transmission:
        """A forged frame."""
        air = self._air
        shown = wrap(air.world.medium.read_counter(air.world.medium.node_of[self.id]))
        return Transmission(air.forged(difference(tx_ticks, shown) * TICK_S), tx_ticks)


class AttackedAir:
    """A site with keys, one tag, and an attacker; deterministic by the request's seed."""

    def __init__(self, request: Request, keys: MadeKeys, attack: Attack | None = None) -> None:
        """``request``: the site, its impairments and the tag's motion."""
        site = request.site
        self.seed, self.attack = request.seed, attack
        self.anchors: dict[int, ClockedAnchor] = {}
        self.forged_frames = 0
        middle_m = np.mean([(anchor.x_m, anchor.y_m, anchor.z_m) for anchor in site.anchors], axis=0)
        self.adversary = Adversary(START_UNIX_S, request.seed, middle_m)
        self.radios = 0 if attack is None else int(attack.rate_hz / _RADIO_HZ) + 1
        radios = tuple(AnchorSite(_FIRST_ID + number, *middle_m.tolist()) for number in range(self.radios))
        new_anchor = anchors_with_keys(site, lambda: self.world.now_s, keys.chains)

        def factory(anchor: int) -> ClockedAnchor | _Radio:
            if anchor >= _FIRST_ID:
                return _Radio(self, anchor - _FIRST_ID)
            self.anchors[anchor] = new_anchor(anchor)
            return self.anchors[anchor]

        self.world = World(
            replace(site, anchors=site.anchors + radios),
            factory,
            [TagSpec(trajectories_of(request)[0])],
            impairments_of(request, site),
            request.seed,
        )

    def run(self, until_s: float) -> Iterator[Received]:
        """What the tag receives up to a true time."""
        for broadcast in self.world.run(until_s):
            is_genuine = broadcast.anchor < _FIRST_ID
            if is_genuine:
                self.adversary.overhear(broadcast.frame, broadcast.emission_s)
            for _, reception, position_m in broadcast.receptions():
                self.adversary.tag_m = position_m
                yield Received(broadcast.anchor, reception, is_genuine, position_m)

    def forged(self, ahead_s: float) -> bytes:
        """The attacker's frame for a time from now on."""
        adversary, attack = self.adversary, self.attack
        adversary.now_s = self.world.now_s + ahead_s
        self.forged_frames += 1
        if attack is None or not adversary.newest:
            return bytes(_NOISE_BYTES)
        frame = attack.forgery(adversary)
        return bytes(len(frame)) if attack.is_noise else frame


def delayed(received: Iterable[Received], delay_s: Callable[[Received], float]) -> list[Received]:
    """Receptions of a tag near which frames are disturbed and repeated later, without any further error.

    ``delay_s``: of each; 0 for one that is left alone. They are in the order in which they are then received.
    """
    repeated = []
    for one in received:
        later_s, before = delay_s(one), one.reception
        rx_ticks = wrap(before.rx_ticks + from_seconds(later_s))
        host_s = None if before.host_s is None else before.host_s + later_s
        repeated.append(replace(one, reception=replace(before, rx_ticks=rx_ticks, host_s=host_s)))
    return sorted(repeated, key=lambda one: one.reception.host_s or 0.0)


# The tag

FixKey = tuple[int, bytes]
"""By which a reception is recognised: its RX stamp and its frame."""


class Given(Struct, frozen=True):
    """A fix, and when it was given."""

    given_s: float
    fix: Fix
    key: FixKey
    """The reception that made it."""


class TagRun(Struct, frozen=True):
    """What a tag did with its receptions."""

    given: tuple[Given, ...]
    accepted: tuple[FixKey, ...]
    """Receptions of which verified fixes were made."""
    counters: Counter[str]
    faults: Counter[str]
    """Faults that were reported at some time, by anchor and reason."""


class Comparison(Struct, frozen=True):
    """Verified fixes against those of a plain receiver with the genuine frames only."""

    fixes: int
    moved: int
    """Fixes that are not, bit for bit, those of the accepted frames that are genuine."""
    forged: int
    """Accepted receptions that no anchor of the site sent at that time."""
    refused: int
    """Genuine receptions that were not accepted, those aside whose keys have not come yet."""
    most_moved_m: float
    """The farthest that a fix is from the one that a plain receiver makes with the same reception."""


class _Noting(Receiver):
    """A receiver that notes what it processes."""

    def __init__(self, site: int, accepted: list[FixKey]) -> None:
        super().__init__(site=site)
        self._accepted = accepted

    def hear_beacon(self, beacon: SiteBeacon, reception: Reception) -> Fix | None:
        """As ``Receiver``."""
        self._accepted.append(key_of(reception))
        return super().hear_beacon(beacon, reception)


def key_of(reception: Reception) -> FixKey:
    """What a reception is recognised by."""
    return reception.rx_ticks, reception.frame


def run_tag(
    received: Iterable[Received], trust: SiteTrust, certificates: Iterable[bytes] = (), clock_error_s: float = 0.0
) -> TagRun:
    """Let a tag that is switched on process receptions; ``clock_error_s``: how far its host's clock is ahead."""
    accepted: list[FixKey] = []
    plain = trust.trust is Trust.OPEN
    tag = TrustedReceiver(
        trust, lambda: Receiver(site=trust.site) if plain else _Noting(trust.site, accepted), certificates
    )
    given, faults = list[Given](), Counter[str]()
    for number, one in enumerate(received):
        host_s = one.reception.host_s or 0.0
        fixes: list[GivenFix] = tag.hear(one.reception, START_UNIX_S + host_s + clock_error_s)
        given += [Given(host_s, each.fix, key_of(each.reception)) for each in fixes]
        if number % 64 == 0:
            faults.update({str(fault) for fault in tag.faults().values()})
    return TagRun(tuple(given), tuple(accepted), tag.counters, faults)


def compare(run: TagRun, received: Sequence[Received], site: int) -> Comparison:
    """Compare verified fixes with those that a plain receiver makes of the same genuine frames alone."""
    genuine = {key_of(one.reception) for one in received if one.is_genuine}
    accepted = set(run.accepted)
    plain = Receiver(site=site)
    expected = {}
    last = max((number for number, one in enumerate(received) if key_of(one.reception) in accepted), default=-1)
    refused = 0
    for one in received[: last + 1]:
        key = key_of(one.reception)
        if not one.is_genuine or isinstance(decode_any(one.reception.frame), Malformed):
            continue
        if key not in accepted:
            refused += 1
            continue
        fix = plain.hear(one.reception)
        if fix is not None:
            expected[key] = fix
    moved, most_moved_m = 0, 0.0
    for each in run.given:
        right = expected.get(each.key)
        if right is None or right.rows != each.fix.rows:
            moved += 1
        if right is not None:
            most_moved_m = max(most_moved_m, float(np.linalg.norm(right.position_m - each.fix.position_m)))
    forged = sum(key not in genuine for key in run.accepted)
    return Comparison(len(run.given), moved, forged, refused, most_moved_m)


def errors_m(run: TagRun, received: Iterable[Received]) -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
    """Horizontal errors of fixes, shape (n, 2): when each was given, and its error."""
    truth = {key_of(one.reception): one.position_m for one in received}
    rows = [(one.given_s, float(np.hypot(*(one.fix.position_m - truth[one.key])[:2]))) for one in run.given]
    return np.array(rows).reshape(-1, 2)
