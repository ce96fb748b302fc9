"""Which tags are near each other, kept up as they move: the work is in proportion to the tags that have moved."""

import math
from collections.abc import Container
from typing import Final

from skyless.run.mqtt.messages import Vector

STOREY_M: Final = 2.5
"""Tags whose heights differ by more than this are on different storeys. Otherwise the horizontal distance counts:
heights are known less well than the rest, and one tag may be on a helmet and the other on a fork."""

_FARTHEST_M: Final = 1e6

Pair = tuple[str, str]


class NearTags:
    """Pairs of tags that are within a distance, one of them of the first list and the other of the second."""

    def __init__(self, limit_m: float, hysteresis_m: float, first: Container[str], second: Container[str]) -> None:
        """A pair that is near stays near until its distance reaches ``limit_m + hysteresis_m``."""
        self.distances_m: dict[Pair, float] = {}
        """The pairs that are near, each in the order of the names."""
        self._limit_m, self._reach_m = limit_m, limit_m + hysteresis_m
        self._first, self._second = first, second
        self._where: dict[str, tuple[tuple[int, int], Vector]] = {}
        self._cells: dict[tuple[int, int], set[str]] = {}
        self._partners: dict[str, set[str]] = {}

    def move(self, name: str, position_m: Vector) -> tuple[list[Pair], list[Pair]]:
        """The pairs that begin and end to be near with a tag's new position."""
        x, y, _ = position_m
        if name not in self._first and name not in self._second:
            return [], []
        if not (abs(x) < _FARTHEST_M and abs(y) < _FARTHEST_M):
            return [], self.remove(name)
        cell = math.floor(x / self._reach_m), math.floor(y / self._reach_m)
        before = self._where.get(name)
        self._where[name] = cell, position_m
        if before is None or before[0] != cell:
            if before is not None:
                self._leave(name, before[0])
            self._cells.setdefault(cell, set()).add(name)
        partners = self._partners.get(name, set())
        near = self._near(name, cell, position_m, partners)
        began = [_pair(name, other) for other in near if other not in partners]
        ended = [_pair(name, other) for other in partners if other not in near]
        for other, distance_m in near.items():
            self.distances_m[_pair(name, other)] = distance_m
            if other not in partners:
                self._partners.setdefault(name, set()).add(other)
                self._partners.setdefault(other, set()).add(name)
        self._separate(ended)
        return began, ended

    def remove(self, name: str) -> list[Pair]:
        """Forget a tag's position. The pairs that have ended with it."""
        before = self._where.pop(name, None)
        if before is None:
            return []
        self._leave(name, before[0])
        ended = [_pair(name, other) for other in self._partners.get(name, ())]
        self._separate(ended)
        return ended

    @property
    def names(self) -> list[str]:
        """The tags whose positions are known."""
        return list(self._where)

    def _near(self, name: str, cell: tuple[int, int], position_m: Vector, partners: set[str]) -> dict[str, float]:
        x, y, z = position_m
        is_first, is_second = name in self._first, name in self._second
        near = {}
        for i in range(cell[0] - 1, cell[0] + 2):
            for j in range(cell[1] - 1, cell[1] + 2):
                for other in self._cells.get((i, j), ()):
                    ox, oy, oz = self._where[other][1]
                    distance_m = math.hypot(x - ox, y - oy)
                    if (
                        distance_m < (self._reach_m if other in partners else self._limit_m)
                        and abs(z - oz) <= STOREY_M
                        and other != name
                        and ((is_first and other in self._second) or (is_second and other in self._first))
                    ):
                        near[other] = distance_m
        return near

    def _leave(self, name: str, cell: tuple[int, int]) -> None:
        self._cells[cell].discard(name)
        if not self._cells[cell]:
            del self._cells[cell]

    def _separate(self, pairs: list[Pair]) -> None:
        for one, other in pairs:
            del self.distances_m[one, other]
            for a, b in ((one, other), (other, one)):
                self._partners[a].discard(b)
                if not self._partners[a]:
                    del self._partners[a]


def _pair(a: str, b: str) -> Pair:
    return (a, b) if a < b else (b, a)
