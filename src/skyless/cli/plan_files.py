"""The files that ``skyless plan`` writes: the optimised site, tables, picture and page."""

import os
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

from skyless.cli.common.options import open_for_writing
from skyless.cli.common.output import write_atomically
from skyless.cli.plan_output import described, html_page
from skyless.errors import SkylessError

if TYPE_CHECKING:
    from skyless.planning.floor import Floor
    from skyless.planning.maps import PlanMap
    from skyless.planning.predict import Predictor
    from skyless.site.model import Site


def write_site(out: Path, site: "Site", source: Path) -> None:
    """Write an optimised site, made from ``source``, with the way to its image as seen from the new file.

    Raises SkylessError when it cannot be written.
    """
    from skyless.site.check import check_site
    from skyless.site.template import site_template

    if site.floor_plan is not None:
        image = os.path.relpath(source.parent / site.floor_plan.image, out.parent)
        site = msgspec.structs.replace(site, floor_plan=msgspec.structs.replace(site.floor_plan, image=image))
    check_site(site, out)
    _save(out, site_template(site).encode())


def write_files(
    file: Path,
    predictor: "Predictor",
    floor: "Floor",
    mapped: "PlanMap",
    result: dict[str, Any],
    plot: Path | None,
    grid: Path | None,
    html: Path | None,
) -> None:
    """Write the files that were asked for. Raises SkylessError when one cannot be written."""
    if grid is not None:
        with open_for_writing(grid) as table:
            table.writelines(_lines(mapped, grid, predictor.site))
    if plot is None and html is None:
        return
    from skyless.evaluation.figures import save_figure
    from skyless.planning.picture import RMSE_LAYER, SIGMA_LAYER, Background, draw_layer

    background = Background(predictor.site, floor, file, described(result))
    if plot is not None:
        layer = RMSE_LAYER if result["walls_bias"] else SIGMA_LAYER
        try:
            save_figure(draw_layer(mapped, layer, background), plot)
        except (OSError, ValueError) as error:
            raise SkylessError(f"{plot} cannot be written: {error}") from None
    if html is not None:
        _save(html, html_page(result, mapped, background).encode())


def _save(path: Path, data: bytes) -> None:
    try:
        write_atomically(path, data)
    except OSError as error:
        raise SkylessError(f"{path} cannot be written: {error.strerror}") from None


def _lines(mapped: "PlanMap", path: Path, site: "Site") -> Iterator[str]:
    from skyless.planning.tables import csv_lines, geojson_lines

    return csv_lines(mapped) if path.suffix.lower() == ".csv" else geojson_lines(mapped, site.georeference)
