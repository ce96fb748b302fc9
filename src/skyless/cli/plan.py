"""``skyless plan``: what a site will give before anything is mounted, and where its anchors should hang."""

import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

from cyclopts import App, Parameter
from cyclopts.validators import Number

from skyless.arguments import process_noise
from skyless.cli.common.options import (
    Positive,
    Seed,
    check_method,
    check_output,
    check_picture,
    finite_numbers,
    options,
)
from skyless.cli.common.output import print_json
from skyless.cli.common.progress import progress_bar
from skyless.cli.plan_output import show, write_files, write_site
from skyless.cli.plan_slots import conflicts_of, show_slots, write_slots
from skyless.errors import ConfigurationError, SkylessError
from skyless.method_names import DEFAULT_METHOD, Dynamics

if TYPE_CHECKING:
    from skyless.kernels.arrays import Matrix
    from skyless.planning.floor import Floor, Mounts
    from skyless.planning.maps import PlanMap
    from skyless.planning.optimise import Optimised
    from skyless.planning.predict import PlanSettings, Predictor
    from skyless.planning.slot_plan import RateMap
    from skyless.planning.verify import Verification
    from skyless.site.model import Site
    from skyless.site.outline import Box

app = App(name="plan", help_epilogue="Example: skyless plan hall.toml --method joint --plot hall.png --target 5")


@options
class PlanOptions:
    """Options of ``skyless plan``."""

    method: str = DEFAULT_METHOD
    """How positions are computed: literal, literal-delayed, weighted, bracketed or joint."""
    noise_ps: Positive | None = None
    """Noise of every TX and RX stamp in picoseconds; by default the site's own figures."""
    qa: Positive | None = None
    """Process noise that joint assumes: spectral density of the acceleration, m²/s³; by default 0.3."""
    dynamics: Dynamics | None = None
    """How tags move: walk (as people), robot or drone, which sets the process noise instead of --qa."""
    range_m: Annotated[Positive | None, Parameter(name="--range")] = None
    """How far a frame carries in the open, metres: half arrive there; by default what the link budget gives (31 m)."""
    step: Positive | None = None
    """Spacing of the map's points in metres; by default some ten thousand points."""
    slices: str | None = None
    """Heights of the tags, h1,h2,... in metres, for sites that estimate the height (3-D); by default three."""
    region: str | None = None
    """Region of interest, x1,y1,x2,y2 in metres; by default the whole floor."""
    outline: str | None = None
    """Corners of the floor, "x1,y1 x2,y2 x3,y3 ..." in metres; by default the site's outline, the floor plan, or the
    box of the anchors."""
    target: Positive | None = None
    """Standard deviation to be met, in centimetres."""
    plot: Path | None = None
    """Draw the picture into this file (PNG, SVG or PDF): the map of the predicted error."""
    grid: Path | None = None
    """Write every point's predictions into this .csv or .geojson file."""
    html: Path | None = None
    """Write a page with all maps, numbers and warnings into this file; it needs no other file."""
    optimise: Annotated[int, Parameter(validator=Number(gte=3, lte=60))] | None = None
    """Replace the site's anchors by this many, placed on the walls where they serve best."""
    out: Path | None = None
    """Write the result here: the optimised site, into a file that must not exist."""
    heights: str | None = None
    """Heights at which anchors may hang, h1,h2,... in metres; by default the lowest and highest of the site's."""
    mounts: list[str] | None = None
    """A wall on which anchors may hang, x1,y1,x2,y2 in metres; may be given several times; by default the outline."""
    exponent: Annotated[float | None, Parameter(validator=Number(gte=1.5, lte=6.0))] = None
    """Modes slots and free: exponent of the path loss; 2 by default (free space), 2.5 to 3 among metal racks."""
    conflicts: Path | None = None
    """Mode slots: a file with two anchors' identifiers in each line (17,903) that were received at once."""
    write: bool = False
    """Mode slots: write the slots into the site file; everything else in it stays."""
    force: bool = False
    """Overwrite what is there: with --write the slots that the site file has already."""
    search_seconds: Positive = 60.0
    """Time after which the search for positions ends in any case."""
    verify: Annotated[int, Parameter(validator=Number(gte=1, lte=200))] | None = None
    """Let tags rest at this many random points of the region in the simulated world, and compare."""
    rounds: Annotated[int, Parameter(validator=Number(gte=100))] = 3000
    """Superframes that the comparison lasts."""
    seed: Seed = 1
    """Same seed, same random points and search."""
    json: bool = False
    """Write one JSON object instead of the tables."""

    @property
    def target_m(self) -> float | None:
        """The standard deviation to be met in metres."""
        return None if self.target is None else self.target / 100.0


