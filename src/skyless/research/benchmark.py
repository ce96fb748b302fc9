"""``skyless benchmark``: every method on every recording below a folder, judged, as a table and a page."""

import csv
import hashlib
import re
from collections import defaultdict
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from functools import cache
from html import escape
from io import StringIO
from math import sqrt
from pathlib import Path
from typing import Annotated, Final

import msgspec
import numpy as np
from matplotlib.figure import Figure
from msgspec import Struct, structs

import skyless
from skyless.core.air.masterless_packets import PairTdoa
from skyless.core.arrays import Array, Matrix, Vector
from skyless.core.errors import ConfigurationError, SkylessError
from skyless.core.fix import Fix
from skyless.core.native import records
from skyless.core.native.arithmetic import square
from skyless.core.native.library import KERNELS, compiled
from skyless.core.native.records import Reals, Record, record
from skyless.core.native.views import view
from skyless.files import replace_files, write_whole
from skyless.research.calibration.biases import biases_of, tdoas_of
from skyless.research.calibration.options import CalibrateOptions
from skyless.research.foreign.formats import format_of, open_recording
from skyless.research.replays.captures import CaptureReplay, known_anchors, known_truth
from skyless.research.replays.options import BenchmarkOptions, ReplayOptions
from skyless.research.replays.site import SITE_FORMAT, SiteReplay
from skyless.run.recordings.recording import McapRecording, is_mcap
from skyless.sim.evaluation.figures import Figures, FixTable, Judged, figures_of, truth_at
from skyless.site.report import bullets, page, panel, picture, report_style, svg_figure, table
from skyless.site.survey.anchor_errors import DifferenceCalibration

# Which recordings lie below a folder, and what belongs to each: its truth and its anchors.

_TABLE: Final = re.compile(r"_(?:tdoa|data)(?=\.)")
_TRUTHS: Final = ("_pose", "_truth", "_lighthouse")
"""``NAME_tdoa.csv`` has its truth in ``NAME_pose.csv``, or with another of these words."""

_ANCHORS: Final = ("anchors*.csv", "anchors/anchors*.csv", "anchor_positions.yaml")

_SMALLEST: Final = 200
"""Smallest size of a recording in bytes."""


class Found(Struct, frozen=True):
    """A recording with its companion files."""

    name: str
    """Path relative to the folder, without endings."""
    path: Path
    format: str
    truth: Path | None = None
    """Table of the body's positions beside it."""
    anchors: Path | None = None
    has_body_truth: bool = False
    """Whether the truth, in the table or in the recording, is of the body that carries the antenna."""


def recordings_below(folder: Path) -> Iterator[Found]:
    """All readable recordings, recognised by content, in order of name."""
    paths = sorted(path for path in folder.rglob("*") if path.is_file() and not path.name.startswith("."))
    truths = {companion for path in paths if (companion := truth_of(path))}
    for path in paths:
        if path in truths or path.stat().st_size < _SMALLEST or "anchors" in path.name:
            continue
        name, truth = re.sub(r"\.[\w.]+$", "", str(path.relative_to(folder))), truth_of(path)
        if is_mcap(path):
            yield Found(name, path, SITE_FORMAT)
            continue
        try:
            kind = format_of(path)
        except ConfigurationError:
            continue
        is_of_body = truth is not None
        if truth is None and kind.truth_is_of_body and kind.read_truth is not None:
            is_of_body = kind.read_truth(path, None) is not None
        yield Found(name, path, kind.name, truth, anchors_of(path, folder), is_of_body)


def truth_of(path: Path) -> Path | None:
    """The table of truth beside a recording."""
    companions = (path.with_name(_TABLE.sub(word, path.name)) for word in _TRUTHS if _TABLE.search(path.name))
    return next((one for one in companions if one.is_file()), None)


def anchors_of(path: Path, folder: Path) -> Path | None:
    """The nearest table of anchors: one of ``_ANCHORS`` beside the recording or above.

    Of several, the one whose suffix is in the recording's path, as ``const1`` of ``anchors_const1.csv``.
    """
    for place in (one for one in path.parents if one == folder or folder in one.parents):
        tables = sorted(table for name in _ANCHORS for table in place.glob(name))
        fitting = [table for table in tables if table.stem.partition("_")[2] in path.parts]
        if fitting or len(tables) == 1:
            return (fitting or tables)[0]
    return None


