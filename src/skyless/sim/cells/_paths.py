"""A tag's motion as the kernels need it: the pieces of its trajectory in a span, and how far it has travelled."""

import math
from itertools import pairwise

import numpy as np

from skyless.core.ticks import TICK_S
from skyless.sim.cells._clocks import KNOT_BITS, KNOT_TICKS
from skyless.sim.cells._receptions import PIECE, Path
from skyless.sim.trajectory import Piece, Trajectory


class TagPath:
    """The path of one tag; cheapest when asked in the order of time.

    Path lengths are summed along straight lines between the knots of the clocks, always from the start, so that they
    do not depend on the spans that are asked for.
    """

    def __init__(self, trajectory: Trajectory, *, length: bool) -> None:
        """``length``: whether to sum up path lengths instead of time."""
        self._trajectory, self._length = trajectory, length
        self._pieces: list[Piece] = []
        self._knot, self._travelled = 0, 0.0

    def cover(self, from_ticks: int, to_ticks: int) -> Path:
        """The path from one true time to another, 0 or later."""
        first, last = from_ticks >> KNOT_BITS, (to_ticks >> KNOT_BITS) + 1
        if self._length and first < self._knot:
            self._knot, self._travelled = 0, 0.0
        begin = min(self._knot, first) if self._length else first
        self._extend(_knot_s(begin), _knot_s(last))
        travelled = self._lengths(first, last) if self._length else [_knot_s(k) for k in range(first, last + 1)]
        pieces = np.zeros(len(self._pieces), dtype=PIECE)
        for row, piece in zip(pieces, self._pieces, strict=True):
            row["end_s"], row["origin_s"], row["position_m"] = piece.end_s, piece.origin_s, piece.position_m
            row["velocity_mps"], row["acceleration_mps2"] = piece.velocity_mps, piece.acceleration_mps2
        left = pieces["end_s"] > from_ticks * TICK_S
        return Path(pieces[left], first, np.array(travelled))

    def _extend(self, from_s: float, to_s: float) -> None:
        """Keep the pieces from one time to another."""
        if self._pieces and from_s < self._pieces[0].start_s:
            self._pieces = []
        self._pieces = [piece for piece in self._pieces if piece.end_s > from_s]
        if not self._pieces:
            self._pieces = [self._trajectory.piece(from_s)]
        while self._pieces[-1].end_s <= to_s:
            self._pieces.append(self._trajectory.piece(self._pieces[-1].end_s))

    def _lengths(self, first: int, last: int) -> list[float]:
        """Path lengths at knots; the sum at the first is kept."""
        positions = self._positions(self._knot, last)
        lengths = [self._travelled]
        for position, following in pairwise(positions):
            lengths.append(lengths[-1] + math.dist(position, following))
        lengths = lengths[first - self._knot :]
        self._knot, self._travelled = first, lengths[0]
        return lengths

    def _positions(self, first: int, last: int) -> list[tuple[float, float, float]]:
        index, positions = 0, []
        for knot in range(first, last + 1):
            t_s = _knot_s(knot)
            while self._pieces[index].end_s <= t_s:
                index += 1
            piece = self._pieces[index]
            dt_s = t_s - piece.origin_s
            at = piece.position_m + dt_s * (piece.velocity_mps + 0.5 * dt_s * piece.acceleration_mps2)
            positions.append((float(at[0]), float(at[1]), float(at[2])))
        return positions


def _knot_s(knot: int) -> float:
    return knot * KNOT_TICKS * TICK_S