@app.default
def plan(file: Path, /, *, asked: PlanOptions = PlanOptions()) -> None:
    """Predict the errors that tags at rest will have at a site, and where one more anchor would help.

    With --optimise the anchors are placed from the start, and the plan is of that site. At a site in mode slots or free
    the plan is of the slots that anchors share, and of the beacons that reach tags.

    Parameters
    ----------
    file
        The site file.
    """
    from skyless.planning.floor import check_anchor_count, floor_of
    from skyless.planning.maps import summary_of
    from skyless.planning.predict import Predictor
    from skyless.planning.report import plan_report

    started_s = time.perf_counter()
    site = _load(file, asked)
    if not site.schedule.needs_master:
        _plan_slots(site, file, asked, started_s)
        return
    _refuse(asked, _FOR_PROTOCOL_2, "mode master, whose anchors share no slots")
    settings = _settings(asked)
    if asked.optimise is None:
        check_anchor_count(site, file)
        if asked.out is not None:
            raise SkylessError("--out writes an optimised site; --optimise N asks for one")
    floor = floor_of(site, file, _outline(asked.outline), _region(asked.region))
    tag_heights_m = _tag_heights(asked.slices, site)
    mounts = _mounts(site, floor, asked)
    optimised = None
    if asked.optimise is not None:
        optimised = _optimise(site, settings, floor, mounts, tag_heights_m, asked.optimise, asked)
        site = optimised.best.site
        if asked.out is not None:
            write_site(asked.out, site, file)
    predictor = Predictor(site, settings)
    mapped = _map(predictor, floor, tag_heights_m, asked.step)
    checked = None if asked.verify is None else _verify(predictor, mapped, asked.verify, asked)
    result = plan_report(predictor, floor, mounts, mapped, summary_of(mapped, asked.target_m), optimised, checked)
    write_files(file, predictor.site, floor, mapped, result, asked.plot, asked.grid, asked.html)
    result["wall_s"] = time.perf_counter() - started_s
    if asked.json:
        print_json(result)
    else:
        show(file, result)


_FOR_PROTOCOL_2: Final = ("exponent", "conflicts", "write", "force")
_FOR_ONE_MASTER: Final = (
    "method", "noise_ps", "qa", "dynamics", "target", "grid", "html", "optimise", "out", "heights", "mounts",
    "search_seconds", "verify", "rounds", "seed",
)  # fmt: skip


def _refuse(asked: PlanOptions, names: tuple[str, ...], mode: str) -> None:
    """See that options which mean nothing here are not given. Raises SkylessError."""
    plain = PlanOptions()
    for name in names:
        if getattr(asked, name) != getattr(plain, name):
            option = name.replace("_", "-")
            raise SkylessError(f"--{option} is not for this site, which is in {mode}; leave it out")


