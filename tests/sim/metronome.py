"""A stand-in for an anchor: it beats on its own clock, and remembers what it hears."""

import struct
from dataclasses import dataclass, field

import msgspec
import numpy as np

from skyless.core.air.frame import Reception, Transmission
from skyless.core.site import AnchorSite, Site
from skyless.core.ticks import TICK_M, TICK_MASK, difference, from_seconds
from skyless.sim.impairments import Impairments
from skyless.sim.lab import paper_lab_site
from skyless.sim.listening import TagSpec
from skyless.sim.oscillator import OscillatorModel
from skyless.sim.trajectory import Static
from skyless.sim.world import World

DELAY_TICKS = 16_436
QUIET_CRYSTALS = OscillatorModel(offset_ppm=0.0, white_fm=0.0, random_walk_fm=0.0)
IDEAL = Impairments(tx_stamp_ps=0.0, rx_stamp_ps=0.0, oscillator=QUIET_CRYSTALS)
LAB = paper_lab_site()
AT_REST = TagSpec(Static(3.0, 4.0))


def faulty(**changes) -> Impairments:
    """Ideal but for what is given."""
    return msgspec.structs.replace(IDEAL, **changes)


@dataclass
class Metronome:
    """Sends every period from the moment it is switched on; its frame carries its number and its TX stamp."""

    id: int
    period_s: float = 15e-3
    first_s: float = 5e-3
    frame_bytes: int = 40
    off_grid_ticks: int = 0
    silent_asks: int = 0
    heard: list[Reception] = field(default_factory=list)
    last_ticks: int | None = None

    def hear(self, reception: Reception) -> None:
        self.heard.append(reception)

    def next_transmission_ticks(self, now_ticks: int) -> int | None:
        if self.silent_asks > 0:
            self.silent_asks -= 1
            return None
        if self.last_ticks is None:
            wanted = now_ticks + from_seconds(self.first_s)
        else:
            wanted = self.last_ticks + from_seconds(self.period_s)
        on_grid = (wanted - DELAY_TICKS) // 512 * 512 + DELAY_TICKS
        self.last_ticks = on_grid
        return (on_grid + self.off_grid_ticks) & TICK_MASK

    def transmission(self, tx_ticks: int) -> Transmission:
        return Transmission(struct.pack("<HQ", self.id, tx_ticks).ljust(self.frame_bytes, b"\0"), tx_ticks)


def sent(frame: bytes) -> tuple[int, int]:
    """Anchor and claimed TX stamp of a metronome's frame."""
    anchor, tx_ticks = struct.unpack_from("<HQ", frame)
    return anchor, tx_ticks


def site_of(*places_m: tuple[float, float], walls=()) -> Site:
    anchors = tuple(AnchorSite(id=k, x_m=x, y_m=y) for k, (x, y) in enumerate(places_m, start=1))
    return Site(name="test", id=1, master=1, anchors=anchors, walls=tuple(walls))


def staggered(**options):
    """A factory of metronomes that start 2 ms after one another and never collide."""
    return lambda anchor: Metronome(anchor, first_s=5e-3 + 2e-3 * anchor, **options)


def lateness(changed, until_s, *, tag=AT_REST, sites=(LAB, LAB)):
    """Per anchor rows of (emission in s, how much later the tag stamps the frame than in the plain world).

    Both worlds have the same seed, and so the same noise; what differs is the change alone, and the rounding.
    """
    worlds = [
        World(site, staggered(), [tag], impairments, 7)
        for site, impairments in zip(sites, (IDEAL, changed), strict=True)
    ]
    rows = {}
    for plain, late in zip(*(world.run(until_s) for world in worlds), strict=True):
        ticks = difference(int(late.rx_ticks[0]), int(plain.rx_ticks[0]))
        rows.setdefault(plain.anchor, []).append((plain.emission_s, ticks * TICK_M))
    return {anchor: np.array(own) for anchor, own in rows.items()}
