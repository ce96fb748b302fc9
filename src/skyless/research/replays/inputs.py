"""Inputs of a replay or survey besides the recording: anchors, truth and heights."""

from collections import deque
from collections.abc import Mapping
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import ArrayLike

from skyless.arguments import (
    check_point,
    existing_file,
    wrong,
)
from skyless.core.air.masterless_packets import Packet, Point
from skyless.core.errors import ConfigurationError, SkylessError
from skyless.core.geometry import GUESSED_STD_M, plane_height_m
from skyless.core.site import Site
from skyless.research.foreign.formats import Format, format_of, open_recording
from skyless.research.replays.options import BAROMETER, RECORDED, RecordingOptions, ReplayOptions
from skyless.run.masterless.smoothing import Height
from skyless.sim.evaluation.figures import FLIGHT_M, antenna_truth, flies, shifted
from skyless.site.file.load import site_of
from skyless.site.tables import HEIGHT_STD_M, Truth, read_anchors, read_height_readings, read_truth

if TYPE_CHECKING:
    from skyless.research.replays.options import Anchors

TOO_FLAT = "the anchors' mean: they lie too flat to determine the height"
"""Source of a height that nobody gave."""


YAML_SUFFIXES: Final = frozenset({".yaml", ".yml"})


def known_anchors(anchors: "Anchors | None", site: Site | str | Path | None) -> tuple[dict[int, Point], float | None]:
    """Positions of the anchors, and the tags' height if a site states it. Raises SkylessError."""
    if anchors is not None and site is not None:
        raise SkylessError("give either --anchors or --site, not both")
    if site is not None:
        known = site_of(site)[0]
        return {anchor.id: (anchor.x_m, anchor.y_m, anchor.z_m) for anchor in known.anchors}, known.tags.height_m
    if anchors is None:
        return {}, None
    if not isinstance(anchors, Mapping):
        path = existing_file("--anchors", anchors)
        return (_read_yaml(path) if path.suffix in YAML_SUFFIXES else read_anchors(path)), None
    anchors_m: dict[int, Point] = {}
    for identifier, position_m in anchors.items():
        if not isinstance(identifier, int) or identifier < 0:
            raise wrong("--anchors", identifier, "positions by identifiers, which are whole numbers")
        x_m, y_m, z_m = check_point(f"--anchors[{identifier}]", position_m, (3,))
        anchors_m[identifier] = (x_m, y_m, z_m)
    return anchors_m, None


_MAX_TO_FIND_ANCHORS: Final = 2_000
"""Every anchor of a DL-TDoA recording is heard within this many records."""


def stated_anchors(file: str | Path, kind: Format) -> dict[int, Point]:
    """Positions stated by the anchors of a DL-TDoA recording."""
    if not kind.is_dl_tdoa:
        return {}
    with open_recording(file, kind.name) as recording:
        packets = [record for record in islice(recording, _MAX_TO_FIND_ANCHORS) if isinstance(record, Packet)]
    return {packet.anchor: packet.position_m for packet in packets if packet.position_m is not None}


def _read_yaml(path: Path) -> dict[int, Point]:
    """Anchor positions from a YAML file of Bitcraze's programs: x, y and z by identifier. Raises ConfigurationError."""
    import yaml  # noqa: PLC0415 - of the extra research

    try:
        known = yaml.safe_load(path.read_text(encoding="utf-8"))
        return {int(anchor): (float(one["x"]), float(one["y"]), float(one["z"])) for anchor, one in known.items()}
    except (OSError, ValueError, TypeError, KeyError, AttributeError, yaml.YAMLError) as error:
        raise ConfigurationError(path, "the file", type(error).__name__, "identifiers with x, y and z each") from None


def known_truth(path: Path, asked: "RecordingOptions") -> Truth | None:
    """Positions of the antenna, from an array, a table or the recording itself. Raises SkylessError."""
    truth, arm_m = asked.truth, asked.lever_arm_m
    own, known = format_of(path, asked.format).read_truth, None
    if truth is None and own is not None:
        known = own(path, asked.listener)
    if truth is None and known is None:
        asked.leave_out("lever_arm_m", "truth_offset_s", why="it moves the truth, which --truth must give")
        return None
    if isinstance(truth, str | Path):
        known = read_truth(existing_file("--truth", truth), asked.listener)
    elif truth is not None:
        known = _truth_of(truth)
    assert known is not None
    if isinstance(asked.truth_offset_s, float | int):
        known = shifted(known, asked.truth_offset_s)
    return known if arm_m is None else antenna_truth(known, arm_m)


def _truth_of(given: ArrayLike) -> Truth:
    right = "an array of shape (n, 4), n at least 1: time in s, which does not decrease, x, y, z in metres, all finite"
    try:
        rows = np.array(given, dtype=np.float64)
    except (TypeError, ValueError):
        raise wrong("--truth", given, right) from None
    is_table = rows.ndim == 2 and rows.shape[1] == 4 and len(rows) > 0
    if not (is_table and np.isfinite(rows).all() and (np.diff(rows[:, 0]) >= 0.0).all()):
        raise SkylessError(f"--truth is an array of shape {rows.shape}; it should be {right}")
    return Truth(rows[:, 0], rows[:, 1:], None)


def known_heights(asked: "ReplayOptions") -> deque[Height]:
    """Readings of the tag's height sensor by time, from an array or a table. Raises SkylessError."""
    given = asked.heights
    if given is None:
        return deque()
    if str(given) == RECORDED:
        own = format_of(asked.file, asked.format).read_heights
        found = None if own is None else own(asked.file, is_barometer=asked.height_kind == BAROMETER)
        if found is None:
            raise wrong("--heights", RECORDED, "a table: the recording holds none of this kind")
        rows = found
    elif isinstance(given, str | Path):
        rows = read_height_readings(existing_file("--heights", given))
    else:
        rows = np.array(given, dtype=np.float64)
        if rows.ndim == 2 and rows.shape[1] == 2:
            rows = np.column_stack([rows, np.full(len(rows), HEIGHT_STD_M)])
    right = rows.ndim == 2 and rows.shape[1] == 3 and np.isfinite(rows).all() and (rows[:, 2] > 0.0).all()
    if not right or (np.diff(rows[:, 0]) < 0.0).any():
        expected = "rows of time in s, which does not decrease, height in m and, above 0, its standard deviation in m"
        raise wrong("--heights", given, expected)
    return deque(Height(t_s, height_m, std_m, asked.height_kind == BAROMETER) for t_s, height_m, std_m in rows.tolist())


def height_to_hold(
    wish: float | str, anchors_m: dict[int, Point], site_m: float | None, truth: Truth | None, format_name: str
) -> tuple[float | None, float, str]:
    """Height to hold (None to estimate it), its standard deviation, and its source.

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
    """Height above which fixes are judged: ``wish``, or 0.3 m if the truth starts on the floor and rises above it."""
    if wish is not None or truth is None:
        return wish
    return FLIGHT_M if flies(truth) else None
