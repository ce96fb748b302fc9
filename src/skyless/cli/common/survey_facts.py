"""What a user states of a site for ``skyless survey``, from its options and the site's file."""

import re
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final, Literal

from cyclopts import Parameter
from cyclopts.validators import Number
from msgspec.structs import replace

from skyless.cli.common.options import metres, options
from skyless.errors import ConfigurationError, SkylessError

if TYPE_CHECKING:
    from skyless.site.model import Site
    from skyless.survey.facts import Facts, Gauge, Point, Tape

_MOST_STD_M: Final = 100.0
Std = Annotated[float, Parameter(validator=Number(gt=0, lte=_MOST_STD_M))]
StdOrZero = Annotated[float, Parameter(validator=Number(gte=0, lte=_MOST_STD_M))]

_SKETCH_STD_M: Final = 0.3
_FOREIGN_DELAY_STD_M: Final = 0.03
_FOREIGN_COMMON_DELAY_STD_M: Final = 1.0
"""Of recordings of other systems: boards of one kind without calibration are nearly alike, but nothing is known of
what they share."""
_TAPE: Final = re.compile(r"(?P<a>\w+)-(?P<b>\w+)=(?P<distance>[^±+]+)((±|\+-)(?P<std>.+))?")


@options
class FactOptions:
    """What the user knows of a site."""

    site: Path | None = None
    """Site file of the present: its anchors, heights, and rough positions."""
    no_sketch: bool = False
    """Do not use the positions of --site, only its anchors and heights."""
    sketch_std: Std | None = None
    """How well the positions of --site are known, metres per axis; 0.3 by default, with --keep-positions what the file
    states."""
    keep_positions: bool = False
    """Keep the positions of --site and find delays only."""
    dimensions: Literal[2, 3] | None = None
    """2 (default): heights are given; 3: heights are estimated."""
    anchor_height: list[str] | None = None
    """Height of all anchors in metres, or of one: 3=2.4. Several times for several anchors."""
    anchor_heights: Path | None = None
    """Table of heights: id,z_m."""
    anchor_height_std: Std | None = None
    """How well given heights are known, metres (--dimensions 3); 0.02 by default."""
    distance: list[str] | None = None
    """A distance between two anchors by tape or laser: 1-4=7.21, or 1-4=7.21±0.01; ±0.005 by default."""
    point: list[str] | None = None
    """An anchor whose position is known: 3=0,4 or 3=0,4,2.5."""
    point_std: Std | None = None
    """How well such positions are known, metres per axis; 0.005 by default."""
    delays_known: bool = False
    """The antenna delays are right; do not estimate them."""
    delay_std: Std | None = None
    """How much antenna delays are expected to be off, each for itself, metres; 0.07 by default, 0.15 for boards that
    were never calibrated, 0.03 for recordings of other systems."""
    common_delay_std: StdOrZero | None = None
    """How much all of them are expected to be off together, more than that; 0.1 by default, 1 for recordings of other
    systems, whose stamps may lack any correction."""
    pair_std: StdOrZero | None = None
    """Constant error expected of each pair's range, metres; 0.03 by default."""
    origin: int | None = None
    """The anchor at (0, 0)."""
    x_axis: int | None = None
    """An anchor on the positive x axis; best the farthest from --origin."""
    left: int | None = None
    """An anchor on the left of the x axis (y > 0)."""


def facts_of(asked: FactOptions, anchors: Iterable[int], site: "Site | None", *, is_foreign: bool = False) -> "Facts":
    """The facts; ``site``: of --site or of the recording. Raises SkylessError.

    ``is_foreign``: of a recording of another system.
    """
    from skyless.survey.facts import Facts

    known = set(anchors)
    _check(asked, site)
    points: dict[int, Point] = {}
    for text in asked.point or ():
        anchor, point = _point(text, known)
        if anchor in points:
            raise SkylessError(f"--point is {text!r}; the position of anchor {anchor} should be given once")
        points[anchor] = point
    sketch = _positions(site) if site is not None and not asked.no_sketch else {}
    dimensions = asked.dimensions or 2
    given = _heights(asked, known) | {anchor: point[2] for anchor, point in points.items() if point[2] is not None}
    if dimensions == 2:
        from_file = {} if site is None else {anchor.id: anchor.z_m for anchor in site.anchors}
        given = from_file | given
    usual = Facts()
    if is_foreign:
        usual = replace(usual, delay_std_m=_FOREIGN_DELAY_STD_M, common_delay_std_m=_FOREIGN_COMMON_DELAY_STD_M)
    return Facts(
        dimensions=dimensions,
        heights_m=given,
        height_std_m=asked.anchor_height_std or usual.height_std_m,
        tapes=_tapes(asked.distance or (), known),
        points=points,
        point_std_m=asked.point_std or usual.point_std_m,
        sketch_m=sketch,
        sketch_std_m=asked.sketch_std or _sketch_std(asked, site),
        keep_positions=asked.keep_positions,
        delay_std_m=0.0 if asked.delays_known else asked.delay_std or usual.delay_std_m,
        common_delay_std_m=usual.common_delay_std_m if asked.common_delay_std is None else asked.common_delay_std,
        pair_std_m=usual.pair_std_m if asked.pair_std is None else asked.pair_std,
        gauge=_gauge(asked, known),
    )


