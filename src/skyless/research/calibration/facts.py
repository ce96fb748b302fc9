"""The user's facts for a survey, from the options and the site's file."""

from collections.abc import Iterable
from pathlib import Path
from typing import Final

from msgspec.structs import replace

from skyless.core.errors import ConfigurationError, SkylessError
from skyless.core.site import Site
from skyless.research.calibration.options import SurveyOptions
from skyless.site.survey.facts import Facts, Gauge, Point
from skyless.site.tables import read_heights

_SKETCH_STD_M: Final = 0.3
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
    known, keep = set(anchors), asked.keep_positions or asked.knows_tag
    if keep and (site is None or not site.anchors):
        raise SkylessError("--keep-positions needs positions to keep; --site should be a file that has them")
    if asked.sketch_std_m is not None and (site is None or not site.anchors or asked.no_sketch):
        raise SkylessError(f"--sketch-std is {asked.sketch_std_m:g}; it needs the positions of --site")
    _require_known("--distance", (anchor for tape in asked.distances for anchor in (tape.a, tape.b)), known)
    points: dict[int, Point] = {}
    for anchor, (x_m, y_m, *z_m) in asked.points_m.items():
        points[anchor] = (x_m, y_m, z_m[0] if z_m else None)
    _require_known("--point", points, known)
    placed = () if site is None else site.anchors
    sketch: dict[int, Point] = {}
    if not asked.no_sketch:
        sketch = {anchor.id: (anchor.x_m, anchor.y_m, anchor.z_m) for anchor in placed}
    dimensions = asked.dimensions or (3 if asked.knows_tag else 2)
    given = _heights(asked, known) | {anchor: point[2] for anchor, point in points.items() if point[2] is not None}
    if dimensions == 2:
        given = {anchor.id: anchor.z_m for anchor in placed} | given
    usual = Facts()
    if is_foreign:
        usual = replace(usual, delay_std_m=_FOREIGN_DELAY_STD_M, common_delay_std_m=_FOREIGN_COMMON_DELAY_STD_M)
    elif asked.knows_tag:
        usual = replace(usual, delay_std_m=_UNCALIBRATED_DELAY_STD_M)
    common_std_m = asked.common_delay_std_m
    return Facts(
        dimensions=dimensions,
        heights_m=given,
        height_std_m=asked.anchor_height_std_m or usual.height_std_m,
        tapes=tuple(asked.distances),
        points=points,
        sketch_m=sketch,
        sketch_std_m=asked.sketch_std_m or (_SKETCH_STD_M if site is None or not keep else _stated_std_m(site)),
        keep_positions=keep,
        delay_std_m=0.0 if asked.delays_known else asked.delay_std_m or usual.delay_std_m,
        common_delay_std_m=usual.common_delay_std_m if common_std_m is None else common_std_m,
        pair_std_m=usual.pair_std_m if asked.pair_std_m is None else asked.pair_std_m,
        gauge=_gauge(asked, known),
    )


def _stated_std_m(site: Site) -> float:
    stated = [site.accuracy.survey_std_m if one.std_m is None else one.std_m for one in site.anchors]
    return float((sum(std_m**2 for std_m in stated) / len(stated)) ** 0.5)


def _heights(asked: SurveyOptions, known: set[int]) -> dict[int, float]:
    """Heights by anchor: single options override the table, and the table the height of all. Raises SkylessError."""
    given = asked.anchor_height_m
    by_anchor = dict(given) if isinstance(given, dict) else {}
    of_all = by_anchor.pop(None, None)
    _require_known("--anchor-height", by_anchor, known)
    table: dict[int, float] = {}
    if asked.anchor_heights is not None:
        table = read_heights(Path(asked.anchor_heights))
        if known.isdisjoint(table):
            right = f"anchors among {_names(known)}"
            raise ConfigurationError(asked.anchor_heights, "column id", _names(table), right)
    heights_m = {} if of_all is None else dict.fromkeys(known, of_all)
    return heights_m | {anchor: z_m for anchor, z_m in table.items() if anchor in known} | by_anchor


def _gauge(asked: SurveyOptions, known: set[int]) -> Gauge | None:
    if asked.origin is None or asked.x_axis is None:
        return None
    for option, anchor in (("origin", asked.origin), ("x-axis", asked.x_axis), ("left", asked.left)):
        _require_known(f"--{option}", () if anchor is None else (anchor,), known)
    return Gauge(asked.origin, asked.x_axis, asked.left)


def _require_known(option: str, anchors: Iterable[int], known: set[int]) -> None:
    for anchor in anchors:
        if anchor not in known:
            raise SkylessError(
                f"{option} names anchor {anchor}, and there is no anchor {anchor}; there are {_names(known)}"
            )


def _names(anchors: Iterable[int]) -> str:
    return ", ".join(map(str, sorted(anchors)))
