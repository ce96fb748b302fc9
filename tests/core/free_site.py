"""What tests of a tag at a site of protocol 2 share: a site without a schedule, and what a tag receives."""

from msgspec.structs import replace

from skyless.core.air.beacon import Beacon, decode, encode
from support.bench import LAB, Heard, tape

FREE = replace(LAB, schedule=replace(LAB.schedule, mode="free", rate_hz=60.0))
"""The lab's seven anchors, each at random instants."""


def free_tape(site=FREE, **how) -> tuple[Heard, ...]:
    """All that one tag receives of a site that is switched on, as ``tape``."""
    return tape(site, **how)


def beacon_of(heard: Heard) -> Beacon:
    beacon = decode(heard.frame)
    assert isinstance(beacon, Beacon)
    return beacon


def with_beacon(received: Heard, /, **fields) -> Heard:
    """The same reception of a beacon with other contents."""
    frame = encode(replace(beacon_of(received), **fields))
    return replace(received, frame=frame)
