"""``skyless plan``: what a site will give before anything is mounted, and where its anchors should hang."""

import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import msgspec
from cyclopts import App, Parameter
from cyclopts.validators import Number

from skyless.cli.options import Positive, finite_numbers, open_for_writing, spare_inputs
from skyless.cli.output import print_json, write_atomically
from skyless.cli.plan_output import report, show
from skyless.cli.progress import progress_bar
from skyless.errors import ConfigurationError, SkylessError

if TYPE_CHECKING:
    from skyless.planning.floor import Box, Floor, Matrix
    from skyless.planning.maps import PlanMap
    from skyless.planning.mounts import Mounts
    from skyless.planning.optimise import Optimised
    from skyless.planning.predict import PlanSettings, Predictor
    from skyless.planning.verify import Verification
    from skyless.site.model import Site

_Count = Annotated[int, Parameter(validator=Number(gte=1, lte=200))]

app = App(name="plan", help_epilogue="Example: skyless plan hall.toml --method tracker --plot hall.png --target 5")


@app.default
def plan(
    file: Path,
    /,
    *,
    method: str = "tracker",
    noise_ps: Positive | None = None,
    qa: Positive = 0.3,
    range_m: Annotated[Positive | None, Parameter(name="--range")] = None,
    step: Positive | None = None,
    slices: str | None = None,
    region: str | None = None,
    outline: str | None = None,
    target: Positive | None = None,
    plot: Path | None = None,
    grid: Path | None = None,
    html: Path | None = None,
    optimise: Annotated[int, Parameter(validator=Number(gte=3, lte=60))] | None = None,
    out: Path | None = None,
    heights: str | None = None,
    mounts: list[str] | None = None,
    seconds: Positive = 60.0,
    verify: _Count | None = None,
    rounds: Annotated[int, Parameter(validator=Number(gte=100))] = 3000,
    seed: Annotated[int, Parameter(validator=Number(gte=0))] = 1,
    json: bool = False,
) -> None:
    """Predict the errors that tags at rest will have at a site, and where one more anchor would help.

    With --optimise the anchors are placed anew, and the plan is of that site.

    Parameters
    ----------
    file
        The site file.
    method
        literal, literal-delayed, weighted, bracketed or tracker.
    noise_ps
        Noise of every TX and RX stamp in picoseconds; by default the site's own figures.
    qa
        Agility that the tracker assumes, m²/s³.
    range_m
        How far a frame carries in the open, metres: half arrive there; by default what the link budget gives (31 m).
    step
        Spacing of the map's points in metres; by default some ten thousand points.
    slices
        Heights of the tags, h1,h2,... in metres, for sites that estimate the height (3-D); by default three.
    region
        Region of interest, x1,y1,x2,y2 in metres; by default the whole floor.
    outline
        Corners of the floor, "x1,y1 x2,y2 x3,y3 ..." in metres; by default the floor plan, or the box of the anchors.
    target
        Standard deviation to be met, in centimetres.
    plot
        Write the map of the predicted error into this PNG, PDF or SVG.
    grid
        Write every point's predictions into this .csv or .geojson file.
    html
        Write a page with all maps, numbers and warnings into this file; it needs no other file.
    optimise
        Place so many anchors anew, on the walls.
    out
        Write the optimised site into this file, which must not exist.
    heights
        Heights at which anchors may hang, h1,h2,... in metres; by default the lowest and highest of the site's.
    mounts
        A wall on which anchors may hang, x1,y1,x2,y2 in metres; may be given several times; by default the outline.
    seconds
        Time after which the search for places ends in any case.
    verify
        Let tags rest at so many random points of the region in the simulated world, and compare.
    rounds
        Superframes that the comparison lasts.
    seed
        Same seed, same random points and search.
    json
        Write one JSON object instead of the tables.
    """
    from skyless.planning.floor import floor_of
    from skyless.planning.maps import summary_of
    from skyless.planning.predict import Predictor

    started_s = time.perf_counter()
    outputs = {"plot": plot, "grid": grid, "html": html, "out": out}
    site = _load(file, outputs)
    settings = _settings(method, noise_ps, qa, range_m)
    if optimise is None:
        _check_count(site, file)
    if out is not None and optimise is None:
        raise SkylessError("--out writes an optimised site; --optimise N asks for one")
    ground = floor_of(site, file, _outline(outline), _region(region))
    tag_heights = _slices(slices, site)
    hangers = _mounts(site, ground, heights, mounts or [])
    optimised = None
    if optimise is not None:
        optimised = _optimise(site, settings, ground, hangers, tag_heights, (optimise, seed, seconds), target)
        site = optimised.best.site
        if out is not None:
            _write_site(out, site, file)
    predictor = Predictor(site, settings)
    mapped = _map(predictor, ground, tag_heights, step)
    checked = None if verify is None else _verify(predictor, mapped, verify, rounds, seed)
    summary = summary_of(mapped, None if target is None else target / 100.0)
    result = report(predictor, ground, hangers, mapped, summary, optimised, checked)
    _write(file, predictor, ground, mapped, result, plot, grid, html)
    result["wall_s"] = time.perf_counter() - started_s
    if json:
        print_json(result)
    else:
        show(file, result)


