"""Overlays of the map, computed in a process of their own, so that their work never holds up the pages."""

import asyncio
import sys
from collections import Counter, OrderedDict
from typing import Any, Final, Literal

import msgspec
from msgspec import Struct
from msgspec.structs import replace

from skyless.method_names import DEFAULT_METHOD
from skyless.site.image import image_size
from skyless.site.model import Site

Kind = Literal["pdop", "hdop", "sigma"]
KINDS: Final[tuple[Kind, ...]] = ("pdop", "hdop", "sigma")
MOST_CELLS: Final = 40_000
STEPS_M: Final = (0.05, 0.1, 0.2, 0.25, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0)

_KEPT: Final = 8
_LONGEST_S: Final = 120.0
_BAD_SHARE: Final = 0.95
"""Worse values than that of so many cells look all the same: single ones beside an anchor would take all colours."""

_LEAST_SPAN: Final = 2.0
"""A scale reaches to twice its best value at least, so that small differences look small."""

Box = tuple[float, float, float, float]


class NoOverlayError(Exception):
    """Why there is no overlay, for the person who asked."""


class OverlayTask(Struct, frozen=True):
    """What the process is given, as JSON on standard input."""

    site: Site
    box_m: Box
    """x1, y1, x2, y2 of the lowest and highest cells' outer edges."""
    columns: int
    rows: int
    step_m: float
    method: str


class OverlayGrids(Struct, frozen=True):
    """What the process gives: values row by row from the lowest y, None where there is no fix; or what is wrong."""

    pdop: list[float | None] = []
    hdop: list[float | None] = []
    sigma: list[float | None] = []
    error: str | None = None


class Overlays:
    """Answers requests for overlays; the last ones are kept, and one is computed at a time."""

    def __init__(self) -> None:
        self._kept: OrderedDict[bytes, OverlayGrids] = OrderedDict()
        self._one = asyncio.Lock()
        self._process: asyncio.subprocess.Process | None = None
        self._stopped = False

    def stop(self) -> None:
        """End what is being computed, for good."""
        self._stopped = True
        if self._process is not None and self._process.returncode is None:
            self._process.kill()

    async def get(
        self, site: Site, floor_plan: bytes | None, methods: list[str], kind: Kind, step_m: float
    ) -> dict[str, Any]:
        """The answer to ``/api/overlay``. Raises NoOverlayError."""
        task = overlay_task(site, floor_plan, _commonest(methods), step_m)
        key = msgspec.json.encode(task)
        async with self._one:
            grids = self._kept.get(key)
            if grids is None:
                grids = await self._compute(key)
                self._kept[key] = grids
                while len(self._kept) > _KEPT:
                    self._kept.popitem(last=False)
            self._kept.move_to_end(key)
        if grids.error is not None:
            raise NoOverlayError(grids.error)
        return _answer(task, kind, grids)

    async def _compute(self, task: bytes) -> OverlayGrids:
        if self._stopped:
            raise NoOverlayError("the dashboard is stopping")
        self._process = process = await asyncio.create_subprocess_exec(
            *(sys.executable, "-m", "skyless.dashboard.overlay_process"),
            stdin=asyncio.subprocess.PIPE,
            stdout=asyncio.subprocess.PIPE,
            start_new_session=True,  # Ctrl-C is for the dashboard, which kills this one itself
        )
        try:
            async with asyncio.timeout(_LONGEST_S):
                output, _ = await process.communicate(task)
            return msgspec.json.decode(output, type=OverlayGrids)
        except TimeoutError:
            raise NoOverlayError("this overlay takes too long to compute") from None
        except msgspec.MsgspecError:
            raise NoOverlayError("this overlay could not be computed; the dashboard's terminal says why") from None
        finally:
            if process.returncode is None:
                process.kill()


def overlay_task(site: Site, floor_plan: bytes | None, method: str, step_m: float) -> OverlayTask:
    """The grid over the floor plan and all anchors, coarser than asked for where it would have too many cells."""
    x1, y1, x2, y2 = _box(site, floor_plan)
    for step in (step_m, *(step for step in STEPS_M if step > step_m)):
        columns, rows = (max(1, -int(-length // step)) for length in (x2 - x1, y2 - y1))
        if columns * rows <= MOST_CELLS:
            break
    site = replace(site, floor_plan=None)  # its image is not here, and its box is known
    return OverlayTask(site, (x1, y1, x1 + columns * step, y1 + rows * step), columns, rows, step, method)


def _box(site: Site, floor_plan: bytes | None) -> Box:
    xs, ys = [anchor.x_m for anchor in site.anchors], [anchor.y_m for anchor in site.anchors]
    size = image_size(floor_plan) if floor_plan is not None else None
    plan = site.floor_plan
    if plan is not None and size is not None:
        xs += [plan.x_m, plan.x_m + plan.width_m]
        ys += [plan.y_m, plan.y_m + plan.width_m * size[1] / size[0]]
    return min(xs), min(ys), max(xs), max(ys)


def _commonest(methods: list[str]) -> str:
    return Counter(methods).most_common(1)[0][0] if methods else DEFAULT_METHOD


def _answer(task: OverlayTask, kind: Kind, grids: OverlayGrids) -> dict[str, Any]:
    x1, y1, x2, y2 = task.box_m
    half_m = task.step_m / 2
    return {
        "kind": kind,
        "unit": "m" if kind == "sigma" else "1",
        "x_m": [x1 + half_m, x2 - half_m],
        "y_m": [y1 + half_m, y2 - half_m],
        "step_m": task.step_m,
        "columns": task.columns,
        "rows": task.rows,
        "values": getattr(grids, kind),
        "method": task.method,
        "levels": levels(getattr(grids, kind)),
    }


def levels(values: list[float | None]) -> dict[str, float]:
    """The ends of the scale of colours."""
    known = sorted(value for value in values if value is not None)
    if not known:
        return {"good": 0.0, "bad": 1.0}
    bad = known[round(_BAD_SHARE * (len(known) - 1))]
    return {"good": known[0], "bad": max(bad, _LEAST_SPAN * known[0])}
