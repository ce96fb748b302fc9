"""Options of ``skyless replay``, some of which ``skyless calibrate`` shares."""

from functools import partial
from pathlib import Path
from runpy import run_path
from typing import TYPE_CHECKING, Annotated, Any, Final

from skyless.arguments import (
    ComputedOptions,
    Method,
    NotNegative,
    Option,
    Options,
    Positive,
    Rule,
    Text,
    check_number,
    check_point,
    choice,
    existing_file,
    numbers,
    point,
    read_height,
    read_numbers,
    wrong,
)
from skyless.core.air.site_pages import MAX_COORDINATE_M
from skyless.core.errors import SkylessError
from skyless.core.site import Site
from skyless.sim.evaluation.request import IntegrityRisk, ProtectionOptions

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping

    from numpy.typing import ArrayLike

    from skyless.core.integrity import IntegrityRequirement
    from skyless.run.masterless.smoothing import OwnEstimator

    Anchors = Mapping[int, tuple[float, float, float]] | str | Path
    """Positions by identifier in metres, or the path of a table."""
    AnyTruth = ArrayLike | str | Path
    """Rows of time and position, shape (n, 4), or the path of a table."""

PACKETS, DIFFERENCES_MADE = "packets", "differences"
MEASUREMENTS: Final = (PACKETS, DIFFERENCES_MADE)
"""Input of the filter: anchors' packets as they are, or time differences derived from them."""

AUTO: Final = "auto"

HEIGHT_SENSOR, BAROMETER, RECORDED, NO_MOTION = "sensor", "barometer", "recording", "none"

HEIGHT_WORDS: Final = ("truth", "free", "auto")
"""Alternatives to a tag's height in metres: the truth's median, estimated, or automatic."""

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


LeverArm = Annotated[
    "tuple[float, float, float] | None",
    Option("lever-arm"),
    numbers(3, form="x,y,z"),
    point(3, farthest_m=MAX_COORDINATE_M),
]


class RecordingOptions(ComputedOptions, frozen=True):
    """A recording, and what is known of it."""

    file: Annotated["str | Path", Path, Rule(existing_file)]
    """The recording, plain or gzip."""
    anchors: Annotated["Anchors | None", Path] = None
    """Table of anchors: id,x_m,y_m,z_m, with bias_m where skyless calibrate has found that; in Python also positions by
    identifier."""
    truth: Annotated["AnyTruth | None", Path] = None
    """Table of true positions: t_s,x_m,y_m,z_m, with qx,qy,qz,qw if the body turns; t_s in the recording's time, in
    Unix time for a recording of skyless record; in Python also an array of shape (n, 4). MILUV ticks bring theirs."""
    truth_offset_s: Annotated[float | str, Option("truth-offset"), Text(_read_offset), Rule(_check_offset)] = 0.0
    """Seconds to add to the truth's times; auto: what fits the fixes best."""
    lever_arm_m: LeverArm = None
    """The antenna in the body's frame, in metres, added to the truth."""
    format: str | None = None
    """Name of the format, if the content should not decide."""
    listener: str | None = None
    """Which receiver, in recordings with several."""
    above_m: Annotated[float | None, Option("above")] = None
    """Judge only while the true height exceeds this, in metres; by default 0.3 for a table of differences that starts
    below it and later flies, as tags on the floor hear reflections only."""
    tag: str | None = None
    """Name of the tag, in recordings of skyless record; by default all."""


def read_estimator(name: str, text: str) -> Any:  # noqa: ANN401 - any class
    """Load a user's class, given as FILE.py:CLASS. Raises SkylessError."""
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
    """Check that it creates something that has ``hear``. Raises SkylessError."""
    if not callable(value) or (isinstance(value, type) and not callable(getattr(value, "hear", None))):
        raise wrong(name, value, "a class with a method hear(observation), or what makes an instance of one")
    return value


EstimatorClass = Annotated[
    "Callable[[], OwnEstimator] | None", Text(read_estimator, "FILE.py:CLASS"), Rule(check_estimator)
]