def _plan_slots(site: "Site", file: Path, asked: PlanOptions, started_s: float) -> None:
    """Plan a site of protocol 2: its slots, and the beacons that reach tags."""
    from skyless.planning.floor import floor_of
    from skyless.planning.links import with_range
    from skyless.planning.slot_plan import rate_map
    from skyless.planning.slot_report import described_slots, slot_report, with_planned_slots
    from skyless.simulation.channel import ChannelModel
    from skyless.site.check import has_slots

    mode = site.schedule.mode
    _refuse(asked, _FOR_ONE_MASTER, f"mode {mode}: errors are predicted for sites with one master only")
    if mode == "free":
        _refuse(asked, ("conflicts", "write", "force"), "mode free, which has no slots")
    if asked.write and not asked.force and has_slots(site):
        raise SkylessError(f"{file} has slots already; --write --force replaces them")
    channel, exponent = ChannelModel(), asked.exponent or 2.0
    if asked.range_m is not None:
        channel = with_range(channel, asked.range_m, exponent)
    recoloured, had_slots = None, has_slots(site)
    if mode == "slots":
        site, recoloured = with_planned_slots(site, file, conflicts_of(asked.conflicts, site), asked.write)
    floor = floor_of(site, file, _outline(asked.outline), _region(asked.region)) if site.anchors else None
    mapped = None
    if floor is not None:
        try:
            mapped = rate_map(site, floor, _tag_heights(asked.slices, site), asked.step, channel, exponent)
        except ValueError as error:
            raise SkylessError(f"no map: {error}") from None
    elif asked.plot is not None:
        raise SkylessError("--plot needs anchors with positions, and this site has none")
    if asked.write:
        write_slots(site, file)
    result = slot_report(site, floor, mapped, channel, exponent, recoloured, asked.write)
    if recoloured is not None and not asked.write:
        how = "--write --force writes" if had_slots else "--write writes"
        result["warnings"].append(f"these slots are not in the site file ({recoloured}); {how} them into it")
    if asked.plot is not None and floor is not None and mapped is not None:
        _draw_slots(site, floor, mapped, file, described_slots(result), asked.plot)
    result["wall_s"] = time.perf_counter() - started_s
    if asked.json:
        print_json(result)
    else:
        show_slots(file, result)


def _draw_slots(site: "Site", floor: "Floor", mapped: "RateMap", file: Path, title: str, plot: Path) -> None:
    """Write the picture. Raises SkylessError when it cannot be written."""
    from skyless.evaluation.figures import save_figure
    from skyless.planning.slot_picture import draw_slots

    try:
        save_figure(draw_slots(site, floor, mapped, file, title), plot)
    except (OSError, ValueError) as error:
        raise SkylessError(f"{plot} cannot be written: {error}") from None


# From files and texts to values


def _load(file: Path, asked: PlanOptions) -> "Site":
    """Read the site and its image, and see that no output is an input or another output. Raises SkylessError."""
    from skyless.site.load import load_site

    site = load_site(file, slots_given=False)
    image = None if site.floor_plan is None else file.parent / site.floor_plan.image
    for name, path in (("plot", asked.plot), ("grid", asked.grid), ("html", asked.html), ("out", asked.out)):
        check_output(name, path, asked.conflicts)
    check_picture(asked.plot)
    outputs = {"plot": asked.plot, "grid": asked.grid, "html": asked.html, "out": asked.out}
    for name, path in outputs.items():
        check_output(name, path, file, image, *(other for key, other in outputs.items() if key != name))
    if asked.grid is not None and asked.grid.suffix.lower() not in {".csv", ".geojson", ".json"}:
        raise SkylessError(f"--grid is {str(asked.grid)!r}; it should end with .csv or .geojson")
    if asked.out is not None and asked.out.exists():
        raise SkylessError(f"--out is {str(asked.out)!r}, which exists; it should be a new file")
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


def _settings(asked: PlanOptions) -> "PlanSettings":
    """How tags compute, and how far a frame carries. Raises SkylessError."""
    from skyless.planning.links import with_range
    from skyless.planning.predict import PlanSettings
    from skyless.simulation.channel import ChannelModel

    check_method(asked.method)
    channel = ChannelModel() if asked.range_m is None else with_range(ChannelModel(), asked.range_m)
    return PlanSettings(asked.method, asked.noise_ps, process_noise(asked.qa, asked.dynamics) or 0.3, channel)


