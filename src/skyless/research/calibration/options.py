"""Options of ``skyless survey`` and ``skyless calibrate``, and the facts that follow for the survey."""

import re
from collections.abc import Iterable, Mapping, Sequence
from math import inf
from pathlib import Path
from typing import Annotated, Any, Final

from msgspec import Struct
from msgspec.structs import replace

from skyless.arguments import (
    ComputedOptions,
    Option,
    Rule,
    Text,
    check_number,
    check_point,
    existing_file,
    number,
    read_numbers,
    sequence,
    wrong,
)
from skyless.core.air.site_pages import MAX_COORDINATE_M
from skyless.core.errors import ConfigurationError, SkylessError
from skyless.core.site import Site
from skyless.research.replays.options import RecordingOptions
from skyless.sim.evaluation.scenarios import position_stds_m
from skyless.site.anchor_names import read_anchor
from skyless.site.survey.facts import Facts, Gauge, Point, TagReceived, Tape
from skyless.site.tables import read_heights

_MAX_STD_M: Final = 100.0
_Std = Annotated[float, number(above=0.0, most=_MAX_STD_M)]
_StdOrZero = Annotated[float, number(least=0.0, most=_MAX_STD_M)]
_TAPE: Final = re.compile(r"(?P<a>\w+)-(?P<b>\w+)=(?P<distance>[^±+]+)((±|\+-)(?P<std>.+))?")


class Stay(Struct, frozen=True):
    """A tag at rest at a known position."""

    x_m: float
    y_m: float
    z_m: float | None = None
    """None for the height of the site's tags."""
    from_s: float = -inf
    """Time since the first difference."""
    to_s: float = inf


class Walk(Struct, frozen=True):
    """A tag that was carried around, with the times in seconds since its first reception."""

    tag: str
    from_s: float = 0.0
    to_s: float = inf
    height_m: float | None = None
    """Height at which it was carried, within some 0.1 m. None if free."""


class First(Struct, frozen=True):
    """Limit to the beginning of a recording: a number of differences, of seconds, or a share of its time."""

    count: int | None = None
    seconds: float | None = None
    part: float | None = None


def _metres(name: str, text: str, counts: tuple[int, ...], part: str | None = None) -> tuple[float, ...]:
    """Parse coordinates or lengths within the range of the almanac. Raises SkylessError."""
    values = read_numbers(name, text, counts, part=part)
    if any(abs(one) > MAX_COORDINATE_M for one in values):
        raise SkylessError(f"{name} is {text!r}; it should be metres, at most {MAX_COORDINATE_M:g}")
    return values


def _anchor(name: str, text: str, part: str) -> int:
    """Parse an anchor's identifier in ``part`` of a text. Raises SkylessError."""
    try:
        return read_anchor(part.strip())
    except ValueError:
        raise SkylessError(f"{name} is {text!r}; {part!r} should be the identifier of an anchor") from None


def _read_height(name: str, text: str) -> tuple[int | None, float | Path]:
    anchor, mark, value = text.rpartition("=")
    try:
        float(value)
    except ValueError:
        if not mark:
            return None, existing_file(name, text)
    (z_m,) = _metres(name, text, (1,), value)
    return (_anchor(name, text, anchor) if mark else None), z_m


def _check_heights(name: str, given: Any) -> dict[int | None, float | Path]:  # noqa: ANN401 - what a user gives
    if isinstance(given, float | int | str | Path):
        given = {None: given}
    heights: dict[int | None, float | Path] = {}
    for anchor, one in given.items() if isinstance(given, Mapping) else given:
        if anchor in heights:
            which = "all anchors" if anchor is None else f"anchor {anchor}"
            raise SkylessError(f"{name} is given twice; the height of {which} should be given once")
        if anchor is None and isinstance(one, str | Path):
            heights[None] = existing_file(name, one)
        else:
            heights[anchor] = check_number(f"{name}[{anchor}]", one, least=-MAX_COORDINATE_M, most=MAX_COORDINATE_M)
    return heights


def _read_tape(name: str, text: str) -> Tape:
    match = _TAPE.fullmatch(text)
    if match is None:
        raise SkylessError(f"{name} is {text!r}; it should be like 1-4=7.21 or 1-4=7.21±0.01")
    a, b = (_anchor(name, text, match[end]) for end in ("a", "b"))
    (distance_m,) = _metres(name, text, (1,), match["distance"])
    tape = Tape(a, b, distance_m)
    return tape if match["std"] is None else Tape(a, b, distance_m, *_metres(name, text, (1,), match["std"]))


