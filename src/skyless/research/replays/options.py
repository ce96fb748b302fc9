"""What is asked of a replay: options of ``skyless replay``, and what a survey of a recording shares with it."""

from collections import deque
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from runpy import run_path
from typing import TYPE_CHECKING, Annotated, Any, Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import ArrayLike

from skyless.arguments import (
    ComputedOptions,
    Method,
    NotNegative,
    Option,
    Positive,
    Rule,
    Text,
    check_number,
    check_point,
    choice,
    existing_file,
    numbers,
    point,
    process_noise,
    read_height,
    read_numbers,
    wrong,
)
from skyless.core.air.masterless_packets import Point
from skyless.core.air.site_pages import MAX_COORDINATE_M
from skyless.core.arrays import Matrix, Vector
from skyless.core.errors import ConfigurationError, SkylessError
from skyless.core.geometry import GUESSED_STD_M, plane_height_m
from skyless.core.method_names import Dynamics
from skyless.core.site import Site
from skyless.research.foreign.formats import format_of
from skyless.research.masterless.smoothing import Height
from skyless.sim.evaluation.figures import FLIGHT_M, antenna_truth, flies, shifted
from skyless.sim.evaluation.request import IntegrityRisk, ProtectionOptions
from skyless.site.file.load import site_of
from skyless.site.tables import HEIGHT_STD_M, Truth, read_anchors, read_height_readings, read_truth

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import ArrayLike

    from skyless.core.integrity import IntegrityRequirement
    from skyless.core.site import Site
    from skyless.research.masterless.smoothing import OwnEstimator

# What a replay or a survey is given with a recording: anchors, truth and heights, as values.

Anchors = Mapping[int, tuple[float, float, float]] | str | Path
"""Positions by identifier in metres, or the path of a table."""

AnyTruth = ArrayLike | str | Path
"""Rows of time and position, shape (n, 4), or the path of a table."""

TOO_FLAT = "the anchors' mean: they lie too flat to determine the height"
"""Where a height is from that nobody gave."""


YAML_SUFFIXES: Final = frozenset({".yaml", ".yml"})


def known_anchors(anchors: Anchors | None, site: Site | str | Path | None) -> tuple[dict[int, Point], float | None]:
    """Positions of the anchors, and the tags' height where a site states it. Raises SkylessError."""
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


def _read_yaml(path: Path) -> dict[int, Point]:
    """Positions of anchors as Bitcraze's programs keep them, x, y and z by identifier. Raises ConfigurationError."""
    import yaml  # noqa: PLC0415 - of the extra research

    try:
        known = yaml.safe_load(path.read_text(encoding="utf-8"))
        return {int(anchor): (float(one["x"]), float(one["y"]), float(one["z"])) for anchor, one in known.items()}
    except (OSError, ValueError, TypeError, KeyError, AttributeError, yaml.YAMLError) as error:
        raise ConfigurationError(path, "the file", type(error).__name__, "identifiers with x, y and z each") from None


def known_truth(path: Path, asked: "RecordingOptions") -> Truth | None:
    """Where the antenna was, by an array, a table, or the recording itself. Raises SkylessError."""
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
    """Readings of the tag's height sensor by time, by an array or a table. Raises SkylessError."""
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


PACKETS, DIFFERENCES_MADE = "packets", "differences"
MEASUREMENTS: Final = (PACKETS, DIFFERENCES_MADE)
"""What the filter is given: anchors' packets as they are, or time differences made of them."""

AUTO: Final = "auto"

HEIGHT_SENSOR, BAROMETER, RECORDED = "sensor", "barometer", "recording"

HEIGHT_WORDS: Final = ("truth", "free", "auto")
"""What a tag's height may be instead of metres: the truth's median, estimated, or what suits."""


_read_height = partial(read_height, words=HEIGHT_WORDS)


def _check_height(name: str, value: Any) -> Any:  # noqa: ANN401 - a number or a word
    if not isinstance(value, str):
        return check_number(name, value)
    return _read_height(name, value)


