"""The study ``motion``: how the error grows with speed and turns; fixes are judged when they are made.

Paths for tags that move hard: turns, zigzags, stop and go, all at a given acceleration.
"""

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Final

import numpy as np
from numpy.random import Generator

from skyless.core.arrays import Array
from skyless.research.studies.common.plan import Plan
from skyless.research.studies.common.summary import Case
from skyless.research.studies.common.worlds import box, large_lab_site, worlds
from skyless.sim.trajectory import Piece, Static, Trajectory, Waypoints

_ACCELERATION_MPS2: Final = 3.0
_STILL: Final = "still"

_LEG_S: Final = (2.4, 2.8)
"""Time from corner to corner; at 3 m/s² a right angle at 5 m/s takes 2.36 s."""

_LAP_SHARE: Final = (0.86, 1.0)
"""Shares of the box that laps take.

In the lab, a right angle at 3 m/s takes 4.2 m of a leg with 3 m/s², and the shortest leg has 4.3 m.
"""


def cases(plan: Plan) -> list[Case]:
    """Still, rounds at three speeds, zigzags, stop and go, all in the large lab."""
    site = large_lab_site(plan.noise_ps)
    low_m, high_m = box(site)

    def paths(kind: Callable[..., Trajectory], seed: int) -> Sequence[Trajectory]:
        draw = np.random.default_rng(seed)
        return [kind(draw, low_m, high_m) for _ in range(plan.tags)]

    def moving(kind: Callable[..., Trajectory], speed_mps: float) -> Callable[..., Trajectory]:
        return partial(kind, speed_mps=speed_mps, acceleration_mps2=_ACCELERATION_MPS2)

    kinds = {
        _STILL: still,
        "rounds at 1 m/s": moving(rounds, 1.0),
        "rounds at 3 m/s": moving(rounds, 3.0),
        "rounds at 5 m/s": moving(rounds, 5.0),
        "zigzag at 3 m/s": moving(zigzag, 3.0),
        "stop and go, 3 m/s": moving(stop_and_go, 3.0),
        "stop and go, 5 m/s": moving(stop_and_go, 5.0),
    }
    return [
        Case(name, "motion", None, worlds(plan, site, partial(paths, kind)), _STILL) for name, kind in kinds.items()
    ]


class StopAndGo(Trajectory):
    """From point to point and round again: speeding up, driving, braking, resting."""

    def __init__(self, points_m: Array, speed_mps: float, acceleration_mps2: float, rest_s: float) -> None:
        """``points_m`` has shape (n, 3), n ≥ 2, neighbours apart; short legs do not reach the speed."""
        self._pieces: list[Piece] = []
        now_s = 0.0
        for start, end in zip(points_m, np.roll(points_m, -1, axis=0), strict=True):
            now_s = self._leg(start, end, now_s, speed_mps, acceleration_mps2, rest_s)
        self._lap_s = now_s

    def _leg(self, start: Array, end: Array, now_s: float, speed: float, acceleration: float, rest_s: float) -> float:
        length = float(np.linalg.norm(end - start))
        way = (end - start) / length
        top = min(speed, math.sqrt(acceleration * length))
        ramp_s, cruise_s = top / acceleration, length / top - top / acceleration
        still = np.zeros(3)
        for duration_s, at_mps, push in (
            (rest_s, 0.0, 0.0),
            (ramp_s, 0.0, acceleration),
            (cruise_s, top, 0.0),
            (ramp_s, top, -acceleration),
        ):
            until_s = now_s + duration_s
            if duration_s > 0.0:
                self._pieces.append(Piece(now_s, until_s, now_s, start, at_mps * way + still, push * way))
            start = start + way * (at_mps * duration_s + 0.5 * push * duration_s**2)
            now_s = until_s
        return now_s

    def piece(self, t_s: float) -> Piece:
        """See ``Trajectory``."""
        lap = math.floor(t_s / self._lap_s)
        within_s, passed_s = t_s - lap * self._lap_s, lap * self._lap_s
        found = next((one for one in self._pieces if within_s < one.end_s), self._pieces[-1])
        return found._replace(
            start_s=found.start_s + passed_s, end_s=found.end_s + passed_s, origin_s=found.origin_s + passed_s
        )


def still(draw: Generator, low_m: Array, high_m: Array) -> Trajectory:
    """Somewhere in the box."""
    return Static(*draw.uniform(low_m, high_m))


def rounds(draw: Generator, low_m: Array, high_m: Array, speed_mps: float, acceleration_mps2: float) -> Trajectory:
    """Round a rectangle somewhere in the box, every corner turned at the acceleration."""
    size = np.append(speed_mps * draw.uniform(*_LEG_S, 2), 0.0)
    corners = np.array([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)]) * size
    return _path(draw, low_m, high_m, corners, speed_mps, acceleration_mps2)


def laps(draw: Generator, low_m: Array, high_m: Array, speed_mps: float, acceleration_mps2: float) -> Trajectory:
    """Round a rectangle that takes more than 0.86 of the box each way, every corner turned at the acceleration."""
    size = np.append((high_m - low_m)[:2] * draw.uniform(*_LAP_SHARE, 2), 0.0)
    corners = np.array([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)]) * size
    return _path(draw, low_m, high_m, corners, speed_mps, acceleration_mps2)


def zigzag(draw: Generator, low_m: Array, high_m: Array, speed_mps: float, acceleration_mps2: float) -> Trajectory:
    """Left and right along the box and back, by right angles as quick as the acceleration allows."""
    step = 1.02 * speed_mps * turn_s(speed_mps, acceleration_mps2) / math.sqrt(2.0)
    corners = np.array([(0, 0, 0), (1, 1, 0), (0, 2, 0), (1, 3, 0), (0, 4, 0), (-1, 3, 0), (0, 2, 0), (-1, 1, 0)])
    return _path(draw, low_m, high_m, step * corners, speed_mps, acceleration_mps2)


def stop_and_go(draw: Generator, low_m: Array, high_m: Array, speed_mps: float, acceleration_mps2: float) -> Trajectory:
    """To eight points in the box, with rests of a second."""
    return StopAndGo(draw.uniform(low_m, high_m, (8, 3)), speed_mps, acceleration_mps2, 1.0)


def turn_s(speed_mps: float, acceleration_mps2: float) -> float:
    """Time in which a velocity turns by a right angle."""
    return math.sqrt(2.0) * speed_mps / acceleration_mps2


def _path(
    draw: Generator, low_m: Array, high_m: Array, corners: Array, speed_mps: float, acceleration_mps2: float
) -> Trajectory:
    """Put a loop somewhere in the box, begun at any corner, either way round."""
    least, most = low_m - corners.min(axis=0), high_m - corners.max(axis=0)
    placed = corners + draw.uniform(np.minimum(least, most), np.maximum(least, most))
    turned = np.roll(placed, int(draw.integers(len(placed))), axis=0)[:: int(draw.choice((-1, 1)))]
    return Waypoints(turned, speed_mps, loop=True, corner_s=turn_s(speed_mps, acceleration_mps2))
