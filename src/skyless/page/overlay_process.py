"""The process that computes overlays."""

from typing import Final

import msgspec
import numpy as np

from skyless.core.arrays import Array
from skyless.core.errors import SkylessError
from skyless.core.method_names import DEFAULT_METHOD, METHODS
from skyless.page.overlays import OverlayGrids, OverlayTask
from skyless.page.task_process import serve_tasks
from skyless.site.planning.links import FIX_SHARE, HDOP, PDOP, SIGMA
from skyless.site.planning.maps import Grid, plan_map
from skyless.site.planning.predict import MAX_PREDICTED, PlanSettings, Predictor

_MIN_FIX_SHARE: Final = 0.5


def answer(task: bytes) -> bytes:
    """The grids of one task, both as JSON."""
    return msgspec.json.encode(overlay_grids(msgspec.json.decode(task, type=OverlayTask)))


def overlay_grids(task: OverlayTask) -> OverlayGrids:
    """PDOP, HDOP and predicted sigma at the known height of the tags, or half-way up the anchors."""
    if len(task.site.anchors) > MAX_PREDICTED:
        return OverlayGrids(error=f"errors are predicted for sites of at most {MAX_PREDICTED} anchors")
    needed = 4 if task.site.tags.height_m is None else 3
    if len(task.site.anchors) < needed:
        return OverlayGrids(error=f"a position needs {needed} anchors or more; this site has {len(task.site.anchors)}")
    settings = PlanSettings(task.method if task.method in METHODS else DEFAULT_METHOD)
    try:
        grid = _grid(task)
        table = plan_map(Predictor(task.site, settings), grid).table[0]
    except (SkylessError, ValueError) as error:
        return OverlayGrids(error=str(error))
    covered = table[..., FIX_SHARE] >= _MIN_FIX_SHARE
    return OverlayGrids(
        pdop=_values(table[..., PDOP], 3),
        hdop=_values(table[..., HDOP], 3),
        sigma=_values(np.where(covered, table[..., SIGMA], np.inf), 5),
        height_m=float(grid.heights_m[0]),
    )


def _grid(task: OverlayTask) -> Grid:
    x1, y1, _, _ = task.box_m
    heights = [anchor.z_m for anchor in task.site.anchors]
    height_m = task.site.tags.height_m
    if height_m is None:
        height_m = (min(heights) + max(heights)) / 2
    xs: Array = x1 + (np.arange(task.columns, dtype=np.float64) + 0.5) * task.step_m
    ys: Array = y1 + (np.arange(task.rows, dtype=np.float64) + 0.5) * task.step_m
    everywhere = np.ones((task.rows, task.columns), dtype=np.bool_)
    return Grid(xs, ys, np.array([height_m], dtype=np.float64), task.step_m, everywhere)


def _values(column: Array, digits: int) -> list[float | None]:
    return [round(value, digits) if np.isfinite(value) else None for value in column.ravel().tolist()]


if __name__ == "__main__":
    serve_tasks(answer)