def _read_offset(name: str, text: str) -> float | str:
    return text if text == AUTO else read_numbers(name, text, (1,))[0]


def _check_offset(name: str, value: Any) -> Any:  # noqa: ANN401 - a number or a word
    return value if value == AUTO else check_number(name, value)


def _check_bounds(name: str, value: Any) -> tuple[float, float]:  # noqa: ANN401 - what a user gives
    low_m, high_m = check_point(name, value, (2,), MAX_COORDINATE_M)
    if not low_m < high_m:
        raise wrong(name, value, "the lowest and then the highest height in metres")
    return low_m, high_m


class RecordingOptions(ComputedOptions, frozen=True, kw_only=True):
    """What is known of a recording."""

    anchors: Annotated["Anchors | None", Path] = None
    """Table of anchors: id,x_m,y_m,z_m, with bias_m where skyless survey has found that; in Python also positions by
    identifier."""
    truth: Annotated["AnyTruth | None", Path] = None
    """Table of true positions: t_s,x_m,y_m,z_m, with qx,qy,qz,qw if the body turns; t_s in the recording's time, in
    Unix time for a recording of skyless record; in Python also an array of shape (n, 4). MILUV ticks bring theirs."""
    truth_offset_s: Annotated[float | str, Option("truth-offset"), Text(_read_offset), Rule(_check_offset)] = 0.0
    """Seconds to add to the truth's times; auto: what fits the fixes best."""
    lever_arm_m: Annotated[
        "tuple[float, float, float] | None",
        Option("lever-arm"),
        numbers(3, form="x,y,z"),
        point(3, farthest_m=MAX_COORDINATE_M),
    ] = None
    """The antenna in the body's frame, in metres, added to the truth."""
    format: str | None = None
    """Name of the format, if the content should not decide."""
    listener: str | None = None
    """Which receiver, in recordings with several."""
    channel: int | None = None
    """Which radio channel, in recordings of several; by default the first for packets, and all for differences."""
    above_m: Annotated[float | None, Option("above")] = None
    """Judge only while the true height exceeds this, in metres; by default 0.3 for a table of differences that starts
    below it and later flies, as tags on the floor hear reflections only."""
    tag: str | None = None
    """Name of the tag, in recordings of skyless record; by default all."""


class _Recording(RecordingOptions, frozen=True):
    file: Annotated["str | Path", Path, Rule(existing_file)]
    """The recording, plain or gzip."""


def read_estimator(name: str, text: str) -> Any:  # noqa: ANN401 - any class
    """A class of a file of the reader's, given as FILE.py:CLASS. Raises SkylessError."""
    path, _, named = text.rpartition(":")
    file = existing_file(name, path or text)
    try:
        found = run_path(str(file))
    except Exception as error:  # noqa: BLE001 - the reader's own program can fail in any way
        raise SkylessError(f"{name} is {text!r}; it cannot be loaded: {type(error).__name__}: {error}") from None
    if named not in found:
        raise wrong(name, text, f"FILE.py:CLASS, and {file} has no such class")
    return found[named]


def check_estimator(name: str, value: Any) -> Any:  # noqa: ANN401 - any class
    """See that it makes something that has ``hear``. Raises SkylessError."""
    if not callable(value) or (isinstance(value, type) and not callable(getattr(value, "hear", None))):
        raise wrong(name, value, "a class with a method hear(observation), or what makes an instance of one")
    return value