def _check_tapes(name: str, given: Any) -> tuple[Tape, ...]:  # noqa: ANN401 - what a user gives
    tapes = sequence(name, given, "values of skyless.site.survey.facts.Tape")
    pairs = set()
    for index, tape in enumerate(tapes):
        if not isinstance(tape, Tape):
            raise wrong(f"{name}[{index}]", tape, "a skyless.site.survey.facts.Tape")
        shown = f"{tape.a}-{tape.b}={tape.distance_m:g}±{tape.std_m:g}"
        if tape.a == tape.b or not (tape.distance_m > 0.0 and 0.0 <= tape.std_m <= _MAX_STD_M):
            raise SkylessError(f"{name} is {shown!r}; it should be a positive distance between two anchors")
        if frozenset((tape.a, tape.b)) in pairs:
            raise SkylessError(f"{name} is {shown!r}; that between {tape.a} and {tape.b} should be given once")
        pairs.add(frozenset((tape.a, tape.b)))
    return tapes


def _read_point(name: str, text: str) -> tuple[int, tuple[float, ...]]:
    anchor, _, position = text.partition("=")
    position_m = _metres(name, text, (2, 3), position)
    return _anchor(name, text, anchor), position_m


def _check_points(name: str, given: Any) -> dict[int, tuple[float, ...]]:  # noqa: ANN401 - what a user gives
    points: dict[int, tuple[float, ...]] = {}
    for anchor, position_m in given.items() if isinstance(given, Mapping) else given:
        if anchor in points:
            raise SkylessError(f"{name} is given twice; the position of anchor {anchor} should be given once")
        points[anchor] = check_point(f"{name}[{anchor}]", position_m, (2, 3), MAX_COORDINATE_M)
    return points


def _read_stay(name: str, text: str) -> Stay:
    position, mark, span = text.partition("@")
    x_m, y_m, *z_m = _metres(name, text, (2, 3), position)
    times_s = _read_span(name, text, span) if mark else (-inf, inf)
    return Stay(x_m, y_m, z_m[0] if z_m else None, *times_s)


def _read_span(name: str, text: str, span: str) -> tuple[float, float]:
    from_s, to_s = read_numbers(name, text, (2,), ":", part=span)
    if not 0.0 <= from_s < to_s:
        raise SkylessError(f"{name} is {text!r}; what follows @ should be two times in seconds, the later one last")
    return from_s, to_s


def _check_stays(name: str, given: Any) -> tuple[Stay, ...]:  # noqa: ANN401 - what a user gives
    stays = []
    for index, one in enumerate(sequence(name, given, "points, x,y or x,y,z in metres each")):
        of_one = f"{name}[{index}]"
        stay = one if isinstance(one, Stay) else Stay(*check_point(of_one, one, (2, 3)))
        check_point(of_one, (stay.x_m, stay.y_m, *(() if stay.z_m is None else (stay.z_m,))), (2, 3))
        if not stay.from_s < stay.to_s:
            raise wrong(f"{of_one}.to_s", stay.to_s, f"above from_s, which is {stay.from_s:g}")
        stays.append(stay)
    for stay in stays[:-1]:
        if stay.to_s == inf:
            shown = f"{stay.x_m:g},{stay.y_m:g}"
            raise SkylessError(f"{name} is {shown!r}; before another {name} it should have its times, @FROM:TO")
    return tuple(stays)


def _read_walk(name: str, text: str) -> Walk:
    walked, mark, span = text.partition("@")
    tag, of_height, height = walked.partition("=")
    height_m = _metres(name, text, (1,), height)[0] if of_height else None
    return Walk(tag, *(_read_span(name, text, span) if mark else (0.0, inf)), height_m)


def _read_axes(name: str, text: str) -> tuple[int, ...]:
    return tuple(_anchor(name, text, part) for part in text.split(","))


def _check_axes(name: str, given: Any) -> Gauge:  # noqa: ANN401 - what a user gives
    if isinstance(given, Gauge):
        return given
    anchors = sequence(name, given, "anchors")
    if len(anchors) not in (2, 3) or len(set(anchors)) < len(anchors):
        raise wrong(name, ",".join(map(str, anchors)), "two or three different anchors")
    return Gauge(*anchors)


def _check_walks(name: str, given: Any) -> tuple[Walk, ...]:  # noqa: ANN401 - what a user gives
    walks: list[Walk] = []
    for one in sequence(name, given, "names of tags"):
        walk = Walk(one) if isinstance(one, str) else one
        if any(walk.tag == other.tag and walk.from_s < other.to_s and other.from_s < walk.to_s for other in walks):
            span = "" if (walk.from_s, walk.to_s) == (0.0, inf) else f"@{walk.from_s:g}:{walk.to_s:g}"
            raise SkylessError(f"{name} is '{walk.tag}{span}'; a walk of {walk.tag} given before covers the same time")
        walks.append(walk)
    return tuple(walks)


