"""Forged beacons: what an attacker sends who receives everything and knows all but the keys not disclosed yet.

Each forgery makes one frame, from what was overheard. Frames whose authentication cannot be right carry the code of a
genuine one, or a random one.
"""

from collections import deque
from collections.abc import Callable
from itertools import islice
from random import Random
from typing import Final

import numpy as np
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from msgspec import Struct
from msgspec.structs import replace

from skyless.core.air.almanac import AccuracyPage, KeyPage, NoisePage, SitePage
from skyless.core.air.beacon import (
    INTERVAL_BITS,
    MAC_BYTES,
    Authentication,
    Beacon,
    StatedPosition,
    decode,
    encode,
    with_authentication,
)
from skyless.core.air.frame import HEARD, Heard, PackedHeard, fcs
from skyless.core.arrays import Array
from skyless.core.keys import chain
from skyless.core.ticks import SPEED_OF_LIGHT_MPS, TICK_RATE_HZ, difference, nearest, wrap

DRAG_MPS: Final = 0.5
"""Speed at which false measurements draw a tag away."""

_RECENT: Final = 4096
_LATELY: Final = 32
_RATE_S: Final = 0.3
"""Over this time or more the rate of an anchor's counter is measured."""
_LATER_S: Final = 0.45
"""Older frames are of intervals whose keys are disclosed."""
_INTERVAL_SHIFTS: Final = (-30000, -1000, -10, -4, -3, -2, -1, 1, 2, 3, 4, 10, 1000, 30000)


class Overheard(Struct, frozen=True, gc=False):
    """A genuine frame."""

    frame: bytes
    beacon: Beacon
    emitted_s: float
    """True time of its RMARKER."""


class Adversary:
    """What an attacker knows. It learns only what is on the air, and the position of the tag that it attacks."""

    def __init__(self, begins_unix_s: float, seed: int, own_m: Array) -> None:
        """``begins_unix_s``: Unix time at true time 0; ``own_m``: position of its antenna."""
        self.random = Random(seed)
        self.now_s = 0.0
        """True time at which the next frame leaves."""
        self.tag_m: Array = own_m
        self.own_m = own_m
        self.newest: dict[int, Overheard] = {}
        self.recent: deque[Overheard] = deque(maxlen=_RECENT)
        self.keys: dict[int, bytes] = {}
        """Disclosed keys by their intervals."""
        self.certificates: list[tuple[bytes, chain.Certificate]] = []
        self.private: Ed25519PrivateKey | None = None
        """Its own key, to sign certificates with."""
        self._begins_unix_s = begins_unix_s
        self._earlier: dict[int, Overheard] = {}
        self._rates: dict[int, float] = {}
        self._drag_from_s: float | None = None

    def overhear(self, frame: bytes, emitted_s: float) -> None:
        """Learn a genuine frame, and what it discloses."""
        beacon = decode(frame)
        if not isinstance(beacon, Beacon):
            return
        one = Overheard(frame, beacon, emitted_s)
        earlier = self._earlier.setdefault(beacon.anchor, one)
        elapsed_s = emitted_s - earlier.emitted_s
        if elapsed_s >= _RATE_S:
            self._rates[beacon.anchor] = difference(beacon.tx_ticks, earlier.beacon.tx_ticks) / elapsed_s
            self._earlier[beacon.anchor] = one
        self.newest[beacon.anchor] = one
        self.recent.append(one)
        if beacon.certificate is not None and all(beacon.certificate != sent for sent, _ in self.certificates):
            read = chain.read_certificate(beacon.site, beacon.certificate)
            if read is not None:
                self.certificates.append((beacon.certificate, read[0]))
        if isinstance(beacon.page, KeyPage) and beacon.authentication is not None:
            interval = nearest(beacon.authentication.interval, self.interval_at(emitted_s), INTERVAL_BITS)
            self.keys[interval - self.timing.lag] = beacon.page.key

    @property
    def timing(self) -> chain.ChainTiming:
        """That of the site's chain."""
        return self.certificates[-1][1].timing if self.certificates else chain.USUAL_TIMING

    def interval_at(self, true_s: float) -> int:
        """Number of the interval at a true time."""
        return self.timing.interval_at(self._begins_unix_s + true_s)

    def any_newest(self) -> Overheard:
        """The last frame of one of the anchors."""
        return self.random.choice(list(self.newest.values()))

    def any_measurement(self) -> Overheard:
        """One of the last frames that state a position."""
        lately = [one for one in islice(reversed(self.recent), _LATELY) if one.beacon.position is not None]
        return self.random.choice(lately) if lately else self.any_newest()

    def counter_at(self, anchor: int, true_s: float) -> int:
        """What an anchor's counter (40 bits) shows at a true time."""
        one = self.newest[anchor]
        rate = self._rates.get(anchor, TICK_RATE_HZ)
        return wrap(one.beacon.tx_ticks + round((true_s - one.emitted_s) * rate))

    def false_stamp(self, anchor: int, position: StatedPosition | None) -> int:
        """The TX stamp with which a frame sent now moves the tag's position farther and farther along x."""
        if self._drag_from_s is None:
            self._drag_from_s = self.now_s
        stated_m = self.own_m if position is None else np.array([position.x_m, position.y_m, position.z_m])
        wrong_m = self.tag_m + np.array([DRAG_MPS * (self.now_s - self._drag_from_s), 0.0, 0.0])
        later_m = float(np.linalg.norm(self.tag_m - self.own_m) - np.linalg.norm(wrong_m - stated_m))
        return self.counter_at(anchor, self.now_s + later_m / SPEED_OF_LIGHT_MPS)

    def code(self) -> Authentication:
        """An authentication of the present interval that is right for no frame but, maybe, the one it is of."""
        interval = self.interval_at(self.now_s) & (1 << INTERVAL_BITS) - 1
        genuine = self.any_newest().beacon.authentication
        if genuine is not None and self.random.random() < 0.5:
            return replace(genuine, interval=interval)
        return Authentication(interval, self.random.randbytes(MAC_BYTES))