def _load(file: Path, outputs: dict[str, Path | None]) -> "Site":
    """Read the site and its image, and see that no output is an input or another output."""
    from skyless.site.load import load_site

    site = load_site(file)
    image = None if site.floor_plan is None else file.parent / site.floor_plan.image
    for name, path in outputs.items():
        spare_inputs(name, path, file, image, *(other for key, other in outputs.items() if key != name))
    if outputs["grid"] is not None and outputs["grid"].suffix.lower() not in {".csv", ".geojson", ".json"}:
        raise SkylessError(f"--grid is {str(outputs['grid'])!r}; it should end with .csv or .geojson")
    if outputs["out"] is not None and outputs["out"].exists():
        raise SkylessError(f"--out is {str(outputs['out'])!r}, which exists; it should be a new file")
    if image is not None:
        _check_image(file, site, image)
    return site


def _check_image(file: Path, site: "Site", image: Path) -> None:
    """See that the whole image can be read, not only its size."""
    from matplotlib.image import imread

    try:
        imread(image)
    except (OSError, SyntaxError, ValueError) as error:
        shown = site.floor_plan.image if site.floor_plan else ""
        right = f"an image that can be read to its end ({' '.join(str(error).split())})"
        raise ConfigurationError(file, "floor_plan.image", shown, right) from None


def _settings(method: str, noise_ps: float | None, qa: float, range_m: float | None) -> "PlanSettings":
    from skyless.planning.links import with_range
    from skyless.planning.predict import PlanSettings
    from skyless.receiver import METHODS
    from skyless.simulation.channel import ChannelModel

    if method not in METHODS:
        raise SkylessError(f"--method is {method!r}; it should be one of {', '.join(METHODS)}")
    channel = ChannelModel() if range_m is None else with_range(ChannelModel(), range_m)
    return PlanSettings(method, noise_ps, qa, channel)


def _check_count(site: "Site", file: Path) -> None:
    needed, what = (4, "with its height") if site.tags.height_m is None else (3, "at a known height")
    if len(site.anchors) < needed:
        right = f"at least {needed}, which a position {what} needs"
        raise ConfigurationError(file, "anchors", f"a list of {len(site.anchors)}", right)


def _outline(text: str | None) -> "Matrix | None":
    import numpy as np

    if text is None:
        return None
    corners = [finite_numbers("outline", part, (2,)) for part in text.replace(";", " ").split()]
    if len(corners) < 3:
        raise SkylessError(f"--outline is {text!r}; it should be three or more corners, 'x1,y1 x2,y2 x3,y3'")
    return np.array(corners)


def _region(text: str | None) -> "Box | None":
    if text is None:
        return None
    x1, y1, x2, y2 = finite_numbers("region", text, (4,))
    if not (x2 > x1 and y2 > y1):
        raise SkylessError(f"--region is {text!r}; it should be x1,y1,x2,y2 with x1 < x2 and y1 < y2")
    return x1, y1, x2, y2


def _numbers(option: str, text: str) -> tuple[float, ...]:
    return finite_numbers(option, text, (text.count(",") + 1,))