def _check_first(name: str, text: Any) -> First:  # noqa: ANN401 - what a user gives
    if isinstance(text, First):
        return text
    digits = str(text).rstrip("s%")
    unit = str(text)[len(digits) :]
    try:
        value = float(digits)
    except ValueError:
        value = 0.0
    if 0.0 < value < 1e12:
        if unit == "s":
            return First(seconds=value)
        if unit == "%" and value <= 100.0:
            return First(part=value / 100.0)
        if unit == "" and value == int(value):
            return First(count=int(value))
    raise wrong(name, text, "a number of differences, seconds (60s) or a part (50%)")


class SurveyOptions(ComputedOptions, frozen=True, kw_only=True):
    """Options of ``skyless survey``."""

    recording: Annotated["str | Path | None", Path, Rule(existing_file)] = None
    """The recording, plain or gzip: of skyless record, or of another system; or a table of ranges:
    anchor_a,anchor_b,range_m, each pair any number of times."""
    walks: Annotated[
        Sequence[str | Walk],
        Option("walk"),
        Text(_read_walk, "TAG, TAG=HEIGHT or TAG=HEIGHT@FROM:TO", many=True),
        Rule(_check_walks),
    ] = ()
    """A tag of the recording that was carried around, if known at which height in metres (within some 0.1 m), and when
    in seconds since its first reception. Used only where it fits the ranges."""
    site: Annotated["Site | str | Path | None", Path] = None
    """Site file of the present: its anchors, heights, and rough positions; in Python also a site."""
    keep_positions: bool = False
    """Keep the positions of --site, or of the recording, and find delays only."""
    anchor_height_m: Annotated[
        "float | Mapping[int | None, float] | str | Path | None",
        Option("anchor-height"),
        Text(_read_height, "METRES, ANCHOR=METRES or TABLE", many=True),
        Rule(_check_heights),
    ] = None
    """Height of all anchors, or of one, or a table of heights: id,z_m; in Python a number, heights by anchor, or a
    table."""
    anchor_height_std_m: Annotated[_Std | None, Option("anchor-height-std")] = None
    """Estimate heights, too; those given are known this well, metres. Without it they are exact."""
    distances: Annotated[
        Sequence[Tape], Option("distance"), Text(_read_tape, "1-4=7.21 or 1-4=7.21±0.01", many=True), Rule(_check_tapes)
    ] = ()
    """A distance between two anchors by tape or laser, metres; ±0.005 by default."""
    points_m: Annotated[
        Mapping[int, Sequence[float]],
        Option("point"),
        Text(_read_point, "3=0,4 or 3=0,4,2.5", many=True),
        Rule(_check_points),
    ] = {}
    """An anchor whose position is known, metres."""
    delay_std_m: Annotated[_StdOrZero | None, Option("delay-std")] = None
    """How much antenna delays are expected to be off, each for itself, metres; 0.07 by default, 0.03 for recordings of
    other systems; 0: they are right, and not estimated."""
    pair_std_m: Annotated[_StdOrZero | None, Option("pair-std")] = None
    """Constant error expected of each pair's range, metres; 0.03 by default."""
    axes: Annotated[Gauge | Sequence[int] | None, Text(_read_axes, "ORIGIN,X or ORIGIN,X,LEFT"), Rule(_check_axes)] = (
        None
    )
    """The anchor at (0, 0), one on the positive x axis, best the farthest, and one on the left of it (y > 0) where the
    side is not known otherwise."""

    def check(self) -> None:
        """Check that the options are compatible. Raises SkylessError."""
        if self.recording is None:
            self.leave_out("walks", why="it is for recordings")
        if self.keep_positions and self.delay_std_m == 0.0:
            raise SkylessError("--keep-positions finds delays, and --delay-std 0 says that they are known; give either")


class CalibrateOptions(RecordingOptions, frozen=True, kw_only=True):
    """Options of ``skyless calibrate``."""

    site: Annotated["Site | str | Path | None", Path] = None
    """Site file of the present, whose positions are kept; in Python also a site."""
    stays: Annotated[
        Sequence[Stay | Sequence[float]],
        Option("at"),
        Text(_read_stay, "x,y,z or x,y,z@FROM:TO", many=True),
        Rule(_check_stays),
    ] = ()
    """Where the tag stood still, in metres, x,y where the site knows its tags' height; its times in seconds since the
    beginning, for several positions."""
    recorded_truth: bool = False
    """Use where a simulated site's recording says its tags were, as --truth."""
    first: Annotated[str | None, Rule(_check_first)] = None
    """Use only the beginning at known positions: a number of differences (30), seconds (60s) or a part (50%)."""

    def check(self) -> None:
        """Check that the options are compatible. Raises SkylessError."""
        if self.stays and (self.truth is not None or self.recorded_truth or self.lever_arm_m is not None):
            raise SkylessError("--at says where the antenna was; it should be given without --truth and --lever-arm")


