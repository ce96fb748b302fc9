"""Which tags are near each other."""

import math
from collections import defaultdict
from collections.abc import Container, Mapping
from itertools import product
from typing import Final

from skyless.run.mqtt.messages import Vector

STOREY_M: Final = 2.5
"""Tags whose heights differ by more than this are on different storeys. Otherwise the horizontal distance counts:
heights are known less well than the rest, and one tag may be on a helmet and the other on a fork."""

_FARTHEST_M: Final = 1e6
_AROUND: Final = tuple(product((-1, 0, 1), repeat=2))


def near_tags(
    positions_m: Mapping[str, Vector], first: Container[str], others: Container[str], reach_m: float
) -> dict[tuple[str, str], float]:
    """Distances of the pairs within ``reach_m``, one tag of ``first`` and one of ``others``, in the names' order."""
    places = {
        name: (math.floor(x / reach_m), math.floor(y / reach_m))
        for name, (x, y, _) in positions_m.items()
        if abs(x) < _FARTHEST_M and abs(y) < _FARTHEST_M
    }
    cells: defaultdict[tuple[int, int], list[str]] = defaultdict(list)
    for name, place in places.items():
        if name in others:
            cells[place].append(name)
    near = {}
    for name, (i, j) in places.items():
        if name not in first:
            continue
        x, y, z = positions_m[name]
        for di, dj in _AROUND:
            for other in cells.get((i + di, j + dj), ()):
                other_x, other_y, other_z = positions_m[other]
                distance_m = math.hypot(x - other_x, y - other_y)
                if distance_m < reach_m and abs(z - other_z) <= STOREY_M and other != name:
                    near[(name, other) if name < other else (other, name)] = distance_m
    return near
