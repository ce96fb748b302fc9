"""Errors of the ranges from anchors to tags that are no noise: each pair has its own, constant or changing slowly.

Real pairs of radios have them from antennas, multipath, calibration and power. Those that change are Gauss–Markov
processes (exponential correlation) along time or along the path of a tag, drawn at knots and interpolated.
"""

import math
from typing import Any, Final

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from skyless.core.arrays import Array, Records
from skyless.sim.streams import TAG_KEY, stream
from skyless.site.kernels import kernel

_KNOTS: Final = 20
"""In a correlation length. Between two of them a straight line keeps 98.7 % of the standard deviation or more."""

_SLOPE_MIDDLE_M: Final = 4.0
"""The slope's error is 0 at this distance, and reaches its size at 0 and at twice this distance."""

_PURPOSE: Final = 2
"""Purpose of a tag's stream of random numbers, other than its noise and its crystal."""


class RangeErrorModel(Struct, frozen=True, forbid_unknown_fields=True):
    """Range errors at tags, in metres; positive: the tag receives the anchor late.

    Raises:
        ValueError: errors that change have no correlation length, or two.
    """

    constant_m: float = 0.0
    """Each pair's constant is uniform within plus or minus this."""
    slope_m: float = 0.0
    """Same for all pairs: slope_m·clip((d − 4 m)/4 m, −1, 1) at the true distance d."""
    changing_m: float = 0.0
    """Standard deviation of each pair's error that changes."""
    correlation_s: float | None = None
    """Time in which its correlation falls to 1/e."""
    correlation_m: float | None = None
    """Instead of that, the path length in which it falls to 1/e."""

    def __post_init__(self) -> None:
        lengths = [one for one in (self.correlation_s, self.correlation_m) if one is not None]
        if len(lengths) > 1 or (self.changing_m > 0.0 and not lengths):
            raise ValueError("range errors that change should have either correlation_s or correlation_m")
        if any(not one > 0.0 for one in lengths):
            raise ValueError(f"the correlation of range errors is {lengths[0]:g}; it should be more than 0")


@kernel
def slope_error_m(slope_m: float, distance_m: float) -> float:
    """Range error that grows with the true distance (``RangeErrorModel.slope_m``)."""
    return slope_m * min(max((distance_m - _SLOPE_MIDDLE_M) / _SLOPE_MIDDLE_M, -1.0), 1.0)


class RangeErrors:
    """The present errors of all pairs. Those of a tag depend on the seed, its number and its path alone."""

    def __init__(self, model: RangeErrorModel, tags: int, anchors: int, seed: int, purpose: int = _PURPOSE) -> None:
        """``purpose``: that of the tags' streams of random numbers."""
        self.present_m: Array = np.zeros((anchors + tags, anchors))
        """Shape (nodes, anchors) as the kernels count them, without the slope part; those of anchors stay as set."""
        self._model, self._anchors = model, anchors
        self._constant_m = np.zeros((tags, anchors))
        self._step = (model.correlation_s or model.correlation_m or math.inf) / _KNOTS
        self._travelled = np.zeros(tags)
        """Time or path length of each tag so far."""
        self._knots = np.zeros(tags, dtype=np.int64)
        self._positions_m: Array | None = None
        self._before_m, self._after_m = np.zeros((tags, anchors)), np.zeros((tags, anchors))
        self._draws: list[np.random.Generator] = []
        if model.constant_m > 0.0 or model.changing_m > 0.0:
            self._draws = [stream(seed, TAG_KEY, tag, purpose) for tag in range(tags)]
        for tag, draw in enumerate(self._draws):
            self._constant_m[tag] = draw.uniform(-model.constant_m, model.constant_m, anchors)
            self._before_m[tag] = model.changing_m * draw.standard_normal(anchors)
            self._after_m[tag] = self._next(tag)
        self.present_m[anchors:] = self._constant_m

    def _next(self, tag: int) -> Array:
        """The errors at the knot after the present one; the correlation over one step is exp(−1/_KNOTS)."""
        kept = math.exp(-1.0 / _KNOTS)
        gained_m = self._model.changing_m * math.sqrt(1.0 - kept**2)
        return np.asarray(kept * self._before_m[tag] + gained_m * self._draws[tag].standard_normal(self._anchors))

    def advance_to(self, t_s: float, stations: Records) -> None:
        """Bring the errors to a true time ; ``stations`` hold the tags' motion."""
        if self._model.changing_m == 0.0:
            return
        if self._model.correlation_s is not None:
            self._travelled[:] = t_s
        else:
            self._walk(_positions_m(stations[self._anchors :], t_s))
        for tag in np.flatnonzero(self._travelled >= (self._knots + 1) * self._step).tolist():
            while self._travelled[tag] >= (self._knots[tag] + 1) * self._step:
                self._knots[tag] += 1
                self._before_m[tag] = self._after_m[tag]
                self._after_m[tag] = self._next(tag)
        part = (self._travelled / self._step - self._knots)[:, None]
        changing_m = self._before_m + part * (self._after_m - self._before_m)
        self.present_m[self._anchors :] = self._constant_m + changing_m

    def _walk(self, positions_m: Array) -> None:
        """Add up the path from frame to frame along straight lines."""
        if self._positions_m is not None:
            self._travelled += np.linalg.norm(positions_m - self._positions_m, axis=1)
        self._positions_m = positions_m


def _positions_m(tags: NDArray[Any], t_s: float) -> Array:
    """Positions of tags at a true time, shape (tags, 3)."""
    dt_s = (t_s - tags["origin_s"])[:, None]
    turned = tags["velocity_mps"] + 0.5 * dt_s * tags["acceleration_mps2"]
    return np.asarray(tags["position_m"] + dt_s * turned, np.float64)