# What ``joint`` is compared with: extended Kalman filters of position and velocity, with two rules of gating.
#
# Both get time differences, start at the truth where it is known, know no faults and never start again.
#
# - *Gate*: a difference is used if its innovation is within three standard deviations of what the filter expects.
# - *Bitcraze*: the rule of its firmware since 2023, as described in "New Loco TDoA outlier filter"
#   (https://www.bitcraze.io/2023/03/new-loco-tdoa-outlier-filter/): a difference that exceeds the distance of its
#   anchors is refused; an error up to two standard deviations of a measurement adds the time since the one before to a
#   sum of at most 0.3 s, a larger one subtracts it. The filter closes when the sum is nearly full, and then refuses
#   errors of more than two and a half standard deviations; it opens again when the sum is nearly empty.

GATE, BITCRAZE = range(2)
TDOA_STD_M: Final = {GATE: 0.22, BITCRAZE: 0.15}
"""Noise of a difference: untuned, and the default of Bitcraze's firmware."""

QA_M2PS3: Final = 2.0
"""Spectral density of the acceleration. From 1 to 9, errors of most flights change by less than a tenth; from 4 on
some noisy logs diverge."""

GATE_STD: Final = 3.0
START_STD_M: Final = 0.1
START_STD_MPS: Final = 0.1
SUM_S: Final = 0.3
LONGEST_ADDED_S: Final = 0.03
CLOSES, OPENS = 0.9, 0.1
TRUSTED_STD, ACCEPTED_STD = 2.0, 2.5


def plain_track(
    rule: int, time_s: Vector, tdoa_m: Vector, a_m: Matrix, b_m: Matrix, start: Vector, is_planar: bool
) -> tuple[Matrix, Array]:
    """Positions after each of n differences, shape (n, 3), and their covariances, shape (n, 3, 3).

    ``a_m`` and ``b_m``: the anchors' positions, shape (n, 3); a difference is the range to b minus that to a.
    ``start``: position and velocity, shape (6,); the height is fixed if ``is_planar``.
    """
    axes = np.array([1.0, 1.0, 0.0 if is_planar else 1.0])
    t = PlainTrack(is_open=True, time_s=float(time_s[0]))
    view(t.x)[:], view(t.qa)[:] = start, QA_M2PS3 * axes
    view(t.P)[:] = np.diag(np.concatenate([axes * START_STD_M**2, axes * START_STD_MPS**2]))
    positions_m, covariances_m2 = np.empty((len(time_s), 3)), np.empty((len(time_s), 3, 3))
    compiled(run_plain, KERNELS)(
        t,
        rule,
        TDOA_STD_M[rule],
        np.ascontiguousarray(time_s),
        np.ascontiguousarray(tdoa_m),
        np.concatenate((a_m, b_m), axis=1).reshape(-1),
        len(time_s),
        positions_m.reshape(-1),
        covariances_m2.reshape(-1),
    )
    return positions_m, covariances_m2


@record
class PlainTrack(Record):
    """State of ``run_plain``."""

    time_s: float
    good_s: float
    is_open: bool
    x: Annotated[Reals, 6]
    qa: Annotated[Reals, 3]
    P: Annotated[records.Matrix, 6, 6]
    H: Annotated[Reals, 3]
    PH: Annotated[Reals, 6]


