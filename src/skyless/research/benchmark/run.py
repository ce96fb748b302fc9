"""One recording by one method, judged; results that exist already are read instead."""

import hashlib
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Final

import msgspec
import numpy as np
from msgspec import Struct, structs

import skyless
from skyless.core.air.masterless_packets import PairTdoa
from skyless.core.arrays import Matrix, Vector
from skyless.core.errors import SkylessError
from skyless.core.whole_files import write_whole
from skyless.research.benchmark.plain import BITCRAZE, GATE, plain_track
from skyless.research.benchmark.recordings import Found
from skyless.research.benchmark.simple import Gradient, LeastSquares
from skyless.research.calibration.biases import biases_of, tdoas_of
from skyless.research.calibration.options import SurveyOptions
from skyless.research.foreign.formats import open_recording
from skyless.research.masterless.own_estimator import OwnEstimator
from skyless.research.replays.captures import CaptureReplay
from skyless.research.replays.inputs import known_anchors, known_truth
from skyless.research.replays.options import ReplayOptions
from skyless.research.replays.site import SITE_FORMAT, SiteReplay
from skyless.run.recordings.recording import McapRecording
from skyless.sim.evaluation.figures import Figures, FixTable, Judged, figures_of, truth_at
from skyless.site.survey.anchor_errors import DifferenceCalibration

JOINT, SMOOTHED, CALIBRATED, PLAIN, BITCRAZE_RULE = "joint", "joint-smoothed", "joint-calibrated", "gate", "bitcraze"
RULES: Final = {PLAIN: GATE, BITCRAZE_RULE: BITCRAZE}
SIMPLE: Final = {"gradient": Gradient, "least-squares": LeastSquares}
BEST: Final = "best simple"
"""The best of ``PLAIN`` and ``SIMPLE`` on each recording, known afterwards."""

DRAWN: Final = 600
"""Fixes of a recording that its pictures show."""

SPEED_OVER_S: Final = 0.1
"""The plain filters' velocity at the start is that of the truth over so long."""


class Result(Struct, frozen=True):
    """A recording by a method."""

    recording: str
    method: str
    figures: Figures | None
    reason: str = ""
    """Why there are no figures."""
    drawn: tuple[tuple[float | None, ...], ...] = ()
    """Rows of time, position, truth, and levels of an even sample of the fixes; None where it is not known."""


class Asked(Struct, frozen=True):
    """How recordings are replayed."""

    lever_arm_m: tuple[float, float, float] | None
    first_s: float | None
    calibrate_on: Sequence[str]
    estimators: Mapping[str, Callable[[], OwnEstimator]]
    """By their classes' names."""
    programs: tuple[Path, ...]
    """The files of the estimators."""
    smooth: bool = True

    def is_calibrated_on(self, found: Found) -> bool:
        """Whether the anchors are calibrated on this recording."""
        named = any(word in found.name for word in self.calibrate_on)
        return named and found.truth is not None and found.anchors is not None


def methods_of(found: Found, asked: Asked, calibrated: Collection[Path | None]) -> Iterator[str]:
    """The methods that a recording is replayed by; ``calibrated``: tables of anchors that are calibrated."""
    yield JOINT
    if found.format == SITE_FORMAT:
        return
    yield from (*((SMOOTHED,) if asked.smooth else ()), PLAIN, BITCRAZE_RULE, *SIMPLE)
    if found.anchors in calibrated and not asked.is_calibrated_on(found):
        yield CALIBRATED
    yield from asked.estimators


def results_of(
    found: Sequence[Found], asked: Asked, kept: Path, on_progress: Callable[[float], None]
) -> Iterator[Result]:
    """All results, as they come; those in the folder ``kept`` are not computed again."""
    calibrated = {one.anchors for one in found if asked.is_calibrated_on(one)}
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
    """The results, and for each recording that of ``PLAIN`` or ``SIMPLE`` with the smallest error once more."""
    yield from results
    simple = [(_error_m(one), one) for one in results if one.method in {PLAIN, *SIMPLE} and one.figures]
    for recording in dict.fromkeys(one.recording for _, one in simple):
        errors = [(m, one) for m, one in simple if one.recording == recording and np.isfinite(m)]
        if errors:
            yield structs.replace(min(errors, key=lambda error: error[0])[1], method=BEST, drawn=())


def _error_m(result: Result) -> float:
    """The RMSE, in 3-D where the recording has heights; infinite where there is none."""
    figures = result.figures
    return np.inf if figures is None else figures.rmse_3d_m or figures.rmse_2d_m or np.inf


def _kept(file: Path) -> tuple[Result, ...] | None:
    """Results of an earlier run; None where there are none, or they are damaged."""
    try:
        return msgspec.json.decode(file.read_bytes(), type=tuple[Result, ...])
    except (FileNotFoundError, msgspec.DecodeError):
        return None


@cache
def _newest_source() -> int:
    """When the program was last changed."""
    return max(source.stat().st_mtime_ns for source in Path(skyless.__file__).parent.rglob("*.py"))


def _key(found: Found, method: str, asked: Asked) -> str:
    """Name of a result: whatever could change it makes another one."""
    programs = asked.programs if method in asked.estimators else ()
    files = [one for one in (found.path, found.truth, found.anchors, *programs) if one]
    states = [(str(one), one.stat().st_size, one.stat().st_mtime_ns) for one in files if one.is_file()]
    given = (
        _newest_source(),
        states,
        method,
        asked.lever_arm_m,
        asked.first_s,
        tuple(asked.calibrate_on) * (method == CALIBRATED),
    )
    return hashlib.sha256(repr(given).encode()).hexdigest()[:24]


def _results(
    found: Found, method: str, asked: Asked, calibrations: Mapping[Path, DifferenceCalibration]
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
    for tag, samples in run.samples.items():
        yield _result(f"{found.name} {tag}", JOINT, samples.table(), run.judged(tag), samples.count)


def _options(found: Found, asked: Asked) -> ReplayOptions:
    arm_m = asked.lever_arm_m if found.has_body_truth else None
    return ReplayOptions(
        found.path,
        anchors=found.anchors,
        truth=found.truth,
        lever_arm_m=arm_m,
        uncalibrated=True,
        first_s=asked.first_s,
    )


def _calibrations(found: Sequence[Found], asked: Asked) -> dict[Path, DifferenceCalibration]:
    """What ``skyless survey`` finds on the named recordings, by their tables of anchors."""
    calibrations: dict[Path, DifferenceCalibration] = {}
    for one in found:
        if asked.is_calibrated_on(one) and one.anchors is not None:
            options = _options(one, asked)
            truth = known_truth(one.path, options)
            assert truth is not None
            rows = np.column_stack([truth.t_s, truth.position_m])
            survey = SurveyOptions(recording=one.path, truth=rows, anchors=known_anchors(one.anchors, None)[0])
            calibrations.setdefault(one.anchors, biases_of(survey).estimate.calibration())
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