Forgery = Callable[[Adversary], bytes]
"""Makes a frame that leaves at ``now_s``; some genuine frame must have been overheard."""


def _measurement(adversary: Adversary) -> Beacon:
    """A beacon that continues an anchor's counter and moves the position, without a right code."""
    beacon = adversary.any_measurement().beacon
    heard = tuple(
        Heard(anchor, sequence, wrap(low + (high << 32) + adversary.random.randrange(-30, 31)))
        for anchor, sequence, low, high in HEARD.iter_unpack(_packed(beacon))
    )
    return replace(
        beacon,
        sequence=adversary.newest[beacon.anchor].beacon.sequence + 1 & 0xFF,
        tx_ticks=adversary.false_stamp(beacon.anchor, beacon.position),
        heard=heard,
        authentication=adversary.code(),
    )


def _with_space(beacon: Beacon) -> Beacon:
    """The beacon with so few relays that every other part fits."""
    return replace(beacon, heard=tuple(islice(beacon.heard, 5)), weak=0)


def _packed(beacon: Beacon) -> bytes:
    return beacon.heard.packed if isinstance(beacon.heard, PackedHeard) else b""


def false_measurement(adversary: Adversary) -> bytes:
    """A stamp that draws the tag away, and false relays."""
    return encode(_measurement(adversary))


def false_page(adversary: Adversary) -> bytes:
    """Another page of another issue, and another position."""
    draw, beacon = adversary.random, _measurement(adversary)
    pages = (
        SitePage(3, draw.uniform(-50.0, 50.0)),
        NoisePage(1e-7, 1e-7, 1e-7, 1e-7),
        AccuracyPage(1.0, 1.0, 0.1, 1.0, 1.0, 1.0),
    )
    position = StatedPosition(draw.uniform(-100.0, 100.0), draw.uniform(-100.0, 100.0), 0.0)
    page, issue = draw.choice(pages), draw.randrange(8)
    return encode(replace(_with_space(beacon), page=page, almanac_issue=issue, position=position))


def restarted_counter(adversary: Adversary) -> bytes:
    """A stamp of a counter that has begun again."""
    beacon = _measurement(adversary)
    return encode(replace(beacon, tx_ticks=wrap(round(adversary.now_s * TICK_RATE_HZ) + (beacon.anchor << 30))))


