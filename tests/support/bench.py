"""What tests of the protocol machines share: sites, a world with its anchors, and what a tag hears, to tamper with."""

from functools import lru_cache

import numpy as np
from msgspec import Struct
from msgspec.structs import replace

from skyless.core.air.frame import Reception
from skyless.core.any_anchor import new_anchor
from skyless.core.protocol1.beacon import Beacon, decode, encode
from skyless.core.site import EXACT, Site
from skyless.sim.evaluation.scenarios import Request, impairments_of
from skyless.sim.lab import paper_lab_site
from skyless.sim.listening import TagSpec
from skyless.sim.trajectory import Static
from skyless.sim.world import World
from skyless.site.file.template import rectangular_site

LAB = paper_lab_site()
ROOM = replace(rectangular_site(8.0, 6.0, 8, 3.0, None), accuracy=EXACT, schedule=LAB.schedule)
"""Eight anchors at alternating heights: the height is to be estimated."""
LOFT = replace(ROOM, anchors=tuple(replace(anchor, z_m=5.0) for anchor in ROOM.anchors))
"""All anchors in one plane, so that every position has a mirror image above it."""
PAIRS = replace(LAB, schedule=replace(LAB.schedule, frames_per_node=2))
"""The paper's pair in every superframe."""
SNAPSHOTS = ("literal", "literal-delayed", "weighted", "bracketed")
EVERY_METHOD = (*SNAPSHOTS, "joint")


class Stage:
    """A world whose anchors' machines can be looked at; ``site_of_anchor`` gives some of them another site file.

    ``make`` makes the machines.
    """

    def __init__(self, site: Site, seed=1, tags=(), site_of_anchor=None, make=new_anchor, **faults):
        self.site, self.machines, self.made = site, {}, []
        sites = site_of_anchor or {}

        def factory(anchor):
            self.machines[anchor] = make(sites.get(anchor, site), anchor)
            self.made.append(self.machines[anchor])
            return self.machines[anchor]

        impairments = replace(impairments_of(Request(site), site), **faults)
        self.world = World(site, factory, [TagSpec(Static(*tag)) for tag in tags], impairments, seed)


class Heard(Struct, frozen=True):
    """One frame at the tag."""

    anchor: int
    frame: bytes
    rx_ticks: int
    host_s: float
    truth_m: np.ndarray

    @property
    def reception(self):
        return Reception(self.frame, self.rx_ticks, self.host_s)


@lru_cache(maxsize=32)
def tape(site=LAB, seconds=2.0, seed=1, position=(3.0, 4.0, 0.0), **faults) -> tuple[Heard, ...]:
    """All that one tag hears of a site that is switched on; ``faults`` as of a ``Stage``."""
    stage = Stage(site, seed, (position,), **faults)
    return tuple(
        Heard(broadcast.anchor, reception.frame, reception.rx_ticks, reception.host_s, truth_m)
        for broadcast in stage.world.run(seconds)
        for _, reception, truth_m in broadcast.receptions()
    )


def changed(frame: bytes, **fields) -> bytes:
    """The same beacon with other contents and a right FCS."""
    beacon = decode(frame)
    assert isinstance(beacon, Beacon)
    return encode(replace(beacon, **fields))


def listen(receiver, heard, check_from_s=-1.0, sigmas=6.0, bias_m=0.02):
    """Feed receptions; every fix, none of them wrong by more than ``sigmas`` of what it says of itself."""
    fixes = []
    for one in heard:
        fix = receiver.hear(one.reception)
        if fix is not None:
            if one.host_s >= check_from_s:
                assert_honest(fix, one.truth_m, sigmas, bias_m)
            fixes.append(fix)
    return fixes


def assert_honest(fix, truth_m, sigmas=6.0, bias_m=0.02):
    error = float(np.linalg.norm(fix.position_m - truth_m))
    assert error <= sigmas * fix.std_m + bias_m, f"{error:.3f} m off at std {fix.std_m:.3f} m, {fix.method}"
