"""Overlays of the map, computed in a separate process so that they never delay the pages."""

import asyncio
from collections import Counter, OrderedDict
from pathlib import Path
from typing import Any, Final, Literal

import msgspec
from msgspec import UNSET, Struct
from msgspec.structs import replace

from skyless.core.method_names import DEFAULT_METHOD
from skyless.core.site import Site
from skyless.page.task_process import TaskError, TaskProcess
from skyless.site.file.check import check_site, image_size
from skyless.site.planning.colours import COLOUR_STOPS, scale_of

Kind = Literal["pdop", "hdop", "sigma"]
KINDS: Final[tuple[Kind, ...]] = ("pdop", "hdop", "sigma")
MAX_CELLS: Final = 40_000
_STEPS_M: Final = (0.05, 0.1, 0.2, 0.25, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 50.0, 100.0)

_MAX_CACHED: Final = 8
Box = tuple[float, float, float, float]


class MovedAnchor(Struct, frozen=True):
    """Where an anchor would be."""

    id: int
    x_m: float
    y_m: float
    z_m: float


class MovedAnchors(Struct, frozen=True):
    """What a page asks about: the site as it would be with some anchors elsewhere."""

    anchors: tuple[MovedAnchor, ...] = ()

    def site_of(self, site: Site) -> Site:
        """The site with its anchors moved. Raises ConfigurationError."""
        at = {anchor.id: anchor for anchor in self.anchors}
        anchors = tuple(
            replace(one, x_m=at[one.id].x_m, y_m=at[one.id].y_m, z_m=at[one.id].z_m) if one.id in at else one
            for one in site.anchors
        )
        moved = replace(site, anchors=anchors)
        check_site(moved, Path("the moved anchors"))
        return moved


class NoOverlayError(Exception):
    """Why there is no overlay."""


class OverlayTask(Struct, frozen=True):
    """Input of the process, as JSON."""

    site: Site
    box_m: Box
    """x1, y1, x2, y2 of the lowest and highest cells' outer edges."""
    columns: int
    rows: int
    step_m: float
    method: str


class OverlayGrids(Struct, frozen=True):
    """Output of the process: an error, or values row by row from the lowest y, None where there is no fix."""

    pdop: list[float | None] = []
    hdop: list[float | None] = []
    sigma: list[float | None] = []
    height_m: float | None = None
    """Height of the tags for which it is predicted."""
    error: str | None = None


class Overlays:
    """Answers requests for overlays. The last ones are cached, and one is computed at a time."""

    def __init__(self) -> None:
        self._cached: OrderedDict[bytes, OverlayGrids] = OrderedDict()
        self._lock = asyncio.Lock()
        self._process = TaskProcess("skyless.page.overlay_process")

    def stop(self) -> None:
        """Stop the computation. No other starts."""
        self._process.stop()

    async def get(
        self, site: Site, floor_plan: bytes | None, methods: list[str], kind: Kind, step_m: float
    ) -> dict[str, Any]:
        """The answer to ``/api/overlay``. Raises NoOverlayError."""
        task = overlay_task(site, floor_plan, _most_common(methods), step_m)
        key = msgspec.json.encode(task)
        async with self._lock:
            grids = self._cached.get(key)
            if grids is None:
                grids = await self._compute(key)
                self._cached[key] = grids
                while len(self._cached) > _MAX_CACHED:
                    self._cached.popitem(last=False)
            self._cached.move_to_end(key)
        if grids.error is not None:
            raise NoOverlayError(grids.error)
        return _answer(task, kind, grids)

    async def _compute(self, task: bytes) -> OverlayGrids:
        try:
            return msgspec.json.decode(await self._process.run(task), type=OverlayGrids)
        except TaskError as error:
            raise NoOverlayError(f"the overlay cannot be computed: {error}") from None
        except msgspec.MsgspecError:
            raise NoOverlayError("this overlay could not be computed; the dashboard's terminal shows why") from None


def overlay_task(site: Site, floor_plan: bytes | None, method: str, step_m: float) -> OverlayTask:
    """The grid over the floor plan and all anchors, with a larger step where it would have too many cells."""
    x1, y1, x2, y2 = _box(site, floor_plan)
    for step in (step_m, *(step for step in _STEPS_M if step > step_m)):
        columns, rows = (max(1, -int(-length // step)) for length in (x2 - x1, y2 - y1))
        if columns * rows <= MAX_CELLS:
            break
    site = replace(site, floor_plan=None)  # its image is not here, and its box is known
    return OverlayTask(site, (x1, y1, x1 + columns * step, y1 + rows * step), columns, rows, step, method)


def _box(site: Site, floor_plan: bytes | None) -> Box:
    if not site.anchors:
        raise NoOverlayError("no anchor of this site has a position yet; survey it first")
    xs, ys = [anchor.x_m for anchor in site.anchors], [anchor.y_m for anchor in site.anchors]
    size = image_size(floor_plan) if floor_plan is not None else None
    plan = site.floor_plan
    if plan is not None and size is not None:
        xs += [plan.x_m, plan.x_m + plan.width_m]
        ys += [plan.y_m, plan.y_m + plan.width_m * size[1] / size[0]]
    for x, y in () if site.outline_m is UNSET else site.outline_m:
        xs.append(x)
        ys.append(y)
    return min(xs), min(ys), max(xs), max(ys)


def _most_common(methods: list[str]) -> str:
    return Counter(methods).most_common(1)[0][0] if methods else DEFAULT_METHOD


def _answer(task: OverlayTask, kind: Kind, grids: OverlayGrids) -> dict[str, Any]:
    x1, y1, x2, y2 = task.box_m
    half_m = task.step_m / 2
    values: list[float | None] = getattr(grids, kind)
    known = sorted(value for value in values if value is not None)
    scale = scale_of(known)
    if scale is None:
        raise NoOverlayError("nowhere at this site is there a fix")
    return {
        "kind": kind,
        "unit": "m" if kind == "sigma" else "1",
        "x_m": [x1 + half_m, x2 - half_m],
        "y_m": [y1 + half_m, y2 - half_m],
        "step_m": task.step_m,
        "columns": task.columns,
        "rows": task.rows,
        "values": values,
        "method": task.method,
        "height_m": grids.height_m,
        "least": known[0],
        "most": known[-1],
        "scale": {"low": scale.low, "high": scale.high, "ticks": scale.ticks, "stops": COLOUR_STOPS},
    }
