"""What replay and calibration are given with a recording: anchors, truth and heights, as values."""

from pathlib import Path

import numpy as np

from skyless.air.masterless_packets import Point
from skyless.errors import SkylessError
from skyless.evaluation.judge import Triple, antenna_truth
from skyless.evaluation.observability import FLIGHT_M, GUESSED_STD_M, flies, plane_height_m
from skyless.recordings.anchor_table import read_anchors
from skyless.recordings.foreign.formats import format_of
from skyless.recordings.truth import Truth, read_truth
from skyless.site.load import load_site
from skyless.site.model import Site

HEIGHT_WORDS = ("truth", "free", "auto")
"""What a tag's height may be instead of metres: the truth's median, estimated, or whichever suits."""

TOO_FLAT = "the anchors' mean: they lie too flat to determine the height"
"""Where a height is from that nobody gave."""


def anchors_of_site(site: Site) -> tuple[dict[int, Point], float | None]:
    """Positions of the anchors that have one, and the tags' height where the site states it."""
    return {anchor.id: (anchor.x_m, anchor.y_m, anchor.z_m) for anchor in site.anchors}, site.tags.height_m


def known_anchors(table: Path | None, site: Path | None) -> tuple[dict[int, Point], float | None]:
    """Positions of the anchors, and the tags' height where a site file states it. Raises SkylessError."""
    if table is not None and site is not None:
        raise SkylessError("give either --anchors or --site, not both")
    if table is not None:
        return read_anchors(table), None
    return ({}, None) if site is None else anchors_of_site(load_site(site))


def known_truth(
    file: Path, table: Path | None, arm_m: Triple | None, name: str | None, listener: str | None
) -> Truth | None:
    """Where the antenna was, by a table or by the recording itself. Raises SkylessError."""
    if table is None and format_of(file, name).name == "miluv":
        table = file
    if table is None:
        if arm_m is not None:
            raise SkylessError("--lever-arm moves the truth, which --truth must give")
        return None
    truth = read_truth(table, listener)
    return truth if arm_m is None else antenna_truth(truth, arm_m)


def height_to_hold(
    wish: float | str, anchors_m: dict[int, Point], site_m: float | None, truth: Truth | None, format_name: str
) -> tuple[float | None, float, str]:
    """Height to hold (None where it is estimated), its standard deviation, and where it is from.

    ``wish``: metres, or one of ``HEIGHT_WORDS``. Raises SkylessError.
    """
    if not isinstance(wish, str):
        return wish, 0.0, "given"
    if wish == "free":
        return None, 0.0, "estimated"
    if wish == "truth" or (truth is not None and format_name == "miluv"):
        if truth is None:
            raise SkylessError("--tag-height truth takes the height from the truth, which --truth must give")
        return float(np.median(truth.position_m[:, 2])), 0.0, "the truth's median"
    if site_m is not None:
        return site_m, 0.0, "from the site file"
    plane_m = plane_height_m(anchors_m)
    if plane_m is None:
        return None, 0.0, "estimated"
    return plane_m, GUESSED_STD_M, TOO_FLAT


def flight_height(wish: float | None, truth: Truth | None) -> float | None:
    """Height above which fixes are judged: the wish, or where the truth begins on the floor and rises well above it."""
    if wish is not None or truth is None:
        return wish
    return FLIGHT_M if flies(truth) else None