def run_plain(
    t: PlainTrack,
    rule: int,
    std_m: float,
    times_s: Reals,
    tdoas_m: Reals,
    places_m: Reals,
    count: int,
    positions_m: Reals,
    covariances_m2: Reals,
) -> None:
    """Run the filter over differences; ``places_m``: of each, the first anchor's position and the second's."""
    x, P = t.x, t.P
    for n in range(count):
        dt_s = times_s[n] - t.time_s
        t.time_s = times_s[n]
        predict_plain(t, dt_s)
        range_a, range_b, apart_m = 0.0, 0.0, 0.0
        for i in range(3):
            range_a += square(x[i] - places_m[6 * n + i])
            range_b += square(x[i] - places_m[6 * n + 3 + i])
            apart_m += square(places_m[6 * n + 3 + i] - places_m[6 * n + i])
        range_a, range_b = sqrt(range_a), sqrt(range_b)
        for i in range(3):
            t.H[i] = (x[i] - places_m[6 * n + 3 + i]) / range_b - (x[i] - places_m[6 * n + i]) / range_a
        innovation, S = tdoas_m[n] - (range_b - range_a), find_variance(t, std_m)
        if rule == GATE:
            used = innovation * innovation <= GATE_STD * GATE_STD * S
        elif abs(tdoas_m[n]) >= sqrt(apart_m):
            used = False
        else:
            used = t.is_open or abs(innovation) < ACCEPTED_STD * std_m
            note_innovation(t, innovation, std_m, dt_s)
        if used:
            for i in range(6):
                x[i] += t.PH[i] * (innovation / S)
                for j in range(6):
                    P[i][j] -= t.PH[i] * t.PH[j] / S
        for i in range(3):
            positions_m[3 * n + i] = x[i]
            for j in range(3):
                covariances_m2[9 * n + 3 * i + j] = P[i][j]


def predict_plain(t: PlainTrack, dt_s: float) -> None:
    """Predict the state: x = F·x and P = F·P·Fᵀ + Q."""
    x, P = t.x, t.P
    for i in range(3):
        x[i] += dt_s * x[i + 3]
        for j in range(6):
            P[i][j] += dt_s * P[i + 3][j]
    for i in range(3):
        for j in range(6):
            P[j][i] += dt_s * P[j][i + 3]
    for i in range(3):
        P[i][i] += t.qa[i] * dt_s * dt_s * dt_s / 3.0
        P[i][i + 3] += t.qa[i] * dt_s * dt_s / 2.0
        P[i + 3][i] += t.qa[i] * dt_s * dt_s / 2.0
        P[i + 3][i + 3] += t.qa[i] * dt_s


def find_variance(t: PlainTrack, std_m: float) -> float:
    """Compute P·Hᵀ. Returns the innovation's variance S = H·P·Hᵀ + R."""
    S = std_m * std_m
    for i in range(6):
        t.PH[i] = t.P[i][0] * t.H[0] + t.P[i][1] * t.H[1] + t.P[i][2] * t.H[2]
    for i in range(3):
        S += t.H[i] * t.PH[i]
    return S


def note_innovation(t: PlainTrack, innovation: float, std_m: float, dt_s: float) -> None:
    """Open or close the filter by Bitcraze's rule."""
    added_s = min(dt_s, LONGEST_ADDED_S)
    if abs(innovation) < TRUSTED_STD * std_m:
        t.good_s = min(t.good_s + added_s, SUM_S)
    else:
        t.good_s = max(t.good_s - added_s, 0.0)
    t.is_open = t.good_s <= CLOSES * SUM_S if t.is_open else t.good_s < OPENS * SUM_S


# Estimators without a filter, as they are written in an afternoon: a gradient, and least squares over a window.

_STEP: Final = 0.2
"""Share of a difference's error corrected in one step."""

_WINDOW, _BETWEEN, _ITERATIONS = 30, 10, 5
"""Differences per fit, differences between fits, and iterations of each fit."""


class Gradient:
    """Steps down the gradient of each difference's error, starting between the first two anchors."""

    def __init__(self) -> None:
        self._position_m: Vector | None = None

    def hear(self, observation: PairTdoa) -> Fix | None:
        """Process one time difference; see ``OwnEstimator``."""
        a_m, b_m = np.array([observation.a_m]), np.array([observation.b_m])
        if self._position_m is None:
            self._position_m = (a_m + b_m)[0] / 2.0
        (error_m,), (slope,) = _errors(self._position_m, a_m, b_m, np.array([observation.tdoa_m]))
        self._position_m += _STEP * error_m * slope / max(float(slope @ slope), 0.1)
        return Fix.of(observation.time_s, self._position_m.tolist())


