"""What the world tells of each transmission, and what it counted."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from msgspec import Struct

from skyless.air.reception import Diagnostics, Reception
from skyless.constants import TICK_S
from skyless.kernels.arrays import Array, Integers
from skyless.simulation.ether import OUTCOMES


def diagnostics_of(row: np.void) -> Diagnostics:
    """Diagnostics of one row of what the nodes received."""
    return Diagnostics(float(row["rx_power_dbm"]), float(row["first_path_power_dbm"]), float(row["carrier_offset_ppm"]))


@dataclass(slots=True, eq=False)
class Broadcast:
    """One frame, at the moment that its end arrived, with the tags that heard it and the truth about it."""

    anchor: int
    """Identifier of the sender."""
    frame: bytes
    emission_ticks: int
    """True time at which the RMARKER left the antenna, in ideal ticks since the start; and its fraction."""
    emission_fraction: float
    end_s: float
    """True time of the frame's end, which the receptions carry as the host's time."""
    tags: Integers
    """Indices of the tags that heard it, shape (n,)."""
    rx_ticks: Integers
    """Their RX stamps, 40 bits, shape (n,)."""
    positions_m: Array
    """Where they truly were at the emission, shape (n, 3)."""
    velocities_mps: Array
    """How they truly moved, shape (n, 3)."""
    diagnostics: tuple[Diagnostics, ...] | None
    """What their radios measured, where the world is asked for it."""

    @property
    def emission_s(self) -> float:
        """True time of the RMARKER's emission in seconds since the start."""
        return (self.emission_ticks + self.emission_fraction) * TICK_S

    def receptions(self) -> Iterator[tuple[int, Reception, Array]]:
        """Tag index, reception and true position, shape (3,), of every tag that heard the frame."""
        frame, host_s = self.frame, self.end_s
        measured = self.diagnostics or (None,) * len(self.tags)
        rows = zip(self.tags.tolist(), self.rx_ticks.tolist(), self.positions_m, measured, strict=True)
        for tag, rx_ticks, position_m, diagnostics in rows:
            yield tag, Reception(frame, rx_ticks, host_s, diagnostics), position_m


class Tally(Struct, frozen=True):
    """What a world has counted so far."""

    transmissions: int
    late_transmissions: int
    """Frames that came too late for their time and were not sent."""
    at_anchors: dict[str, int]
    """Outcomes (``Outcome``) of frames at anchors that were on."""
    at_tags: dict[str, int]


def make_tally(transmissions: int, late: int, counts: Integers) -> Tally:
    """Tally from the kernels' counts, shape (2, outcomes)."""
    at_anchors, at_tags = (dict(zip((str(o) for o in OUTCOMES), row.tolist(), strict=True)) for row in counts)
    return Tally(transmissions, late, at_anchors, at_tags)