class ReplayOptions(RecordingOptions, frozen=True, kw_only=True):
    """Options of ``skyless replay``."""

    site: Annotated["Site | str | Path | None", Path] = None
    """Site file instead of --anchors, for its anchors and its tags' height; in Python also a site. With a recording of
    skyless record: replay as if its anchors had had the antenna delays of this site, as skyless survey writes them."""
    channel: int | None = None
    """Which radio channel, in recordings of several; by default the first for packets, and all for differences."""
    tag_height_m: Annotated[float | str, Option("tag-height"), Text(_read_height), Rule(_check_height)] = "auto"
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
    imu: Annotated[str, choice(RECORDED, NO_MOTION)] = RECORDED
    """Whether the filter uses gyroscope and accelerometer where the recording holds them (not with --smooth)."""
    smooth: bool = False
    """Let every fix use all of the recording, what came later as well (of time differences); fixes have no protection
    level then."""
    estimator: EstimatorClass = None
    """Your own estimator instead of the filter: a class with hear(observation), which gets one time difference after
    the other."""
    first_s: Annotated[Positive | None, Option("only-first")] = None
    """Replay only this number of seconds from the first record on."""
    settle_s: Annotated[NotNegative | None, Option("settle")] = None
    """Seconds from the start that are not judged; by default 3 with a truth table, 2 without."""
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
    """Fixes whose protection level exceeds this, in metres, carry an alert; by default the tag's own limit holds.
    With either, or --tag-height-std, tags start from the beginning, as with another method, and those that are not
    given are as of a tag of which nothing was asked."""

    @property
    def needs_differences(self) -> str:
        """The option that requires time differences; empty if there is none."""
        asked = {
            "--smooth": self.smooth,
            "--estimator": self.estimator is not None,
            "--height-kind barometer": self.height_kind == BAROMETER,
        }
        return next((option for option, is_asked in asked.items() if is_asked), "")

    def check(self) -> None:
        """Check that the options are compatible. Raises SkylessError."""
        if self.estimator is not None:
            self.leave_out("smooth", "heights", "tdoa_std_m", why="the estimator is your own")
        if self.heights is None:
            self.leave_out("height_kind", why="--heights gives none")
        _ = self.requirement

    @property
    def requirement(self) -> "IntegrityRequirement | None":
        """Requirements for the levels that replace the tag's own; None without any."""
        asked = ProtectionOptions(integrity_risk=self.integrity_risk, alert_limit_m=self.alert_limit_m)
        if not asked.given("integrity_risk", "alert_limit_m") and self.tag_height_std_m is None:
            return None
        return asked.requirement(self.method, self.tag_height_std_m)


_QUICK_S: Final = 12.0


class BenchmarkOptions(Options, frozen=True, kw_only=True):
    """Options of ``skyless benchmark``."""

    out: Path = Path("benchmark")
    """Write the result here, into a folder: index.html, results.csv and results.json. What is there already is kept."""
    only: str = ""
    """Only recordings whose name holds this text."""
    lever_arm_m: LeverArm = None
    """The antenna in the body's frame, in metres, added to the truth of tables."""
    calibrate_on: Annotated[tuple[str, ...], Option("calibrate-on"), Text(lambda _, text: text, "NAME", many=True)] = ()
    """Calibrate anchors on recordings whose names hold this text, for each table of anchors on the first; others with
    the same table are replayed with that as well."""
    estimator: EstimatorClass = None
    """Your own estimator as one more method: a class with hear(observation)."""
    first_s: Annotated[Positive | None, Option("only-first")] = None
    """Replay only this number of seconds of each recording."""
    quick: bool = False
    """Compute a fraction: the first twelve seconds of each recording, without smoothing; about a minute for thirty."""

    @property
    def seconds(self) -> float | None:
        """How much of each recording is replayed; None for all."""
        return _QUICK_S if self.quick and self.first_s is None else self.first_s

    @property
    def estimators(self) -> "dict[str, Callable[[], OwnEstimator]]":
        """The own estimator, if there is one, by the name of its class."""
        return {} if self.estimator is None else {getattr(self.estimator, "__name__", "own"): self.estimator}

    @property
    def program(self) -> Path | None:
        """The file of the own estimator."""
        code = getattr(getattr(self.estimator, "hear", self.estimator), "__code__", None)
        return None if code is None else Path(code.co_filename)