class ReplayOptions(_Recording, frozen=True, kw_only=True):
    """Options of ``skyless replay``."""

    site: Annotated["Site | str | Path | None", Path] = None
    """Site file instead of --anchors, for its anchors and its tags' height; in Python also a site. With a recording of
    skyless record: replay as if its anchors had had the antenna delays of this site, as skyless survey writes them."""
    tag_height_m: Annotated[
        float | str, Option("tag-height"), Text(partial(read_height, words=HEIGHT_WORDS)), Rule(_check_height)
    ] = "auto"
    """The tags' height: metres, truth (its median), free (estimated), or auto: free where the anchors determine it."""
    tag_height_std_m: Annotated[NotNegative | None, Option("tag-height-std")] = None
    """Standard deviation of the tag's height from the one that is given, in metres, which fixes and levels then
    count; by default 0.5 where the height is only taken for the anchors', else 0."""
    z_bounds_m: Annotated[
        "tuple[float, float] | None", Option("z-bounds"), numbers(2, form="low,high"), Rule(_check_bounds)
    ] = None
    """Lowest and highest height of the tag in metres, where its height is estimated."""
    heights: Annotated["ArrayLike | str | Path | None", Path] = None
    """Heights at times of the recording, as a sensor of the tag read them: a table t_s,height_m, with std_m where that
    is not 0.05; in Python also an array of two or three columns; recording for those that the recording itself
    holds."""
    height_kind: Annotated[str, choice(HEIGHT_SENSOR, BAROMETER)] = HEIGHT_SENSOR
    """What gave the heights: a sensor of the height itself, or a barometer, whose zero is unknown and moves slowly."""
    smooth: bool = False
    """Let every fix use all of the recording, what came later as well (of time differences); fixes have no protection
    level then."""
    estimator: Annotated[
        "Callable[[], OwnEstimator] | None", Text(read_estimator, "FILE.py:CLASS"), Rule(check_estimator)
    ] = None
    """Your own estimator instead of the filter: a class with hear(observation), which gets one time difference after
    the other."""
    first_s: Annotated[Positive | None, Option("only-first")] = None
    """Replay only this number of seconds from the first record on."""
    settle_s: Annotated[NotNegative | None, Option("settle")] = None
    """Seconds from the start that are not judged; by default 3 with a truth table, 2 without."""
    qa: Positive | None = None
    """Process noise that the filter assumes: spectral density of the acceleration, m²/s³."""
    dynamics: Dynamics | None = None
    """How tags move: walk (as people), robot or drone, which sets the process noise instead of --qa."""
    tdoa_std_m: Annotated[Positive | None, Option("tdoa-std")] = None
    """Noise of what is new in a time difference, metres."""
    uncalibrated: bool = False
    """Leave out the calibration that the table of anchors holds."""
    method: Method | None = None
    """How positions are computed, in recordings of skyless record; by default as the tag did."""
    measurements: Annotated[str | None, choice(*MEASUREMENTS)] = None
    """What the filter is given of other recordings: packets, as anchors sent them, which is the default for
    Bitcraze's, FiRa's and MULoc's; or differences, which are made of them."""
    stamps_only: bool = False
    """Leave out the phases of carriers that were recorded."""
    integrity_risk: IntegrityRisk | None = None
    """Probability, for each fix, that the error exceeds its protection level, in recordings of skyless record (joint);
    by default the tag's own."""
    alert_limit_m: Positive | None = None
    """Fixes whose protection level exceeds this, in metres, carry an alert; by default the tag's own limit holds."""
    max_acceleration_mps2: Annotated[NotNegative | None, Option("max-acceleration")] = None
    """The largest acceleration of the tags in m/s²; by default what the tag assumed. With any of these, or
    --tag-height-std, tags start from the beginning, as with another method, and those that are not given are as of
    a tag of which nothing was asked."""

    @property
    def needs_differences(self) -> str:
        """The option that only time differences can serve; empty where there is none."""
        asked = {
            "--smooth": self.smooth,
            "--estimator": self.estimator is not None,
            "--height-kind barometer": self.height_kind == BAROMETER,
        }
        return next((option for option, is_asked in asked.items() if is_asked), "")

    def check(self) -> None:
        """See that the options fit one another. Raises SkylessError."""
        if self.estimator is not None:
            self.leave_out("smooth", "heights", "qa", "dynamics", "tdoa_std_m", why="the estimator is your own")
        if self.heights is None:
            self.leave_out("height_kind", why="--heights gives none")
        process_noise(self.qa, self.dynamics)
        _ = self.requirement

    @property
    def requirement(self) -> "IntegrityRequirement | None":
        """What is required of the levels instead of what the tag did; None where nothing is."""
        asked = ProtectionOptions(
            integrity_risk=self.integrity_risk,
            alert_limit_m=self.alert_limit_m,
            max_acceleration_mps2=self.max_acceleration_mps2,
        )
        if not asked.protection_given and self.tag_height_std_m is None:
            return None
        return asked.requirement(self.method, self.tag_height_std_m)


