"""Process that computes overlays of the map."""

from functools import lru_cache
from typing import Any, Final

import msgspec
import numpy as np
from msgspec import UNSET
from msgspec.structs import replace

from skyless.core.arrays import Array
from skyless.core.errors import SkylessError
from skyless.core.method_names import DEFAULT_METHOD
from skyless.core.site import Site
from skyless.page.tasks import OverlayTask, serve_tasks
from skyless.site.channel import ChannelModel
from skyless.site.planning.colours import COLOUR_STOPS, scale_of
from skyless.site.planning.links import FIX_SHARE, HDOP, PDOP, SIGMA, lowest_and_highest
from skyless.site.planning.maps import MAX_PREDICTED, STEPS_M, Grid, Predictor, plan_map

MAX_CELLS: Final = 40_000

_MIN_FIX_SHARE: Final = 0.5


def overlay(task: OverlayTask) -> dict[str, Any]:
    """Compute the answer to ``/api/overlay``. Raises SkylessError."""
    grid, grids = _grids(msgspec.json.encode(replace(task, kind="pdop")))  # one cache entry for all kinds
    values = grids[task.kind]
    known = sorted(value for value in values if value is not None)
    scale = scale_of(known)
    if scale is None:
        raise SkylessError("nowhere at this site is there a fix")
    return {
        "kind": task.kind,
        "unit": "m" if task.kind == "sigma" else "1",
        "x_m": [float(grid.x_m[0]), float(grid.x_m[-1])],
        "y_m": [float(grid.y_m[0]), float(grid.y_m[-1])],
        "step_m": grid.step_m,
        "columns": len(grid.x_m),
        "rows": len(grid.y_m),
        "values": values,
        "method": DEFAULT_METHOD,
        "height_m": float(grid.heights_m[0]),
        "least": known[0],
        "most": known[-1],
        "scale": {"low": scale.low, "high": scale.high, "ticks": scale.ticks, "stops": COLOUR_STOPS},
    }


@lru_cache(8)
def _grids(task: bytes) -> tuple[Grid, dict[str, list[float | None]]]:
    """PDOP, HDOP and predicted sigma row by row from the lowest y; None where there is no fix."""
    asked = msgspec.json.decode(task, type=OverlayTask)
    count, needed = len(asked.site.anchors), 4 if asked.site.tags.height_m is None else 3
    if count > MAX_PREDICTED:
        raise SkylessError(f"errors are predicted for sites of at most {MAX_PREDICTED} anchors")
    if not count:
        raise SkylessError("no anchor of this site has a position yet; survey it first")
    if count < needed:
        raise SkylessError(f"a position needs {needed} anchors or more; this site has {count}")
    grid = grid_of(asked.site, asked.plan_px, asked.step_m)
    table = plan_map(Predictor(asked.site, ChannelModel()), grid).table[0]
    covered = table[..., FIX_SHARE] >= _MIN_FIX_SHARE
    return grid, {
        "pdop": _values(table[..., PDOP], 3),
        "hdop": _values(table[..., HDOP], 3),
        "sigma": _values(np.where(covered, table[..., SIGMA], np.inf), 5),
    }


def grid_of(site: Site, plan_px: tuple[int, int] | None, least_step_m: float) -> Grid:
    """Grid over the floor plan, the outline and all anchors, with larger cells if there would be too many.

    It is at the known height of the tags, or half-way between the lowest and highest anchor.
    """
    points = [(anchor.x_m, anchor.y_m) for anchor in site.anchors]
    points += () if site.outline_m is UNSET else site.outline_m
    plan = site.floor_plan
    if plan is not None and plan_px is not None:
        length_m = plan.width_m * plan_px[1] / plan_px[0]
        points += [(plan.x_m, plan.y_m), (plan.x_m + plan.width_m, plan.y_m + length_m)]
    low, high = np.min(points, axis=0), np.max(points, axis=0)
    for step_m in (least_step_m, *(step_m for step_m in STEPS_M if step_m > least_step_m)):
        columns, rows = (max(1, -int(-length_m // step_m)) for length_m in high - low)
        if columns * rows <= MAX_CELLS:
            break
    xs, ys = (start + (np.arange(count) + 0.5) * step_m for start, count in zip(low, (columns, rows), strict=True))
    height_m = site.tags.height_m if site.tags.height_m is not None else sum(lowest_and_highest(site)) / 2
    return Grid(xs, ys, np.array([height_m]), step_m, np.ones((rows, columns), dtype=np.bool_))


def _values(column: Array, digits: int) -> list[float | None]:
    return [round(value, digits) if np.isfinite(value) else None for value in column.ravel().tolist()]


if __name__ == "__main__":
    serve_tasks(OverlayTask, overlay)
