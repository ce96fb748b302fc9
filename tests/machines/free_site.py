"""What tests of a tag at a site of protocol 2 share: a site without a schedule, and what a tag receives."""

from functools import lru_cache

from msgspec.structs import replace

from bench import LAB, Heard
from skyless.core.air.beacon import Beacon
from skyless.core.air.codec import decode, encode
from skyless.core.protocols import new_anchor
from skyless.sim.evaluation.scenarios import Request, impairments_of
from skyless.sim.stations import TagSpec
from skyless.sim.trajectory import Static
from skyless.sim.world import World

FREE = replace(LAB, schedule=replace(LAB.schedule, mode="free", rate_hz=60.0))
"""The lab's seven anchors, each at random instants."""


@lru_cache(maxsize=32)
def free_tape(site=FREE, seconds=2.0, seed=1, position=(3.0, 4.0, 0.0)) -> tuple[Heard, ...]:
    """All that one tag receives of a site that is switched on."""
    world = World(
        site,
        lambda anchor: new_anchor(site, anchor),
        [TagSpec(Static(*position))],
        impairments_of(Request(site), site),
        seed,
    )
    return tuple(
        Heard(broadcast.anchor, reception.frame, reception.rx_ticks, reception.host_s, truth_m)
        for broadcast in world.run(seconds)
        for _, reception, truth_m in broadcast.receptions()
    )


def beacon_of(heard: Heard) -> Beacon:
    beacon = decode(heard.frame)
    assert isinstance(beacon, Beacon)
    return beacon


def with_beacon(received: Heard, /, **fields) -> Heard:
    """The same reception of a beacon with other contents."""
    frame = encode(replace(beacon_of(received), **fields))
    return Heard(received.anchor, frame, received.rx_ticks, received.host_s, received.truth_m)
