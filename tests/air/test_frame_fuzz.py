"""Random and mutated frames through the decoder; SKYLESS_FUZZ_FRAMES sets how many (20 000 by default)."""

import collections
import os
import random

import msgspec
from protocol1_strategies import FULL

from skyless.core.air.almanac import AccuracyPage, GeoreferencePage, NoisePage, SchedulePage
from skyless.core.air.frame import Malformed
from skyless.core.air.ieee802154 import fcs
from skyless.core.protocol1.beacon import Beacon
from skyless.core.protocol1.codec import decode, encode, heard_capacity

FRAMES = int(os.environ.get("SKYLESS_FUZZ_FRAMES", "20000"))
PAGES = (
    FULL.page,
    SchedulePage(2**27, 7, 1, 1, 7, 1.25),
    NoisePage(1e-10, 1e-10, 2e-11, 1e-9),
    AccuracyPage(0.02, 0.03, 0.05, 0.03, 1.0, 100.0),
    GeoreferencePage(52.0, 4.0, 3.0, 90.0),
    None,
)
SEEDS = [encode(msgspec.structs.replace(FULL, page=page)) for page in PAGES]
SEEDS += [encode(msgspec.structs.replace(FULL, heard=(), master_heard=None, master_time=None, page=None))]


def random_frame(rng):
    return rng.randbytes(rng.randrange(0, 160))


def mutated_frame(rng):
    """A beacon with a few bytes changed, cut out, put in or cut off; two times in three its FCS is made good."""
    body = bytearray(rng.choice(SEEDS)[:-2])
    for _ in range(rng.randrange(1, 4)):
        at = rng.randrange(len(body) + 1)
        match rng.randrange(6):
            case 0:
                del body[at : at + rng.randrange(1, 9)]
            case 1:
                body[at:at] = rng.randbytes(rng.randrange(1, 9))
            case 2:
                del body[at:]
            case _:
                body[at : at + 1] = rng.randbytes(1)
    end = rng.randbytes(2) if rng.randrange(3) == 0 else fcs(bytes(body))
    return bytes(body) + end


def check(frame):
    decoded = decode(frame)
    if isinstance(decoded, Malformed):
        return decoded
    assert isinstance(decoded, Beacon)
    parts = (decoded.master_heard is not None, decoded.master_time is not None, decoded.page is not None)
    if len(decoded.heard) <= heard_capacity(*parts):
        assert decode(encode(decoded)) == decoded
    return "beacon"


def test_nothing_from_the_air_raises():
    rng = random.Random(20211112)
    seen = collections.Counter()
    for number in range(FRAMES):
        seen[check(random_frame(rng) if number % 4 == 0 else mutated_frame(rng))] += 1
    assert seen.total() == FRAMES
    # The mutations reach every branch of the decoder.
    assert set(seen) == {*Malformed, "beacon"} - {Malformed.BAD_PERIOD} or FRAMES < 20_000