def _check(asked: FactOptions, site: "Site | None") -> None:
    """See that the options fit one another. Raises SkylessError."""
    if asked.delays_known and asked.delay_std is not None:
        raise SkylessError(f"--delay-std is {asked.delay_std:g}; it should be left out with --delays-known")
    if asked.delays_known and asked.common_delay_std is not None:
        raise SkylessError(
            f"--common-delay-std is {asked.common_delay_std:g}; it should be left out with --delays-known"
        )
    if asked.anchor_height_std is not None and asked.dimensions != 3:
        raise SkylessError(
            f"--anchor-height-std is {asked.anchor_height_std:g}; it is for --dimensions 3, else heights are exact"
        )
    if asked.keep_positions and asked.no_sketch:
        raise SkylessError("--keep-positions keeps what --no-sketch would leave out; give either")
    if asked.keep_positions and asked.delays_known:
        raise SkylessError("--keep-positions finds delays, and --delays-known says that they are known; give either")
    if asked.keep_positions and (site is None or not site.anchors):
        raise SkylessError("--keep-positions needs positions to keep; --site should be a file that has them")
    if asked.sketch_std is not None and (site is None or not site.anchors or asked.no_sketch):
        raise SkylessError(f"--sketch-std is {asked.sketch_std:g}; it needs the positions of --site")


def _positions(site: "Site") -> "dict[int, Point]":
    return {anchor.id: (anchor.x_m, anchor.y_m, anchor.z_m) for anchor in site.anchors}


def _sketch_std(asked: FactOptions, site: "Site | None") -> float:
    if not asked.keep_positions or site is None:
        return _SKETCH_STD_M
    stated = [site.accuracy.survey_std_m if one.std_m is None else one.std_m for one in site.anchors]
    return float((sum(std_m**2 for std_m in stated) / len(stated)) ** 0.5)


def _heights(asked: FactOptions, known: set[int]) -> dict[int, float]:
    """By option; single heights before those of the table, these before the height of all. Raises SkylessError."""
    from skyless.recordings.range_table import read_heights

    single: dict[int, float] = {}
    of_all: dict[int, float] = {}
    for text in asked.anchor_height or ():
        name, mark, value = text.rpartition("=")
        (z_m,) = metres("anchor-height", text, (1,), part=value if mark else None)
        if mark:
            anchor = _anchor("anchor-height", text, name, known)
            if anchor in single:
                raise SkylessError(f"--anchor-height is {text!r}; the height of anchor {anchor} should be given once")
            single[anchor] = z_m
        elif of_all:
            raise SkylessError(f"--anchor-height is {text!r}; the height of all anchors should be given once")
        else:
            of_all = dict.fromkeys(known, z_m)
    table: dict[int, float] = {}
    if asked.anchor_heights is not None:
        table = read_heights(asked.anchor_heights)
        if known.isdisjoint(table):
            raise ConfigurationError(asked.anchor_heights, "column id", _names(table), f"anchors among {_names(known)}")
    return of_all | {anchor: z_m for anchor, z_m in table.items() if anchor in known} | single


def _tapes(texts: Iterable[str], known: set[int]) -> "tuple[Tape, ...]":
    tapes: dict[frozenset[int], Tape] = {}
    for text in texts:
        tape = _tape(text, known)
        pair = frozenset((tape.a, tape.b))
        if pair in tapes:
            raise SkylessError(f"--distance is {text!r}; that between {tape.a} and {tape.b} should be given once")
        tapes[pair] = tape
    return tuple(tapes.values())


def _tape(text: str, known: set[int]) -> "Tape":
    from skyless.survey.facts import Tape

    match = _TAPE.fullmatch(text)
    if match is None:
        raise SkylessError(f"--distance is {text!r}; it should be like 1-4=7.21 or 1-4=7.21±0.01")
    a, b = (_anchor("distance", text, match[name], known) for name in ("a", "b"))
    (distance_m,) = metres("distance", text, (1,), part=match["distance"])
    if match["std"] is None:
        std_m = Tape(a, b, distance_m).std_m
    else:
        (std_m,) = metres("distance", text, (1,), part=match["std"])
    if a == b or distance_m <= 0.0 or not 0.0 <= std_m <= _MOST_STD_M:
        raise SkylessError(f"--distance is {text!r}; it should be a positive distance between two anchors")
    return Tape(a, b, distance_m, std_m)


def _point(text: str, known: set[int]) -> "tuple[int, Point]":
    name, _, position = text.partition("=")
    x_m, y_m, *z_m = metres("point", text, (2, 3), part=position)
    return _anchor("point", text, name, known), (x_m, y_m, z_m[0] if z_m else None)


def _gauge(asked: FactOptions, known: set[int]) -> "Gauge | None":
    """Raises SkylessError."""
    from skyless.survey.facts import Gauge

    named = {"origin": asked.origin, "x-axis": asked.x_axis, "left": asked.left}
    given = {option: anchor for option, anchor in named.items() if anchor is not None}
    if not given:
        return None
    if asked.origin is None or asked.x_axis is None:
        raise SkylessError("the axes need --origin and --x-axis, and --left where the side is not known otherwise")
    for option, anchor in given.items():
        _require_known(option, str(anchor), anchor, known)
    if len(set(given.values())) < len(given):
        raise SkylessError(f"--x-axis is {asked.x_axis}; --origin, --x-axis and --left should be different anchors")
    return Gauge(asked.origin, asked.x_axis, asked.left)


def _anchor(option: str, text: str, name: str, known: set[int]) -> int:
    """The anchor that a part of an option's value names. Raises SkylessError."""
    try:
        anchor = int(name, 0) if name.strip().lower().startswith("0x") else int(name)
    except ValueError:
        raise SkylessError(f"--{option} is {text!r}; {name!r} should be the identifier of an anchor") from None
    _require_known(option, text, anchor, known)
    return anchor


def _require_known(option: str, text: str, anchor: int, known: set[int]) -> None:
    if anchor not in known:
        raise SkylessError(f"--{option} is {text!r}, and there is no anchor {anchor}; there are {_names(known)}")


def _names(anchors: Iterable[int]) -> str:
    return ", ".join(map(str, sorted(anchors)))
