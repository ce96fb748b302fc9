"""What is wrong with one anchor in the study ``integrity``: late or early messages of every size, and wrong delays."""

from typing import Any, Final, Literal

import numpy as np
from msgspec import Struct
from msgspec.structs import replace
from numpy.typing import NDArray

from skyless.constants import TICK_M
from skyless.kernels.arrays import Array
from skyless.positioning.estimator.estimator import Packets
from skyless.studies.episodes import Episode

Kind = Literal["step", "ramp", "early", "bursts", "delay"]

SIZES_M: Final = (0.05, 0.1, 0.2, 0.3, 0.5, 1.0, 2.0, 5.0, 10.0)
FEW_SIZES_M: Final = (0.1, 0.3, 1.5)

RAMP_S: Final = 1.0
BURST_S: Final = 0.25

_WORDS: Final[dict[Kind, str]] = {
    "step": "step",
    "ramp": "ramp to",
    "early": "early by",
    "bursts": "bursts of",
    "delay": "TX delay",
}


class Fault(Struct, frozen=True):
    """What is wrong in all episodes of a case."""

    place: str
    """``lab``, with the height given, or ``room``, where it is a state."""
    size_m: float = 0.0
    kind: Kind = "step"
    """From the onset on the tag's receptions are late (step), more and more for a second (ramp), early, or late every
    other quarter of a second (bursts); or all who hear the anchor do so late, as its antenna delay is wrong (delay)."""

    @property
    def name(self) -> str:
        """What rows call it."""
        return f"{self.place}, clean" if self.size_m == 0.0 else f"{self.place}, {_WORDS[self.kind]} {self.size_m:g} m"

    @property
    def series(self) -> str:
        """Faults that differ by nothing but their size."""
        return f"{self.place}, {_WORDS[self.kind].split()[0] if self.kind != 'delay' else 'TX delay'}"


FAULTS: Final = tuple(
    fault
    for place in ("lab", "room")
    for fault in (
        Fault(place),
        *(Fault(place, size_m, kind) for kind in ("step", "ramp") for size_m in SIZES_M),
        *(Fault(place, size_m, kind) for kind in ("early", "bursts", "delay") for size_m in FEW_SIZES_M),
    )
)


def faulty(episode: Episode, fault: Fault, anchor: int, onset: int, slot_s: float) -> Packets:
    """The episode's packets with the anchor's fault, from the packet ``onset`` on."""
    packets = episode.packets
    size = fault.size_m / TICK_M
    share = _share((np.arange(len(packets.anchors)) - onset) * slot_s, fault.kind)
    late = np.where(packets.anchors == anchor, np.rint(size * share), 0.0).astype(np.int64)
    relays = packets.relays
    if fault.kind == "delay":
        begun = packets.sequences[onset]  # an episode is shorter than sequence numbers take to come around
        heard_late = (relays[:, 1] == anchor) & (relays[:, 2] >= begun)
        relays = relays.copy()
        relays[heard_late, 3] += round(size)
    return replace(packets, rx_ticks=packets.rx_ticks + late, relays=relays)


def _share(since_s: NDArray[np.floating[Any]], kind: Kind) -> Array:
    """How much of the fault there is, from −1 to 1."""
    if kind == "ramp":
        return np.asarray(np.clip(since_s / RAMP_S, 0.0, 1.0), np.float64)
    on = since_s >= 0.0
    if kind == "bursts":
        on &= since_s % (2.0 * BURST_S) < BURST_S
    return np.where(on, -1.0 if kind == "early" else 1.0, 0.0)