class LeastSquares:
    """Fits a position to the newest differences by Gauss–Newton, starting from the previous one."""

    def __init__(self) -> None:
        self._rows: list[tuple[float, ...]] = []
        self._position_m: Vector | None = None

    def hear(self, observation: PairTdoa) -> Fix | None:
        """Process one time difference; see ``OwnEstimator``."""
        self._rows.append((*(observation.a_m or ()), *(observation.b_m or ()), observation.tdoa_m))
        if len(self._rows) < _WINDOW:
            return None
        rows = np.array(self._rows)
        del self._rows[:_BETWEEN]
        position_m = rows[:, :3].mean(axis=0) if self._position_m is None else self._position_m.copy()
        for _ in range(_ITERATIONS):
            errors_m, slopes = _errors(position_m, rows[:, :3], rows[:, 3:6], rows[:, 6])
            position_m += np.linalg.lstsq(slopes, errors_m, rcond=1e-2)[0]
        self._position_m = position_m
        return Fix.of(observation.time_s, position_m.tolist())


def _errors(position_m: Vector, a_m: Array, b_m: Array, tdoa_m: Vector) -> tuple[Vector, Array]:
    """Residuals of differences at a position, shape (n,), and their gradients there, shape (n, 3)."""
    to_a, to_b = position_m - a_m, position_m - b_m
    range_a, range_b = (np.maximum(np.linalg.norm(to, axis=1), 1e-3) for to in (to_a, to_b))
    return tdoa_m - (range_b - range_a), to_b / range_b[:, None] - to_a / range_a[:, None]


JOINT, SMOOTHED, CALIBRATED, PLAIN, BITCRAZE_RULE = "joint", "joint-smoothed", "joint-calibrated", "gate", "bitcraze"
RULES: Final = {PLAIN: GATE, BITCRAZE_RULE: BITCRAZE}
SIMPLE: Final = {"gradient": Gradient, "least-squares": LeastSquares}
BEST: Final = "best simple"
"""The best of ``PLAIN`` and ``SIMPLE`` on each recording, chosen in hindsight."""

DRAWN: Final = 600
"""Fixes of a recording in its pictures."""

SPEED_OVER_S: Final = 0.1
"""The plain filters start with the truth's mean velocity over this time."""


class Result(Struct, frozen=True):
    """A recording's result by one method."""

    recording: str
    method: str
    figures: Figures | None
    reason: str = ""
    """Why there are no figures."""
    drawn: tuple[tuple[float | None, ...], ...] = ()
    """Rows of time, position, truth and levels of an even sample of the fixes; None if unknown."""


def is_calibrated_on(found: Found, asked: BenchmarkOptions) -> bool:
    """Whether the anchors are calibrated on this recording."""
    named = any(word in found.name for word in asked.calibrate_on)
    return named and found.truth is not None and found.anchors is not None


def methods_of(found: Found, asked: BenchmarkOptions, calibrated: Collection[Path | None]) -> Iterator[str]:
    """Methods for replaying a recording; ``calibrated``: tables of anchors that are calibrated."""
    yield JOINT
    if found.format == SITE_FORMAT:
        return
    yield from (*(() if asked.quick else (SMOOTHED,)), PLAIN, BITCRAZE_RULE, *SIMPLE)
    if found.anchors in calibrated and not is_calibrated_on(found, asked):
        yield CALIBRATED
    yield from asked.estimators


def results_of(
    found: Sequence[Found], asked: BenchmarkOptions, kept: Path, on_progress: Callable[[float], None]
) -> Iterator[Result]:
    """Yield all results as they come; those in the folder ``kept`` are not computed again."""
    calibrated = {one.anchors for one in found if is_calibrated_on(one, asked)}
    cells = [(one, method) for one in found for method in methods_of(one, asked, calibrated)]
    calibrations: dict[Path, DifferenceCalibration] = {}
    for number, (one, method) in enumerate(cells):
        file = kept / f"{_key(one, method, asked)}.json"
        results = _kept(file)
        if results is None:
            try:
                if method == CALIBRATED and not calibrations:
                    calibrations = _calibrations(found, asked)
                results = tuple(_results(one, method, asked, calibrations))
            except SkylessError as error:
                results = (Result(one.name, method, None, str(error)),)
            write_whole(file, msgspec.json.encode(results))
        on_progress((number + 1) / len(cells))
        yield from results


