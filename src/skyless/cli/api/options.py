"""Options of simulations, plans and studies, for the commands and as arguments of the Python functions."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from skyless.arguments import (
    ComputedOptions,
    Method,
    Option,
    Picoseconds,
    Positive,
    Rule,
    Seed,
    Text,
    check_choice,
    check_point,
    choice,
    folder_to_write,
    number,
    numbers,
    points,
    read_list,
    read_numbers,
    read_points,
    sequence,
    whole,
    wrong,
)
from skyless.core.errors import SkylessError
from skyless.core.method_names import DEFAULT_METHOD
from skyless.research.replays.options import EstimatorClass
from skyless.sim.evaluation.request import Conditions, IntegrityRisk, ProtectionOptions

if TYPE_CHECKING:
    from skyless.core.site import Site

_USUAL_DURATION_S = 60.0
"""Duration of a simulation without a goal."""


class SimulateOptions(Conditions, frozen=True, kw_only=True):
    """Options of ``skyless simulate``."""

    scenario: Annotated[str | None, choice("lab", "room", "paper")] = None
    """A named site: lab (six anchors on the walls of 6 m × 8 m, 2-D), the default; room (the lab as real rooms are:
    anchors 2 cm off per axis, ranges 5 cm off, and more with the distance, tags with random acceleration); paper (the
    lab with the paper's protocol: a master, and slots), the default of the paper's four methods."""
    site: Annotated["Site | str | Path | None", Path] = None
    """Site file instead of a named site; in Python also a site. Positions of anchors and ranges are wrong by chance, as
    its accuracy states; all its deviations 0: exact."""
    estimator: EstimatorClass = None
    """Your own estimator instead of the method, a class with hear(observation): each tag makes one, and gives it one
    time difference after the other."""
    duration_s: Annotated[Positive | None, Option("duration")] = None
    """Seconds to simulate; by default 60 unless --fixes is given."""

    @property
    def until_s(self) -> float:
        """Latest end of the run; infinite if only the number of fixes ends it."""
        return self.duration_s or (_USUAL_DURATION_S if self.fixes is None else math.inf)

    def check(self) -> None:
        """Check that the options are compatible. Raises SkylessError."""
        Conditions.check(self)
        if self.estimator is not None:
            names = "method", "silences", *ProtectionOptions.__struct_fields__
            self.leave_out(*(name for name in names if name != "progress"), why="the estimator is your own")
        if self.site is not None and self.scenario is not None:
            raise SkylessError("give either --scenario or --site, not both")
        if self.positions_m and not self.paths_m and (self.tags is not None or self.speed_mps is not None):
            raise SkylessError(
                "--position is for tags that lie still, --tags and --speed for tags that walk; give either"
            )
        if self.paths_m and self.tags is not None:
            raise SkylessError("--waypoints has a path for each tag, --tags a number of tags that walk; give either")
        if self.scenario == "room" and self.speed_mps is not None and not self.paths_m:
            raise SkylessError(
                "--speed is for tags that walk from point to point; those of --scenario room accelerate at random, "
                "or give --waypoints"
            )
        if self.settle_s >= self.until_s:
            raise SkylessError(
                f"--settle is {self.settle_s:g}; it should be less than --duration, which is {self.until_s:g}: no fix "
                "would be judged"
            )


def _check_heights(name: str, value: object) -> tuple[float, ...]:
    heights_m = sequence(name, value, "heights in metres")
    return check_point(name, heights_m, (max(len(heights_m), 1),))


def _check_region(name: str, value: object) -> tuple[float, ...]:
    x1, y1, x2, y2 = check_point(name, value, (4,))
    if not (x2 > x1 and y2 > y1):
        raise wrong(name, value, "x1,y1,x2,y2 with x1 < x2 and y1 < y2")
    return x1, y1, x2, y2


def _check_outline(name: str, value: "Sequence[Sequence[float]]") -> "Sequence[Sequence[float]]":
    if len(value) < 3:
        raise wrong(name, value, "three or more corners, 'x1,y1 x2,y2 x3,y3'")
    return value


def _check_mounts(name: str, value: "Sequence[Sequence[float]]") -> "Sequence[Sequence[float]]":
    if not any(wall[:2] != wall[2:] for wall in value):
        raise wrong(name, value, "walls, x1,y1,x2,y2 each, with two different ends")
    return value


_Heights = Annotated["Sequence[float]", Text(read_list, "h1,h2,..."), Rule(_check_heights)]


class _Planned(ComputedOptions, frozen=True):
    site: Annotated["Site | str | Path", Path]
    """The site file; in Python also a site."""


class PlanOptions(_Planned, frozen=True, kw_only=True):
    """Options of ``skyless plan``."""

    noise_ps: Picoseconds | None = None
    """Noise of every TX and RX stamp in picoseconds; by default the site's own figures."""
    range_m: Annotated[Positive | None, Option("range")] = None
    """How far a frame carries in the open, metres: half arrive there; by default what the link budget gives (31 m)."""
    step_m: Annotated[Positive | None, Option("step")] = None
    """Spacing of the map's points in metres; by default some ten thousand points."""
    tag_heights_m: Annotated[_Heights | None, Option("slices")] = None
    """Heights of the tags in metres, for sites that estimate the height (3-D); by default three."""
    region_m: Annotated[
        "Sequence[float] | None", Option("region"), numbers(4, form="x1,y1,x2,y2"), Rule(_check_region)
    ] = None
    """Region of interest, x1, y1, x2, y2 in metres; by default the whole floor."""
    outline_m: Annotated[
        "Sequence[Sequence[float]] | None",
        Option("outline"),
        Text(lambda name, text: read_points(name, text, (2,)), '"x1,y1 x2,y2 x3,y3 ..."'),
        points(2, form="three or more corners, (x, y)"),
        Rule(_check_outline),
    ] = None
    """Corners of the floor in metres; by default the site's outline, the floor plan, or the box of the anchors."""
    target_m: Annotated[
        float | None,
        Option("target"),
        Text(lambda name, text: read_numbers(name, text, (1,))[0] / 100.0, "CENTIMETRES"),
        number(above=0.0),
    ] = None
    """Standard deviation to be met; in centimetres, in Python in metres."""
    optimise: Annotated[int | None, whole(3, 60)] = None
    """Replace the site's anchors by this many, placed on the walls where they serve best."""
    anchor_heights_m: Annotated[_Heights | None, Option("heights")] = None
    """Heights at which anchors may hang, in metres; by default the lowest and highest of the site's."""
    mounts_m: Annotated[
        "Sequence[Sequence[float]] | None",
        Option("mounts"),
        numbers(4, form="x1,y1,x2,y2", many=True),
        points(4, form="walls, (x1, y1, x2, y2)"),
        Rule(_check_mounts),
    ] = None
    """Walls on which anchors may hang, x1, y1, x2, y2 in metres each; by default the outline."""
    exponent: Annotated[float | None, number(least=1.5, most=6.0)] = None
    """Exponent of the path loss at sites of more than 60 anchors: 2 by default (free space), 2.5 to 3 among racks."""
    search_s: Annotated[Positive, Option("search-seconds")] = 60.0
    """Time after which the search for positions ends in any case, in seconds."""
    verify_points: Annotated[int | None, Option("verify"), whole(1, 200)] = None
    """Let tags rest at this many random points of the region in the simulated world, and compare."""
    verify_rounds: Annotated[int, Option("rounds"), whole(100)] = 3000
    """Superframes that the comparison lasts."""
    seed: Seed = 1
    """Same seed, same random points and search."""


def _check_study(name: str, value: str) -> Any:  # noqa: ANN401 - the name
    from skyless.research.studies.run import STUDIES

    return check_choice(name, value, tuple(STUDIES))


def _check_conditions(name: str, value: str) -> Any:  # noqa: ANN401 - the conditions
    from skyless.research.studies.room import CONDITIONS

    return check_choice(name, value, tuple(CONDITIONS))


class _Studied(ComputedOptions, frozen=True):
    name: Annotated[str, Rule(_check_study)]
    """efficiency: RMSE over the Cramér–Rao bound. integrity: protection levels with a faulty anchor. room: the errors
    of real rooms, and what goes wrong in them. large: 1,024 anchors without a master. survey: anchors that survey
    themselves. survey-room: tags in rooms whose site files a survey wrote. watch: anchors that have moved."""


class StudyOptions(_Studied, frozen=True, kw_only=True):
    """Options of ``skyless study``."""

    method: Method = DEFAULT_METHOD
    """How positions are computed; by default the best method."""
    seed: Seed = 1
    """Same seed, same rows, except CPU times."""
    episodes: Annotated[int | None, whole(1, 10**6)] = None
    """Episodes of two seconds for each case (efficiency, integrity)."""
    conditions: Annotated[str, Rule(_check_conditions)] = "usual"
    """Cases of room: usual, as in real rooms; or loss: lost messages; nlos: late ones; motion: speed and turns;
    sync: masters that die, superframes, crystals; phase: phases of the carrier; scale: numbers of tags and anchors."""
    worlds: Annotated[int | None, whole(2, 10**5)] = None
    """Independent worlds for each case (all others, but for the tags of scale; room: a quarter but for its first)."""
    seconds: Annotated[float | None, number(least=1.0, most=1e6)] = None
    """Simulated seconds for which each world is judged."""
    noise_ps: Picoseconds | None = None
    """Noise of every TX and RX stamp in picoseconds, known to the filters; by default 100."""
    integrity_risk: IntegrityRisk | None = None
    """Probability, for each fix, that the error exceeds its protection level (integrity); 1e-4 by default."""
    alert_limit_m: Positive | None = None
    """Fixes whose protection level exceeds this, in metres, count as not available (integrity)."""
    quick: bool = False
    """Compute a fraction, with more scatter."""
    processes: Annotated[int | None, whole(1, 1024)] = None
    """Processes on this machine; by default one for each core. 1 is this process."""
    resume: Annotated[str | Path | None, Path, Rule(folder_to_write)] = None
    """Keep each finished part in this folder, and compute only parts that are not there."""

    def check(self) -> None:
        """Check that the options are compatible. Raises SkylessError."""
        from skyless.research.studies.run import OF_EPISODES

        if self.name != "integrity":
            self.leave_out("integrity_risk", "alert_limit_m", why="it is for the study integrity")
        if self.name != "room":
            self.leave_out("conditions", why="it is for the study room")
        if self.name not in OF_EPISODES:
            why = f"it is for the studies efficiency and integrity; {self.name} takes --worlds and --seconds"
            self.leave_out("episodes", why=why)
        elif self.name == "integrity":
            self.leave_out("worlds", "seconds", why="the study integrity takes --episodes")
        else:
            why = "the study efficiency has cases of its own, and takes --episodes"
            self.leave_out("worlds", "seconds", "noise_ps", why=why)
