"""``skyless plan``: predict a site's errors before anything is mounted, and optimise its anchors' positions."""

import os
from pathlib import Path
from typing import TYPE_CHECKING, Final

from cyclopts import App
from msgspec.structs import replace

from skyless.cli.api.options import PlanOptions
from skyless.cli.common import (
    JsonOptions,
    check_output,
    check_picture,
    command,
    new_table,
    print_facts,
    print_json,
    print_warnings,
    progress_bar,
    write_file,
    write_picture,
)
from skyless.core.errors import ConfigurationError, SkylessError

if TYPE_CHECKING:
    from skyless.cli.api.plan import PlanResult
    from skyless.core.site import Site
    from skyless.site.planning.picture import Background

app = App(name="plan", help_epilogue="Example: skyless plan hall.toml --plot hall.png --target 5")

_NOTES: Final = (
    "Tags are at rest and compute with joint. A moving tag's filter is more accurate where survey and ranges have "
    "errors, which it tells from the position while it moves, else less.",
    "Stamps' noise and crystals are those of the site file, and the filters know them.",
    "Links are free space on channel 5 with the walls' losses of the site file; people, furniture, reflections and "
    "antennas' patterns are not known to the plan.",
    "Walls delay what crosses them as the site file states; nothing else is delayed.",
    "The figures hold the errors of survey and ranges that the site file states (accuracy).",
)


class _Output(JsonOptions, frozen=True, kw_only=True):
    plot: Path | None = None
    """Draw the picture into this file (PNG, SVG or PDF): the map of the predicted error."""
    grid: Path | None = None
    """Write every point's predictions into this .csv or .geojson file."""
    html: Path | None = None
    """Write a page with all maps, numbers and warnings into this file; it needs no other file."""
    out: Path | None = None
    """Write the result here: the optimised site, into a file that must not exist."""


@app.default
@command
def plan(asked: PlanOptions, output: _Output) -> None:
    """Predict the errors that tags at rest will have at a site, and where one more anchor would help.

    With --optimise the anchors are placed from the start, and the plan is of that site. The plan of
    a site of more than 60 anchors without a master is of the beacons that reach tags.
    """
    file = Path(str(asked.site))
    site = _load(file, output)
    if output.out is not None and asked.optimise is None:
        raise SkylessError("--out writes an optimised site; --optimise N asks for one")
    from skyless.cli.api.plan import RatePlanResult, run_plan
    from skyless.site.planning.report import described

    with progress_bar("planning") as reach:
        result = run_plan(replace(asked, progress=reach))
    title = f"{site.name} ({file})"
    if isinstance(result, RatePlanResult):
        output.leave_out("grid", "html", "out", why="errors are not predicted for so large a site")
    else:
        title = f"{title}: {described(result.summary)}"
        if output.out is not None:
            _write_site(output.out, replace(result.site, noise=site.noise), file)
        _write_files(result, output)
    if output.plot is not None:
        write_picture(output.plot, result.plot())
    if output.json:
        print_json(result.summary)
    else:
        print_facts(title, result.facts())
        print_warnings(result.summary["warnings"])


def _load(file: Path, output: _Output) -> "Site":
    """Load the site, and check its image and that all outputs are files of their own. Raises SkylessError."""
    from skyless.site.file.load import load_site

    site = load_site(file)
    image = None if site.floor_plan is None else file.parent / site.floor_plan.image
    check_picture(output.plot)
    outputs = {"plot": output.plot, "grid": output.grid, "html": output.html, "out": output.out}
    for name, path in outputs.items():
        check_output(name, path, file, image, *(other for key, other in outputs.items() if key != name))
    if output.grid is not None and output.grid.suffix.lower() not in {".csv", ".geojson", ".json"}:
        raise SkylessError(f"--grid is {str(output.grid)!r}; it should end with .csv or .geojson")
    if output.out is not None and output.out.exists():
        raise SkylessError(f"--out is {str(output.out)!r}, which exists; it should be a new file")
    if image is not None:
        _check_image(file, site, image)
    return site


def _check_image(file: Path, site: "Site", image: Path) -> None:
    """Check that the whole image can be read, not only its size."""
    from matplotlib.image import imread

    try:
        imread(image)
    except (OSError, SyntaxError, ValueError) as error:
        shown = site.floor_plan.image if site.floor_plan else ""
        right = f"an image that can be read to its end ({' '.join(str(error).split())})"
        raise ConfigurationError(file, "floor_plan.image", shown, right) from None


def _page(plan: "PlanResult", background: "Background") -> str:
    """The plan as one HTML page: a table of figures, warnings, pictures and assumptions."""
    from html import escape

    from skyless.site import report
    from skyless.site.planning.picture import draw_layer, layers_for
    from skyless.site.planning.report import described
    from skyless.site.report import picture

    result, facts = plan.summary, dict(plan.facts())
    for anchor in result["anchors"]:
        position = f"({anchor['x_m']:g}, {anchor['y_m']:g}, {anchor['z_m']:g}) m"
        heard, silent = anchor["hears_master"], "" if anchor["sends"] else ", silent"
        hears = "" if heard is None else f", hears {heard:.0%} of the master's frames"
        facts[f"anchor {anchor['id']}"] = f"{position}{hears}{silent}"
    title, warnings = f"Plan of {plan.site.name}", result["warnings"]
    parts = [f"<h1>{escape(title)}</h1>", f"<p>{escape(described(result))}</p>", report.table((), facts.items())]
    parts += ["<h2>Warnings</h2>", report.bullets(warnings, "warning") if warnings else "<p>None.</p>"]
    for layer in layers_for(plan.map):
        heading = layer.title.capitalize() if layer.title.islower() else layer.title
        figure = picture(draw_layer(plan.map, layer, background), "png", 110.0)
        parts += [f"<h2>{escape(heading)}</h2>", report.png_figure(figure, heading)]
    parts += ["<h2>What is assumed</h2>", report.bullets(_NOTES, "note")]
    return report.page(title, parts)


def _write_site(out: Path, site: "Site", source: Path) -> None:
    """Write an optimised site, derived from ``source``, with the path of its image relative to the new file.

    Raises SkylessError if it cannot be written.
    """
    from skyless.site.file.check import check_site
    from skyless.site.file.template import site_template

    if site.floor_plan is not None:
        image = os.path.relpath(source.parent / site.floor_plan.image, out.parent)
        site = replace(site, floor_plan=replace(site.floor_plan, image=image))
    check_site(site, out)
    write_file(out, site_template(site).encode())


def _write_files(plan: "PlanResult", output: _Output) -> None:
    """Write the requested table and page. Raises SkylessError if one cannot be written."""
    if (grid := output.grid) is not None:
        from skyless.site.planning.maps import csv_lines, geojson_lines

        with new_table(grid) as table:
            is_csv = grid.suffix.lower() == ".csv"
            table.writelines(csv_lines(plan.map) if is_csv else geojson_lines(plan.map, plan.site.georeference))
    if output.html is not None:
        from skyless.site.planning.picture import Background
        from skyless.site.planning.report import described

        background = Background(plan.site, plan.floor, plan.file, described(plan.summary))
        write_file(output.html, _page(plan, background).encode())