def flipped_bits(adversary: Adversary) -> bytes:
    """A genuine frame with one to three wrong bits, mostly with a right check sequence."""
    frame = bytearray(adversary.any_newest().frame)
    for bit in adversary.random.sample(range(8 * (len(frame) - 2)), adversary.random.randint(1, 3)):
        frame[bit // 8] ^= 1 << bit % 8
    return _checked(bytes(frame[:-2])) if adversary.random.random() < 0.8 else bytes(frame)


def truncated(adversary: Adversary) -> bytes:
    """The beginning of a genuine frame, or one with bytes after it."""
    body, draw = adversary.any_newest().frame[:-2], adversary.random
    if draw.random() < 0.5 or len(body) >= 125:
        return _checked(body[: draw.randrange(len(body))])
    return _checked(body + draw.randbytes(draw.randint(1, 125 - len(body))))


def repeated_at_once(adversary: Adversary) -> bytes:
    """The last frame of an anchor again."""
    return adversary.any_newest().frame


def repeated_soon(adversary: Adversary) -> bytes:
    """A frame whose interval may still hold, in no order."""
    from_s = adversary.now_s - adversary.timing.interval_s
    return _drawn(adversary, [one for one in adversary.recent if one.emitted_s > from_s])


def repeated_later(adversary: Adversary) -> bytes:
    """A frame whose key is disclosed; sometimes the same one after many seconds."""
    until_s = adversary.now_s - _LATER_S
    return _drawn(adversary, [one for one in adversary.recent if one.emitted_s < until_s])


def _drawn(adversary: Adversary, among: list[Overheard]) -> bytes:
    return adversary.random.choice(among).frame if among else adversary.any_newest().frame


def false_key(adversary: Adversary) -> bytes:
    """A key page with a random key, or a genuine key of another interval."""
    draw, beacon = adversary.random, _measurement(adversary)
    keys = list(adversary.keys.values())
    key = draw.choice(keys[-8:]) if keys and draw.random() < 0.5 else draw.randbytes(chain.KEY_BYTES)
    return _shifted(adversary, replace(_with_space(beacon), page=KeyPage(key)))


def false_interval(adversary: Adversary) -> bytes:
    """The number of another interval."""
    return _shifted(adversary, _measurement(adversary))


def _shifted(adversary: Adversary, beacon: Beacon) -> bytes:
    shift = adversary.random.choice(_INTERVAL_SHIFTS)
    stated = adversary.code()
    interval = (stated.interval + shift) & (1 << INTERVAL_BITS) - 1
    return encode(replace(beacon, authentication=replace(stated, interval=interval)))


def false_certificate(adversary: Adversary) -> bytes:
    """A certificate that the site has not signed, or one of its own in a false frame."""
    draw = adversary.random
    if adversary.private is None:
        adversary.private = Ed25519PrivateKey.from_private_bytes(draw.randbytes(32))
    beacon = _measurement(adversary)
    sent = draw.choice(adversary.certificates)[0] if adversary.certificates else None
    kind = draw.randrange(4)
    if sent is None or kind == 0:
        section = adversary.interval_at(adversary.now_s) >> chain.SECTION_BITS
        name = chain.SectionName(beacon.site, draw.randrange(1, 1 << 16), section)
        made = chain.Certificate(name, adversary.timing, name.first_interval, draw.randbytes(chain.KEY_BYTES))
        sent = made.sent_bytes(chain.sign(made, adversary.private))
    elif kind == 1:
        altered = bytearray(sent)
        altered[draw.randrange(len(sent))] ^= 1 << draw.randrange(8)
        sent = bytes(altered)
    elif kind == 2:
        sent = draw.randbytes(len(sent))
    alone = replace(beacon, position=None, page=None, heard=(), weak=0)
    return encode(replace(alone, certificate=sent))


def disclosed_key(adversary: Adversary) -> bytes:
    """A false frame with the right code of the last interval whose key is disclosed."""
    beacon = replace(_measurement(adversary), authentication=None)
    if not adversary.keys or not adversary.certificates:
        return encode(beacon)
    interval = max(adversary.keys) - adversary.random.choice((0, 0, 0, 1, 2))
    key = adversary.keys.get(interval, adversary.keys[max(adversary.keys)])
    name = chain.SectionName(beacon.site, adversary.certificates[-1][1].name.serial, interval >> chain.SECTION_BITS)
    lowest_bits = interval & (1 << INTERVAL_BITS) - 1
    return with_authentication(
        encode(beacon), lowest_bits, lambda signed: chain.mac_of(signed, chain.mac_key(key, name))
    )


def other_name(adversary: Adversary) -> bytes:
    """A genuine frame in the name of another anchor."""
    beacon = adversary.any_newest().beacon
    others = [anchor for anchor in adversary.newest if anchor != beacon.anchor]
    name = adversary.random.choice(others or [beacon.anchor ^ 1])
    entries = [HEARD.unpack_from(_packed(beacon), at) for at in range(0, len(_packed(beacon)), HEARD.size)]
    heard = tuple(Heard(a, sequence, low | high << 32) for a, sequence, low, high in entries if a != name)
    return encode(replace(beacon, anchor=name, heard=heard, weak=0))


def no_code(adversary: Adversary) -> bytes:
    """A false measurement without authentication."""
    return encode(replace(_measurement(adversary), authentication=None))


def strange_names(adversary: Adversary) -> bytes:
    """A false measurement of an anchor that nobody knows."""
    beacon = _measurement(adversary)
    taken = {entry.anchor for entry in beacon.heard}
    name = adversary.random.randrange(1 << 16)
    return encode(beacon if name in taken else replace(beacon, anchor=name))


def any_forgery(adversary: Adversary) -> bytes:
    """One of all kinds."""
    return adversary.random.choice(tuple(FORGERIES.values()))(adversary)


FORGERIES: Final[dict[str, Forgery]] = {
    made.__name__.replace("_", "-"): made
    for made in (
        false_page,
        false_measurement,
        restarted_counter,
        flipped_bits,
        truncated,
        repeated_at_once,
        repeated_soon,
        repeated_later,
        false_key,
        false_interval,
        false_certificate,
        disclosed_key,
        other_name,
        no_code,
        strange_names,
    )
}
"""By their names."""


def _checked(body: bytes) -> bytes:
    return body + fcs(body)
