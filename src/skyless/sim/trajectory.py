"""Motion of tags: paths made of pieces of constant acceleration, as functions of true time.

A path returns the piece valid at an instant, so that the compiled channel evaluates positions and calls Python only at
the end of a piece.
"""

import bisect
import math
from abc import ABC, abstractmethod
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from skyless.core.arrays import Array
from skyless.sim.streams import stream

_ROAM_KEY: Final = 5


class Piece(NamedTuple):
    """Motion of constant acceleration in [start_s, end_s); vectors have shape (3,) and apply at ``origin_s``."""

    start_s: float
    end_s: float
    origin_s: float
    position_m: Array
    velocity_mps: Array
    acceleration_mps2: Array


class Trajectory(ABC):
    """A path through the site."""

    @abstractmethod
    def piece(self, t_s: float) -> Piece:
        """The piece valid at a true time; fastest when asked in order of time."""

    def position(self, t_s: float) -> Array:
        """Position at a true time in metres, shape (3,)."""
        piece = self.piece(t_s)
        dt_s = t_s - piece.origin_s
        return piece.position_m + dt_s * (piece.velocity_mps + 0.5 * dt_s * piece.acceleration_mps2)

    def velocity(self, t_s: float) -> Array:
        """Velocity at a true time in m/s, shape (3,)."""
        piece = self.piece(t_s)
        return piece.velocity_mps + (t_s - piece.origin_s) * piece.acceleration_mps2


def _rest(position_m: Array, end_s: float = math.inf) -> Piece:
    return Piece(-math.inf, end_s, 0.0, position_m, np.zeros(3), np.zeros(3))


class Static(Trajectory):
    """A tag that does not move."""

    def __init__(self, x_m: float, y_m: float, z_m: float = 0.0) -> None:
        self._piece = _rest(np.array([x_m, y_m, z_m], dtype=np.float64))

    def piece(self, t_s: float) -> Piece:  # noqa: ARG002 - the same at all times
        """See ``Trajectory``."""
        return self._piece