_FOREIGN_DELAY_STD_M: Final = 0.03
_FOREIGN_COMMON_DELAY_STD_M: Final = 1.0
"""For recordings of other systems: uncalibrated boards of one kind are nearly alike, but their common delay is
unknown."""

_UNCALIBRATED_DELAY_STD_M: Final = 0.15
"""Expected delay error of boards that were never calibrated."""


def facts_of(asked: SurveyOptions, anchors: Iterable[int], site: Site | None, *, is_foreign: bool = False) -> Facts:
    """The facts for a survey. Raises SkylessError.

    ``site``: of --site or of the recording. ``is_foreign``: the ranges are from a recording of another system.
    """
    known, keep = set(anchors), asked.keep_positions
    if keep and (site is None or not site.anchors):
        raise SkylessError("--keep-positions needs positions to keep; --site should be a file that has them")
    _require_known("--distance", (anchor for tape in asked.distances for anchor in (tape.a, tape.b)), known)
    points: dict[int, Point] = {}
    for anchor, (x_m, y_m, *z_m) in asked.points_m.items():
        points[anchor] = (x_m, y_m, z_m[0] if z_m else None)
    _require_known("--point", points, known)
    gauge = asked.axes if isinstance(asked.axes, Gauge) else None
    if gauge is not None:
        _require_known("--axes", (one for one in (gauge.origin, gauge.x_axis, gauge.left) if one is not None), known)
    given = _heights(asked, known) | {anchor: point[2] for anchor, point in points.items() if point[2] is not None}
    if asked.anchor_height_std_m is None and site is not None:
        given = {anchor.id: anchor.z_m for anchor in site.anchors} | given
    usual = Facts()
    if is_foreign:
        usual = replace(usual, delay_std_m=_FOREIGN_DELAY_STD_M, common_delay_std_m=_FOREIGN_COMMON_DELAY_STD_M)
    return replace(
        usual,
        dimensions=2 if asked.anchor_height_std_m is None else 3,
        heights_m=given,
        height_std_m=asked.anchor_height_std_m or usual.height_std_m,
        tapes=tuple(asked.distances),
        points=points,
        sketch_m=_sketch_m(site),
        sketch_std_m=_stated_std_m(site) if site is not None and keep else usual.sketch_std_m,
        keep_positions=keep,
        delay_std_m=usual.delay_std_m if asked.delay_std_m is None else asked.delay_std_m,
        pair_std_m=usual.pair_std_m if asked.pair_std_m is None else asked.pair_std_m,
        gauge=gauge,
    )


def calibration_facts(site: Site, tags: tuple[TagReceived, ...]) -> Facts:
    """The facts for finding a site's delays from tags at known positions. Raises SkylessError."""
    if not site.anchors:
        raise SkylessError("a calibration needs the anchors' positions; --site should be a file that has them")
    return Facts(
        dimensions=3,
        sketch_m=_sketch_m(site),
        sketch_std_m=_stated_std_m(site),
        keep_positions=True,
        delay_std_m=_UNCALIBRATED_DELAY_STD_M,
        tags=tags,
    )


def _sketch_m(site: Site | None) -> dict[int, Point]:
    return {} if site is None else {anchor.id: (anchor.x_m, anchor.y_m, anchor.z_m) for anchor in site.anchors}


def _stated_std_m(site: Site) -> float:
    return float((sum(std_m**2 for std_m in position_stds_m(site)) / len(site.anchors)) ** 0.5)


def _heights(asked: SurveyOptions, known: set[int]) -> dict[int, float]:
    """Heights by anchor: those of single anchors override the table, or the height of all. Raises SkylessError."""
    given = asked.anchor_height_m
    by_anchor = dict(given) if isinstance(given, dict) else {}
    of_all = by_anchor.pop(None, None)
    _require_known("--anchor-height", by_anchor, known)
    if not isinstance(of_all, Path):
        return ({} if of_all is None else dict.fromkeys(known, of_all)) | by_anchor
    table = read_heights(of_all)
    if known.isdisjoint(table):
        raise ConfigurationError(of_all, "column id", _names(table), f"anchors among {_names(known)}")
    return {anchor: z_m for anchor, z_m in table.items() if anchor in known} | by_anchor


def _require_known(option: str, anchors: Iterable[int], known: set[int]) -> None:
    for anchor in anchors:
        if anchor not in known:
            raise SkylessError(
                f"{option} names anchor {anchor}, and there is no anchor {anchor}; there are {_names(known)}"
            )


def _names(anchors: Iterable[int]) -> str:
    return ", ".join(map(str, sorted(anchors)))