def with_best(results: Sequence[Result]) -> Iterator[Result]:
    """The results, plus for each recording the one of ``PLAIN`` and ``SIMPLE`` with the smallest error."""
    yield from results
    simple = [
        (figures.rmse_3d_m or figures.rmse_2d_m or np.inf, one)  # in 3-D if the recording has heights
        for one in results
        if one.method in {PLAIN, *SIMPLE} and (figures := one.figures)
    ]
    for recording in dict.fromkeys(one.recording for _, one in simple):
        errors = [(m, one) for m, one in simple if one.recording == recording and np.isfinite(m)]
        if errors:
            yield structs.replace(min(errors, key=lambda error: error[0])[1], method=BEST, drawn=())


def _kept(file: Path) -> tuple[Result, ...] | None:
    """Results of an earlier run; None if missing or damaged."""
    try:
        return msgspec.json.decode(file.read_bytes(), type=tuple[Result, ...])
    except (FileNotFoundError, msgspec.DecodeError):
        return None


@cache
def _newest_source() -> int:
    """Time of the last change of the program."""
    return max(source.stat().st_mtime_ns for source in Path(skyless.__file__).parent.rglob("*.py"))


def _key(found: Found, method: str, asked: BenchmarkOptions) -> str:
    """Name of a result; anything that could change the result changes the name."""
    program = asked.program if method in asked.estimators else None
    files = [one for one in (found.path, found.truth, found.anchors, program) if one]
    states = [(str(one), one.stat().st_size, one.stat().st_mtime_ns) for one in files if one.is_file()]
    given = (
        _newest_source(),
        states,
        method,
        asked.lever_arm_m,
        asked.seconds,
        tuple(asked.calibrate_on) * (method == CALIBRATED),
    )
    return hashlib.sha256(repr(given).encode()).hexdigest()[:24]


def _results(
    found: Found, method: str, asked: BenchmarkOptions, calibrations: Mapping[Path, DifferenceCalibration]
) -> Iterator[Result]:
    if found.format == SITE_FORMAT:
        yield from _site_results(found)
        return
    estimator = {**SIMPLE, **asked.estimators}.get(method)
    options = structs.replace(_options(found, asked), smooth=method == SMOOTHED, estimator=estimator)
    calibration = None
    if method == CALIBRATED:
        assert found.anchors is not None
        calibration = calibrations[found.anchors]
    run = CaptureReplay(options, calibration)
    if method in RULES:
        table, judged = _plain(found, options, run, RULES[method])
        yield _result(found.name, method, table, judged, None)
        return
    report = run.run(None, lambda _: None)
    if report.reason is not None:
        raise SkylessError(f"no fix: {report.reason}")
    yield _result(found.name, method, run.samples.table(), run.judged, run.samples.count)


def _site_results(found: Found) -> Iterator[Result]:
    with McapRecording(found.path) as recording:
        run = SiteReplay(recording)
        run.run(None, lambda _: None)
    for tag, replay in run.tags.items():
        yield _result(f"{found.name} {tag}", JOINT, replay.samples.table(), run.judged(tag), replay.samples.count)


def _options(found: Found, asked: BenchmarkOptions) -> ReplayOptions:
    arm_m = asked.lever_arm_m if found.has_body_truth else None
    return ReplayOptions(
        found.path,
        anchors=found.anchors,
        truth=found.truth,
        lever_arm_m=arm_m,
        uncalibrated=True,
        first_s=asked.seconds,
    )


def _calibrations(found: Sequence[Found], asked: BenchmarkOptions) -> dict[Path, DifferenceCalibration]:
    """What ``skyless calibrate`` finds on the named recordings, by their tables of anchors."""
    calibrations: dict[Path, DifferenceCalibration] = {}
    for one in found:
        if is_calibrated_on(one, asked) and one.anchors is not None:
            truth = known_truth(one.path, _options(one, asked))
            assert truth is not None
            rows = np.column_stack([truth.t_s, truth.position_m])
            known = CalibrateOptions(file=one.path, truth=rows, anchors=known_anchors(one.anchors, None)[0])
            calibrations.setdefault(one.anchors, biases_of(known).estimate.calibration())
    return calibrations


