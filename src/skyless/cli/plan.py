"""``skyless plan``: what a site will give before anything is mounted, and where its anchors should hang."""

import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import App, Parameter
from cyclopts.validators import Number

from skyless.cli.common.options import Positive
from skyless.cli.common.output import print_json
from skyless.cli.common.progress import progress_bar
from skyless.cli.plan_files import write_files, write_site
from skyless.cli.plan_input import (
    check_count,
    load_inputs,
    mounts_of,
    outline_of,
    region_of,
    settings_of,
    tag_heights_of,
)
from skyless.cli.plan_output import report, show
from skyless.errors import SkylessError
from skyless.method_names import DEFAULT_METHOD

if TYPE_CHECKING:
    from skyless.planning.floor import Floor
    from skyless.planning.maps import PlanMap
    from skyless.planning.mounts import Mounts
    from skyless.planning.optimise import Optimised
    from skyless.planning.predict import PlanSettings, Predictor
    from skyless.planning.verify import Verification
    from skyless.site.model import Site

_Count = Annotated[int, Parameter(validator=Number(gte=1, lte=200))]

app = App(name="plan", help_epilogue="Example: skyless plan hall.toml --method joint --plot hall.png --target 5")


@app.default
def plan(
    file: Path,
    /,
    *,
    method: str = DEFAULT_METHOD,
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
        literal, literal-delayed, weighted, bracketed or joint.
    noise_ps
        Noise of every TX and RX stamp in picoseconds; by default the site's own figures.
    qa
        Agility that joint assumes, m²/s³.
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
    site = load_inputs(file, outputs)
    settings = settings_of(method, noise_ps, qa, range_m)
    if optimise is None:
        check_count(site, file)
    if out is not None and optimise is None:
        raise SkylessError("--out writes an optimised site; --optimise N asks for one")
    ground = floor_of(site, file, outline_of(outline), region_of(region))
    tag_heights = tag_heights_of(slices, site)
    hangers = mounts_of(site, ground, heights, mounts or [])
    optimised = None
    if optimise is not None:
        optimised = _optimise(site, settings, ground, hangers, tag_heights, (optimise, seed, seconds), target)
        site = optimised.best.site
        if out is not None:
            write_site(out, site, file)
    predictor = Predictor(site, settings)
    mapped = _map(predictor, ground, tag_heights, step)
    checked = None if verify is None else _verify(predictor, mapped, verify, rounds, seed)
    summary = summary_of(mapped, None if target is None else target / 100.0)
    result = report(predictor, ground, hangers, mapped, summary, optimised, checked)
    write_files(file, predictor, ground, mapped, result, plot, grid, html)
    result["wall_s"] = time.perf_counter() - started_s
    if json:
        print_json(result)
    else:
        show(file, result)


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