def _slices(text: str | None, site: "Site") -> tuple[float, ...]:
    """Heights of the maps: the known one, or those asked for, or three between the lowest and the highest anchor."""
    if site.tags.height_m is not None:
        if text is not None:
            raise SkylessError(f"--slices is {text!r}; this site's tags are all at {site.tags.height_m:g} m")
        return (site.tags.height_m,)
    if text is not None:
        return _numbers("slices", text)
    low, high = _lowest_and_highest(site)
    return tuple(round(low + share * (high - low), 2) for share in (1 / 6, 1 / 2, 5 / 6))[: 3 if high > low else 1]


def _lowest_and_highest(site: "Site") -> tuple[float, float]:
    levels = [anchor.z_m for anchor in site.anchors]
    return min(levels), max(levels)


def _mounts(site: "Site", floor: "Floor", heights: str | None, walls: list[str]) -> "Mounts":
    import numpy as np

    from skyless.planning.floor import sides, total_length
    from skyless.planning.mounts import Mounts

    segments = np.array([finite_numbers("mounts", text, (4,)) for text in walls]) if walls else sides(floor.outline_m)
    if not total_length(segments) > 0.0:
        raise SkylessError("--mounts has no length; it should be x1,y1,x2,y2 with two different ends")
    levels = _numbers("heights", heights) if heights is not None else tuple(dict.fromkeys(_lowest_and_highest(site)))
    return Mounts(segments, levels)


def _optimise(
    site: "Site",
    settings: "PlanSettings",
    floor: "Floor",
    mounts: "Mounts",
    heights_m: tuple[float, ...],
    search: tuple[int, int, float],
    target: float | None,
) -> "Optimised":
    from skyless.planning.optimise import Search

    anchors, seed, seconds = search
    needed = 4 if site.tags.height_m is None else 3
    if anchors < needed:
        raise SkylessError(f"--optimise is {anchors}; this site's positions need {needed} anchors or more")
    with progress_bar("placing anchors", 1.0) as bar:
        found = Search(site, settings, floor, mounts, heights_m, anchors, seed, seconds)
        return found.run(None if target is None else target / 100.0, bar.reach)


def _map(predictor: "Predictor", floor: "Floor", heights_m: tuple[float, ...], step: float | None) -> "PlanMap":
    from skyless.planning.maps import grid_of, plan_map

    try:
        grid = grid_of(floor, heights_m, step)
    except ValueError as error:
        raise SkylessError(f"no map: {error}") from None
    with progress_bar("predicting", 1.0) as bar:
        return plan_map(predictor, grid, bar.reach)


def _verify(predictor: "Predictor", mapped: "PlanMap", count: int, rounds: int, seed: int) -> "Verification":
    """Simulate at random points of the map's region."""
    from skyless.planning.verify import random_points, verify

    with progress_bar("simulating", 1.0) as bar:
        return verify(predictor, random_points(mapped, count, seed), rounds, seed, bar.reach)


def _write_site(out: Path, site: "Site", source: Path) -> None:
    import os

    from skyless.site.check import check_site
    from skyless.site.template import site_template

    if site.floor_plan is not None:
        image = os.path.relpath(source.parent / site.floor_plan.image, out.parent)
        site = msgspec.structs.replace(site, floor_plan=msgspec.structs.replace(site.floor_plan, image=image))
    check_site(site, out)
    _save(out, site_template(site).encode())


def _save(path: Path, data: bytes) -> None:
    try:
        write_atomically(path, data)
    except OSError as error:
        raise SkylessError(f"{path} cannot be written: {error.strerror}") from None


def _write(
    file: Path,
    predictor: "Predictor",
    floor: "Floor",
    mapped: "PlanMap",
    result: dict[str, Any],
    plot: Path | None,
    grid: Path | None,
    html: Path | None,
) -> None:
    """Write the files that were asked for."""
    if grid is not None:
        with open_for_writing(grid) as table:
            table.writelines(_lines(mapped, grid, predictor.site))
    if plot is None and html is None:
        return
    from skyless.cli.plan_output import described, html_page
    from skyless.experiments.figures import save_figure
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


def _lines(mapped: "PlanMap", path: Path, site: "Site") -> Iterator[str]:
    from skyless.planning.tables import csv_lines, geojson_lines

    return csv_lines(mapped) if path.suffix.lower() == ".csv" else geojson_lines(mapped, site.georeference)