def _plain(found: Found, options: ReplayOptions, run: CaptureReplay, rule: int) -> tuple[FixTable, Judged]:
    anchors_m = run.known_m
    with open_recording(found.path, anchors_m=anchors_m) as recording:
        rows = [row for pair in tdoas_of(recording, anchors_m) if (row := _row(pair, anchors_m)) is not None]
    if not rows:
        raise SkylessError("no time difference of known anchors")
    table = np.array(rows)
    judged = structs.replace(run.judged, begin_s=float(table[0, 0]), end_s=float(table[-1, 0]))
    if options.first_s is not None:
        table = table[table[:, 0] - table[0, 0] <= options.first_s]
    truth_m = truth_at(judged.truth, table[:, 0])
    known = np.flatnonzero(np.isfinite(truth_m[:, 0]))
    start, begin = np.zeros(6), 0
    start[:3] = table[:, 2:5].mean(axis=0)
    if len(known):
        begin = int(known[0])
        start[:3] = truth_m[begin]
        soon_m = truth_at(judged.truth, table[begin : begin + 1, 0] + SPEED_OVER_S)[0]
        start[3:] = np.nan_to_num((soon_m - start[:3]) / SPEED_OVER_S)
    if run.height_m is not None:
        start[2], start[5] = run.height_m, 0.0
    columns = table[begin:, 0], table[begin:, 1], table[begin:, 2:5], table[begin:, 5:8]
    position_m, covariance_m2 = plain_track(rule, *columns, start, run.height_m is not None)
    count = len(position_m)
    return FixTable(columns[0], position_m, covariance_m2, np.full((count, 2), np.nan), np.full(count, -1.0)), judged


def _row(pair: PairTdoa, anchors_m: Mapping[int, tuple[float, float, float]]) -> tuple[float, ...] | None:
    a_m, b_m = pair.a_m or anchors_m.get(pair.anchor_a), pair.b_m or anchors_m.get(pair.anchor_b)
    return None if a_m is None or b_m is None else (pair.time_s, pair.tdoa_m, *a_m, *b_m)