class Waypoints(Trajectory):
    """Walking from point to point along straight lines at constant speed.

    With ``corner_s`` the velocity turns over that time around every corner (and at start and end) at constant
    acceleration, cutting the corner slightly; without it, at once. ``loop`` joins the last point to the first and
    repeats for ever. Before the time 0 the tag rests at the first point.
    """

    def __init__(self, points_m: ArrayLike, speed_mps: float, *, loop: bool = False, corner_s: float = 0.0) -> None:
        """``points_m`` has shape (n, 2) or (n, 3), n ≥ 2. Raises ValueError for paths that cannot be walked."""
        points = np.asarray(points_m, dtype=np.float64)
        if points.ndim != 2 or points.shape[0] < 2 or points.shape[1] not in {2, 3}:
            raise ValueError(f"waypoints should have shape (n, 2) or (n, 3) with n of 2 or more, not {points.shape}")
        self._points_m = np.pad(points, ((0, 0), (0, 3 - points.shape[1])))
        self._loop = loop
        targets = np.roll(self._points_m, -1, axis=0) if loop else self._points_m[1:]
        steps = targets - self._points_m[: len(targets)]
        lengths = np.linalg.norm(steps, axis=1)
        if speed_mps <= 0.0 or not np.all(lengths > 0.0):
            raise ValueError("waypoints need a speed above 0 and neighbouring points that differ")
        durations = lengths / speed_mps
        if corner_s < 0.0 or corner_s > durations.min():
            raise ValueError(f"corner_s should lie between 0 and the shortest leg's {durations.min():.3g} s")
        self._legs_mps = steps / durations[:, None]
        self._passed_s: list[float] = [0.0, *np.cumsum(durations)[:-1].tolist()]
        self._lap_s = float(durations.sum())
        self._half_s = 0.5 * corner_s

    def piece(self, t_s: float) -> Piece:
        """See ``Trajectory``."""
        if t_s < 0.0:
            return _rest(self._points_m[0], end_s=0.0)
        corner = self._last_corner(t_s)
        if corner < 0 or t_s >= self._time_s(corner + 1) - self._half_s:
            return self._bend(corner + 1)
        if self._half_s > 0.0 and t_s < self._time_s(corner) + self._half_s:
            return self._bend(corner)
        begin_s, end_s = self._time_s(corner), self._time_s(corner + 1)
        return Piece(
            begin_s + self._half_s, end_s - self._half_s, begin_s, self._corner(corner), self._leg(corner), np.zeros(3)
        )

    def _last_corner(self, t_s: float) -> int:
        """Number of the last corner passed, counted across laps; -1 before the first."""
        within_s = t_s - self._half_s
        lap = int(within_s // self._lap_s) if self._loop else 0
        within_s -= lap * self._lap_s
        corner = lap * len(self._legs_mps) + bisect.bisect_right(self._passed_s, within_s) - 1
        while t_s >= self._time_s(corner + 1):
            corner += 1
        while corner >= 0 and t_s < self._time_s(corner):
            corner -= 1
        return corner

    def _time_s(self, corner: int) -> float:
        if not self._loop and corner >= len(self._legs_mps):
            return self._half_s + self._lap_s if corner == len(self._legs_mps) else math.inf
        lap, within = divmod(corner, len(self._legs_mps))
        return self._half_s + lap * self._lap_s + self._passed_s[within]

    def _corner(self, corner: int) -> Array:
        index = corner % len(self._points_m) if self._loop else min(corner, len(self._points_m) - 1)
        point: Array = self._points_m[index]
        return point

    def _leg(self, corner: int) -> Array:
        """Velocity after a corner; zero before the first and after the last."""
        if corner < 0 or (not self._loop and corner >= len(self._legs_mps)):
            return np.zeros(3)
        leg: Array = self._legs_mps[corner % len(self._legs_mps)]
        return leg

    def _bend(self, corner: int) -> Piece:
        begin_s = self._time_s(corner) - self._half_s
        end_s = self._time_s(corner) + self._half_s
        before, after = self._leg(corner - 1), self._leg(corner)
        turning = (after - before) / (2.0 * self._half_s)
        return Piece(begin_s, end_s, begin_s, self._corner(corner) - before * self._half_s, before, turning)


class Roaming(Trajectory):
    """A random walk about a point: a new random acceleration every ``step_s``, without abrupt turns.

    The velocity gains variance qa per second and axis, the process noise of a constant-velocity filter. Damping and a
    spring bound the walk. From the start each coordinate is normal about the middle, with ``std_m``, and its velocity
    has a standard deviation of √(qa·damping_s/2). An axis with a ``std_m`` of 0 does not move.
    """

    def __init__(
        self,
        middle_m: ArrayLike,
        std_m: ArrayLike,
        *,
        qa_m2ps3: float = 0.3,
        damping_s: float = 3.0,
        step_s: float = 0.05,
        seed: int = 0,
    ) -> None:
        """``middle_m`` and ``std_m`` have shape (3,); accelerations change every ``step_s``."""
        self._middle_m, self._std_m = np.array(middle_m, dtype=np.float64), np.array(std_m, dtype=np.float64)
        self._free = self._std_m > 0.0
        self._speed_mps = math.sqrt(0.5 * qa_m2ps3 * damping_s)
        self._kick_mps2 = math.sqrt(qa_m2ps3 / step_s)
        self._pull_per_s2 = np.square(self._speed_mps / np.where(self._free, self._std_m, 1.0))
        self._damping_s, self._step_s, self._seed = damping_s, step_s, seed
        self._begin()

    def piece(self, t_s: float) -> Piece:
        """See ``Trajectory``; going back in time starts over."""
        if t_s < self._piece.start_s:
            self._begin()
        while t_s >= self._piece.end_s:
            last = self._piece
            dt_s = last.end_s - last.origin_s
            velocity = last.velocity_mps + dt_s * last.acceleration_mps2
            position = last.position_m + dt_s * (last.velocity_mps + 0.5 * dt_s * last.acceleration_mps2)
            self._append(position, velocity)
        return self._piece

    def _begin(self) -> None:
        self._generator, self._steps = stream(self._seed, _ROAM_KEY, 0), 0
        offset, motion = self._generator.standard_normal((2, 3))
        self._append(self._middle_m + self._std_m * offset, np.where(self._free, self._speed_mps * motion, 0.0))

    def _append(self, position_m: Array, velocity_mps: Array) -> None:
        """Append a piece with a new acceleration."""
        away_m = position_m + 0.5 * self._step_s * velocity_mps - self._middle_m  # halfway through the piece
        held = -self._pull_per_s2 * away_m - velocity_mps / self._damping_s
        push = np.where(self._free, held + self._kick_mps2 * self._generator.standard_normal(3), 0.0)
        start_s = self._steps * self._step_s
        self._steps += 1
        self._piece = Piece(start_s, self._steps * self._step_s, start_s, position_m, velocity_mps, push)