def _outline(text: str | None) -> "Matrix | None":
    """Corners of the floor, shape (n, 2) in metres, None if not asked for. Raises SkylessError."""
    import numpy as np

    if text is None:
        return None
    corners = [finite_numbers("outline", part, (2,)) for part in text.replace(";", " ").split()]
    if len(corners) < 3:
        raise SkylessError(f"--outline is {text!r}; it should be three or more corners, 'x1,y1 x2,y2 x3,y3'")
    return np.array(corners)


def _region(text: str | None) -> "Box | None":
    """The region of interest in metres, None if not asked for. Raises SkylessError."""
    if text is None:
        return None
    x1, y1, x2, y2 = finite_numbers("region", text, (4,))
    if not (x2 > x1 and y2 > y1):
        raise SkylessError(f"--region is {text!r}; it should be x1,y1,x2,y2 with x1 < x2 and y1 < y2")
    return x1, y1, x2, y2


def _tag_heights(text: str | None, site: "Site") -> tuple[float, ...]:
    """Heights of the maps. Raises SkylessError when heights are asked for at a site that knows its tags' height."""
    from skyless.planning.floor import usual_tag_heights

    if text is None:
        return usual_tag_heights(site)
    if site.tags.height_m is not None:
        raise SkylessError(f"--slices is {text!r}; this site's tags are all at {site.tags.height_m:g} m")
    return _numbers("slices", text)


def _mounts(site: "Site", floor: "Floor", asked: PlanOptions) -> "Mounts":
    """Where anchors may hang: on the walls given, or on the floor's sides. Raises SkylessError."""
    import numpy as np

    from skyless.planning.floor import mounts_of

    walls = [finite_numbers("mounts", text, (4,)) for text in asked.mounts or ()]
    heights_m = None if asked.heights is None else _numbers("heights", asked.heights)
    mounts = mounts_of(site, floor, np.array(walls) if walls else None, heights_m)
    if not mounts.length_m > 0.0:
        raise SkylessError("--mounts has no length; it should be x1,y1,x2,y2 with two different ends")
    return mounts


def _numbers(option: str, text: str) -> tuple[float, ...]:
    return finite_numbers(option, text, (text.count(",") + 1,))


# The long work, with progress


def _optimise(
    site: "Site",
    settings: "PlanSettings",
    floor: "Floor",
    mounts: "Mounts",
    heights_m: tuple[float, ...],
    anchors: int,
    asked: PlanOptions,
) -> "Optimised":
    from skyless.planning.floor import fewest_anchors
    from skyless.planning.optimise import Search

    needed = fewest_anchors(site)
    if anchors < needed:
        raise SkylessError(f"--optimise is {anchors}; this site's positions need {needed} anchors or more")
    with progress_bar("placing anchors", 1.0) as bar:
        found = Search(site, settings, floor, mounts, heights_m, anchors, asked.seed, asked.search_seconds)
        return found.run(asked.target_m, bar.reach)


def _map(predictor: "Predictor", floor: "Floor", heights_m: tuple[float, ...], step: float | None) -> "PlanMap":
    from skyless.planning.maps import grid_of, plan_map

    try:
        grid = grid_of(floor, heights_m, step)
    except ValueError as error:
        raise SkylessError(f"no map: {error}") from None
    with progress_bar("predicting", 1.0) as bar:
        return plan_map(predictor, grid, bar.reach)


def _verify(predictor: "Predictor", mapped: "PlanMap", count: int, asked: PlanOptions) -> "Verification":
    """Simulate at random points of the map's region."""
    from skyless.planning.verify import random_points, verify

    with progress_bar("simulating", 1.0) as bar:
        return verify(predictor, random_points(mapped, count, asked.seed), asked.rounds, asked.seed, bar.reach)
