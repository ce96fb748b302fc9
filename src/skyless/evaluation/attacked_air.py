"""A simulated site whose air an attacker uses, too: what one tag receives, and what becomes of the anchors.

The attacker has some radios of its own among the anchors. Their frames overlap with genuine ones and reach tags and
anchors like any other; as noise they have the same times and lengths and mean nothing: the baseline of an attack.
"""

from collections.abc import Callable, Iterable, Iterator
from random import Random
from typing import Final

import numpy as np
from msgspec import Struct
from msgspec.structs import replace

from skyless.air.reception import Reception, Transmission
from skyless.constants import TICK_RATE_HZ, TICK_S
from skyless.evaluation.adversary import Adversary, Forgery
from skyless.evaluation.scenarios import Request, impairments_of, trajectories_of
from skyless.evaluation.trusted_air import START_UNIX_S, ClockedAnchor, MadeKeys, anchors_with_keys
from skyless.kernels.arrays import Array
from skyless.simulation.stations import TagSpec
from skyless.simulation.world import World
from skyless.site.model import AnchorSite
from skyless.ticks import Unwrapper, difference, from_seconds, wrap

_FIRST_ID: Final = 0xF000
"""Identifiers of the attacker's radios, which are never sent."""
_RADIO_HZ: Final = 700.0
"""Frames that one radio can send: each is fetched a millisecond before."""
_LEAD_TICKS: Final = from_seconds(1.1e-3)
_NOISE_BYTES: Final = 40


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