# The picture of a replay: track and height over truth, errors and stated σ over time, histograms of the errors.


def track_figure(rows: Matrix, title: str) -> Figure:
    """Draw rows of time, position, truth (NaN where unknown) and σ of each axis, shape (n, 10); of none, the title."""
    figure = Figure(figsize=(15, 8), layout="constrained")
    figure.suptitle(title)
    if len(rows):
        _fill(figure, rows)
    return figure


def _fill(figure: Figure, rows: Matrix) -> None:
    axes = figure.subplots(2, 3)
    judged = rows[np.isfinite(rows[:, 4])]
    known = len(judged) > 0
    drawn = judged if known else rows
    errors = judged[:, 1:4] - judged[:, 4:7] if known else rows[:, 1:4] - np.median(rows[:, 1:4], axis=0)
    time_s, std_m = drawn[:, 0] - drawn[:1, 0], drawn[:, 7:10]
    _track(axes[0, 0], rows, judged)
    _over_time(axes[0, 1], time_s, errors[:, :2], std_m[:, :2], known=known)
    _over_time(axes[0, 2], time_s, errors[:, 2:], std_m[:, 2:], known=known)
    _histogram(axes[1, 0], errors, known=known)
    _distribution(axes[1, 1], np.linalg.norm(errors[:, :2], axis=1), known=known)
    _height(axes[1, 2], rows, judged)


def _track(axes: Axes, rows: Matrix, judged: Matrix) -> None:
    if len(judged):
        axes.plot(judged[:, 4], judged[:, 5], color="black", linewidth=0.8, label="truth")
    axes.plot(rows[:, 1], rows[:, 2], ".", markersize=2, label="fixes")
    axes.set(xlabel="x in m", ylabel="y in m", title="track", aspect="equal")
    axes.legend()


def _height(axes: Axes, rows: Matrix, judged: Matrix) -> None:
    if len(judged):
        axes.plot(judged[:, 0] - rows[0, 0], judged[:, 6], color="black", linewidth=0.8, label="truth")
    axes.plot(rows[:, 0] - rows[0, 0], rows[:, 3], ".", markersize=2, label="fixes")
    axes.set(xlabel="time in s", ylabel="z in m", title="height")
    axes.legend()


def _over_time(axes: Axes, time_s: Vector, errors: Matrix, std_m: Matrix, *, known: bool) -> None:
    """Errors of x and y, or of z, and the largest σ of them."""
    names = "xy" if errors.shape[1] == 2 else "z"
    for axis, name in enumerate(names):
        axes.plot(time_s, errors[:, axis], linewidth=0.7, label=name)
    for sign in (1.0, -1.0):
        axes.plot(
            time_s, sign * std_m.max(axis=1), color="black", linewidth=0.8, label="± stated σ" if sign > 0 else None
        )
    axes.set(xlabel="time in s", ylabel=_label(known=known), title=f"{' and '.join(names)} over time")
    axes.legend()


def _histogram(axes: Axes, errors: Matrix, *, known: bool) -> None:
    span = np.percentile(np.abs(errors), 99.5) if len(errors) else 1.0
    for axis, name in enumerate("xyz"):
        axes.hist(errors[:, axis], bins=80, range=(-span, span), histtype="step", label=name)
    axes.set(xlabel=_label(known=known), ylabel="fixes", title="histogram")
    axes.legend()


def _distribution(axes: Axes, radial_m: Matrix, *, known: bool) -> None:
    axes.plot(np.sort(radial_m), np.linspace(0.0, 100.0, len(radial_m)))
    axes.set(xlabel=f"horizontal {_label(known=known)}", ylabel="per cent of the fixes below", title="distribution")
    axes.grid(visible=True, linewidth=0.3)


def _label(*, known: bool) -> str:
    return "error in m" if known else "deviation from the median in m"
