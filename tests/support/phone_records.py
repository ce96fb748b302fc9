"""Records of a phone among FiRa anchors as iOS gives them, from situations that people reported; all simulated."""

import json
from collections.abc import Mapping
from math import cos, dist, sin
from pathlib import Path

import numpy as np
from msgspec import Struct, field

from skyless.core.air.masterless_packets import Point
from skyless.core.ticks import SPEED_OF_LIGHT_MPS, TICK_MASK, TICK_RATE_HZ

SLOT_S = 2e-3
FOUR: Mapping[int, Point] = {
    0xC974: (9.0, 10.0, 2.65),
    0x0364: (21.7, 17.9, 2.76),
    0x9DD7: (9.0, 17.7, 2.71),
    0xD3F8: (21.7, 10.0, 2.68),
}
SIX: Mapping[int, Point] = {**FOUR, 0x1A2B: (15.3, 10.0, 2.2), 0x7E01: (15.3, 17.8, 3.1)}
"""Halls of four and of six anchors; the first initiates the rounds."""
HEIGHT_M = 1.2


class Phone(Struct, frozen=True):
    """A phone that walks an ellipse, or is at rest, and what is wrong with its anchors."""

    anchors_m: Mapping[int, Point] = field(default_factory=lambda: FOUR)
    rounds_per_s: float = 20.0
    seconds: float = 60.0
    seed: int = 1
    noise_m: float = 0.03
    constants_m: Mapping[int, float] = {}
    """By how much each anchor seems late."""
    own_clocks: Mapping[int, tuple[float, float]] = {}
    """Anchors without the common time base: how far their stamps are off [m], and how fast their clock is [ppm]."""
    flip_share: float = 0.0
    flip_m: float = 1.2
    """Share of each anchor's stamps that are late, and by how much."""
    place_m: Point | None = None
    """Where the phone is at rest."""

    def position_m(self, time_s: float) -> Point:
        """The true position."""
        walked = 15.0 + 4.0 * cos(0.25 * time_s), 14.0 + 3.0 * sin(0.25 * time_s), HEIGHT_M
        return walked if self.place_m is None else self.place_m

    def records(self) -> list[str]:
        """Lines of JSON, in order; fixes of a replay count their time from the first one on."""
        draw = np.random.default_rng([68, self.seed])
        phone_ppm, begin_s = draw.uniform(-15.0, 15.0), 3.0
        lines, (initiator, *_) = [], self.anchors_m
        for index in range(int(self.seconds * self.rounds_per_s)):
            for slot, (address, anchor_m) in enumerate(self.anchors_m.items()):
                sent_s = begin_s + index / self.rounds_per_s + slot * SLOT_S
                path_m = dist(anchor_m, self.position_m(sent_s)) + self.constants_m.get(address, 0.0)
                path_m += self.flip_m * (draw.random() < self.flip_share) + draw.normal(0.0, self.noise_m)
                received_s = (sent_s + path_m / SPEED_OF_LIGHT_MPS) * (1.0 + phone_ppm * 1e-6) + 1.7
                off_m, ppm = self.own_clocks.get(address, (0.0, 0.0))
                sent_s += off_m / SPEED_OF_LIGHT_MPS + (sent_s - begin_s) * ppm * 1e-6
                record = {
                    "address": f"{address:04X}",
                    "measurementType": "response" if slot else "poll",
                    "rawTransmitTime": round(sent_s * TICK_RATE_HZ) & TICK_MASK,
                    "rawReceiveTime": round(received_s * TICK_RATE_HZ) & TICK_MASK,
                    "coordinates": anchor_m,
                    "coordinatesType": "relative",
                    "clusterInitiatorAddress": f"{initiator:04X}",
                }
                lines.append(json.dumps(record))
        return lines

    def write(self, path: Path) -> Path:
        """Write the records to a file."""
        path.write_text("\n".join(self.records()) + "\n")
        return path

    def errors_m(self, time_s: np.ndarray, position_m: np.ndarray) -> np.ndarray:
        """Horizontal errors of fixes, whose times count from the first record."""
        truth_m = np.array([self.position_m(3.0 + when_s) for when_s in time_s]).reshape(-1, 3)
        return np.hypot(*(position_m - truth_m)[:, :2].T)