def _result(name: str, method: str, table: FixTable, judged: Judged, count: int | None) -> Result:
    kept = slice(None, None, max(len(table.time_s) // DRAWN, 1))
    times_s: Vector = table.time_s[kept]
    rows: Matrix = np.column_stack([
        times_s, table.position_m[kept], judged.of(times_s)[0], table.levels_m[kept]
    ])  # fmt: skip
    drawn = tuple(tuple(None if np.isnan(value) else round(value, 4) for value in row) for row in rows.tolist())
    return Result(name, method, figures_of(table, judged, count), drawn=drawn)


# A benchmark as a page, a table and JSON.

_HEADS: Final = (
    *("recording", "method", "judged", "RMSE 2-D", "3-D", "50 %", "95 %", "largest", "bias x, y, z", "σ", "NEES"),
    *("beyond 95 %", "levels", "exceeded h, v", "median level", "available", "first fix", "ATE", "RPE"),
)
_NUMBERS: Final = tuple(
    name
    for name in Figures.__struct_fields__
    if name not in {"left_out", "alerts", "median_m", "std_m", "rmse_axes_m", "bias_m"}
)
_TRIPLES: Final = ("median_m", "std_m", "rmse_axes_m", "bias_m")
_DIVERGED_M: Final = 1.0
"""What has a larger error has lost the tag: no ratio to it is made."""


def write(folder: Path, results: Sequence[Result], title: str, command: str) -> None:
    """Write ``index.html``, ``results.csv`` and ``results.json`` into the folder. Raises OSError."""
    without_drawn = [structs.replace(one, drawn=()) for one in results]
    table_of_all = StringIO()
    rows = csv.writer(table_of_all)
    axes = (f"{name[:-1]}{axis}_m" for name in _TRIPLES for axis in "xyz")
    rows.writerow(["recording", "method", "reason", *_NUMBERS, *axes])
    rows.writerows(_csv_row(one) for one in results)
    files = {
        "results.json": msgspec.json.format(msgspec.json.encode(without_drawn), indent=1),
        "results.csv": table_of_all.getvalue().encode(),
        "index.html": _page(results, title, command).encode(),
    }
    replace_files({folder / name: data for name, data in files.items()})


def _csv_row(result: Result) -> list[object]:
    found = result.figures or Figures()
    triples = (value for name in _TRIPLES for value in getattr(found, name) or (None, None, None))
    return [result.recording, result.method, result.reason, *(getattr(found, name) for name in _NUMBERS), *triples]


def ratios(results: Sequence[Result], method: str, other_method: str = PLAIN) -> dict[str, float | int]:
    """Geometric means of a method's errors over another's, of recordings that both were judged on."""
    others = {one.recording: one.figures for one in results if one.method == other_method and one.figures is not None}
    found: dict[str, list[float]] = defaultdict(list)
    for one in results:
        other = others.get(one.recording)
        if one.method == method and one.figures is not None and other is not None:
            for name in ("rmse_2d_m", "rmse_3d_m"):
                mine_m, its_m = getattr(one.figures, name), getattr(other, name)
                if mine_m is not None and its_m is not None and its_m < _DIVERGED_M:
                    found[name].append(float(np.log(mine_m / its_m)))
    means: dict[str, float | int] = {name: float(np.exp(np.mean(logs))) for name, logs in found.items()}
    return {**means, "recordings": len(found["rmse_2d_m"])}


def summary_rows(results: Sequence[Result]) -> Iterator[tuple[str, ...]]:
    """One line for each method: ratios to the plain filter and to the best simple one, NEES, and levels exceeded."""
    for method in dict.fromkeys(one.method for one in results):
        found = [ratios(results, method, other) for other in (PLAIN, BEST)]
        judged = [one.figures for one in results if one.method == method and one.figures and one.figures.judged]
        nees = [one.nees for one in judged if one.nees is not None]
        exceeded = (sum(getattr(one, f"exceeded_{way}") for one in judged) for way in ("horizontal", "vertical"))
        yield (
            method,
            f"{len(judged)}",
            *(_number(ratio.get(name), ".3f") for ratio in found for name in ("rmse_2d_m", "rmse_3d_m")),
            f"{np.median(nees):.2f} ({min(nees):.2f} to {max(nees):.2f})" if nees else "–",
            f"{sum(one.levels for one in judged)}",
            ", ".join(map(str, exceeded)),
        )


SUMMARY_HEADS: Final = (
    *("method", "recordings", "2-D / gate", "3-D / gate", "2-D / best simple", "3-D / best simple"),
    *("NEES", "levels", "exceeded h, v"),
)


def _page(results: Sequence[Result], title: str, command: str) -> str:
    by_recording: Mapping[str, list[Result]] = defaultdict(list)
    for one in results:
        by_recording[one.recording].append(one)
    failed = [f"{one.recording}, {one.method}: {one.reason}" for one in results if one.figures is None]
    rows = [_table_row(one) for one in results if one.figures is not None]
    parts = [
        f"<header><h1>{escape(title)}</h1>\n<p>Fixes are of methods as they stand. "
        "Figures are defined in <code>docs/recordings.md</code>; lengths in metres. Made by "
        f"<code>{escape(command)}</code>; the same figures are in <code>results.csv</code> and "
        "<code>results.json</code>.</p></header>",
        "<section><h2>Methods</h2>",
        table(SUMMARY_HEADS, summary_rows(results)),
        "<p class='note'>Ratios are geometric means of RMSE over that of the plain filter with a gate (gate), "
        "and over that of the best of it, gradient and least squares on each recording (best simple), of recordings "
        "where that is below 1 m.</p>"
        "</section><section><h2>Recordings</h2>",
        table(_HEADS, rows),
        "</section>",
    ]
    if failed:
        parts.append("<section><h2>Left out</h2>" + bullets(failed, "warning") + "</section>")
    parts += [_section(number, name, ones) for number, (name, ones) in enumerate(by_recording.items())]
    return page(title, parts)


def _table_row(result: Result) -> tuple[str, ...]:
    found = result.figures
    assert found is not None
    over = "3d" if found.rmse_3d_m is not None else "2d"
    of_all = (getattr(found, f"{name}_{over}_m") for name in ("p50", "p95", "max"))
    return (
        *(result.recording, result.method, f"{found.judged}, {found.judged_s:.0f} s"),
        *(_number(value, ".3f") for value in (found.rmse_2d_m, found.rmse_3d_m, *of_all)),
        "–" if found.bias_m is None else ", ".join(f"{value:.3f}" for value in found.bias_m),
        _number(getattr(found, f"sigma_{over}_m"), ".3f"),
        _number(found.nees, ".2f"),
        _number(found.beyond_95, ".1%"),
        f"{found.levels}",
        f"{found.exceeded_horizontal}, {found.exceeded_vertical}",
        _number(found.hpl_m, ".2f"),
        _number(found.availability, ".1%"),
        _number(found.first_fix_s, ".2f"),
        *(_number(value, ".3f") for value in (found.ate_m, found.rpe_m)),
    )


def _number(value: float | None, form: str) -> str:
    return "–" if value is None else format(value, form)


def _section(number: int, name: str, results: Sequence[Result]) -> str:
    drawn = {one.method: np.array(one.drawn, dtype=np.float64) for one in results if one.drawn}
    if not drawn:
        return ""
    with report_style():
        panels = {
            "Map; the line is the truth": _map(drawn),
            "Error over time": _over_time(drawn),
            f"Horizontal errors of {JOINT} and its protection levels (Stanford diagram)": _levels(drawn),
        }
        figures = "\n".join(
            svg_figure(picture(figure, "svg", 60.0), f"recording{number}_{place}", caption)
            for place, (caption, figure) in enumerate(panels.items())
        )
    return f"<section><h2>{escape(name)}</h2><div class='panels'>{figures}</div></section>"


def _map(drawn: Mapping[str, Matrix]) -> Figure:
    """Of rows of time, position, truth and levels by method."""
    figure, axes = panel("")
    truth_m = next(iter(drawn.values()))[:, 4:6]
    for method, rows in drawn.items():
        axes.plot(rows[:, 1], rows[:, 2], ".", markersize=2, rasterized=True, label=method)
    axes.plot(*truth_m.T, color="black", linewidth=0.7)
    if np.isfinite(truth_m).any():  # a filter that has lost its tag shall not fill the map
        low_m, high_m = np.nanmin(truth_m, axis=0) - 1.0, np.nanmax(truth_m, axis=0) + 1.0
        axes.set(xlim=(low_m[0], high_m[0]), ylim=(low_m[1], high_m[1]))
    axes.set(xlabel="x in m", ylabel="y in m", aspect="equal")
    return figure


def _over_time(drawn: Mapping[str, Matrix]) -> Figure:
    figure, axes = panel("")
    begin_s = min(rows[0, 0] for rows in drawn.values())
    for method, rows in drawn.items():
        error_m = np.linalg.norm(rows[:, 1:4] - rows[:, 4:7], axis=1)
        axes.plot(rows[:, 0] - begin_s, error_m, linewidth=0.7, label=method)
    axes.set(xlabel="time in s", ylabel="error in m", yscale="log")
    axes.legend(fontsize="x-small")
    return figure


def _levels(drawn: Mapping[str, Matrix]) -> Figure:
    figure, axes = panel("")
    rows = drawn.get(JOINT, np.empty((0, 9)))
    error_m = np.linalg.norm(rows[:, 1:3] - rows[:, 4:6], axis=1)
    most_m = 1.05 * float(np.nanmax([*error_m, *rows[:, 7], 0.1]))
    axes.plot(error_m, rows[:, 7], ".", markersize=2, rasterized=True)
    axes.plot([0.0, most_m], [0.0, most_m], color="black", linewidth=0.7)
    axes.set(xlabel="error in m", ylabel="level in m", xlim=(0.0, most_m), ylim=(0.0, most_m))
    return figure
