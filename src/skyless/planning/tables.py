"""A map as a table for other programs: CSV, or GeoJSON with one point for each cell."""

from collections.abc import Iterator
from typing import Final

import numpy as np

from skyless.kernels.arrays import Matrix
from skyless.planning.columns import ANCHORS, COLUMNS
from skyless.planning.maps import PlanMap
from skyless.site.georeference import to_wgs84
from skyless.site.model import GeoreferenceSite

_ROWS: Final = 20_000


def rows_of(plan: PlanMap) -> Matrix:
    """x, y, z and the columns of every point inside the outline, shape (points, 3 + columns)."""
    x, y = np.meshgrid(plan.grid.x_m, plan.grid.y_m)
    within = plan.grid.within
    slices = [
        np.column_stack([x[within], y[within], np.full(int(within.sum()), height), table[within]])
        for height, table in zip(plan.grid.heights_m, plan.table, strict=True)
    ]
    return np.concatenate(slices)


def csv_lines(plan: PlanMap) -> Iterator[str]:
    """The table in pieces; empty fields where there is no fix."""
    yield ",".join(("x_m", "y_m", "z_m", *COLUMNS)) + "\n"
    pattern = ",".join(["%.3f"] * 3 + ["%d" if k == ANCHORS else "%.4g" for k in range(len(COLUMNS))]) + "\n"
    for rows in _pieces(plan):
        text = "".join([pattern % row for row in map(tuple, rows.tolist())])
        yield text.replace("inf", "").replace("nan", "")


def geojson_lines(plan: PlanMap, georeference: GeoreferenceSite | None) -> Iterator[str]:
    """A FeatureCollection in pieces; null where there is no fix.

    With a georeference of the site the coordinates are longitude and latitude as RFC 7946 wants them; without one
    they are the site's metres, and a member ``skyless:frame`` says so.
    """
    frame = "WGS 84" if georeference else "site, metres"
    yield f'{{"type":"FeatureCollection","skyless:frame":"{frame}","features":[\n'
    keys = ",".join(f'"{name}":' + ("%d" if k == ANCHORS else "%.4g") for k, name in enumerate(COLUMNS))
    place = "[%.8f,%.8f,%.3f]" if georeference else "[%.3f,%.3f,%.3f]"
    geometry = f'"geometry":{{"type":"Point","coordinates":{place}}}'
    pattern = f'{{"type":"Feature",{geometry},"properties":{{{keys}}}}}'
    first = True
    for rows in _pieces(plan):
        if georeference:
            rows[:, :3] = to_wgs84(rows[:, :3], georeference)
        text = ",\n".join([pattern % row for row in map(tuple, rows.tolist())])
        yield ("" if first else ",\n") + text.replace(":inf", ":null").replace(":nan", ":null")
        first = False
    yield "\n]}\n"


def _pieces(plan: PlanMap) -> Iterator[Matrix]:
    rows = rows_of(plan)
    for start in range(0, len(rows), _ROWS):
        yield rows[start : start + _ROWS]
