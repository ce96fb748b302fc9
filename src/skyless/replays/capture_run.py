"""All of ``skyless replay`` on a recording of another system, but for what it writes."""

from collections import Counter
from itertools import islice
from pathlib import Path
from typing import Any, Final

import msgspec
import numpy as np
from msgspec import Struct

from skyless.air.masterless_packets import Packet, Point
from skyless.errors import ConfigurationError, SkylessError
from skyless.evaluation.judge import Judge
from skyless.positioning.masterless.anchor_errors import DifferenceCalibration
from skyless.recordings.foreign.avalue import anchor_distances_m
from skyless.recordings.foreign.formats import format_of, open_recording
from skyless.recordings.truth import Truth
from skyless.replays.captures import MEASUREMENTS, Replay, ReplayReport, ReplayRequest
from skyless.replays.inputs import flight_height, height_to_hold

_MOST_WITHOUT_ANCHORS: Final = 20_000
"""Records within which a recording that carries its anchors' positions has one of them."""

_MOST_TO_FIND_ANCHORS: Final = 2_000
"""Records within which every anchor of a recording of DL-TDoA is heard."""


class CaptureRequest(Struct, frozen=True):
    """What is asked of a replay, and what is known of the recording."""

    path: Path
    anchors_m: dict[int, Point]
    site_height_m: float | None = None
    """Height of the tags as a site file states it."""
    truth: Truth | None = None
    tag_height: float | str = "auto"
    """Metres, or one of ``inputs.HEIGHT_WORDS``."""
    tag_height_std_m: float | None = None
    settle_s: float | None = None
    above_m: float | None = None
    qa: float | None = None
    tdoa_std_m: float | None = None
    calibration: DifferenceCalibration | None = None
    measurements: str | None = None
    format: str | None = None
    listener: str | None = None


class CaptureRun:
    """One recording, its judge, and where the height is from."""

    def __init__(self, asked: CaptureRequest) -> None:
        """Open the recording. Raises SkylessError."""
        if asked.measurements not in {None, *MEASUREMENTS}:
            right = ", ".join(MEASUREMENTS)
            raise SkylessError(f"--measurements is {asked.measurements!r}; it should be one of {right}")
        anchors_m = asked.anchors_m
        if not anchors_m:
            _check_carries_anchors(asked)
            anchors_m = _stated_anchors(asked)
        truth, name = asked.truth, format_of(asked.path, asked.format).name
        height_m, std_m, self.height_note = height_to_hold(
            asked.tag_height, anchors_m, asked.site_height_m, truth, name
        )
        if asked.tag_height_std_m is not None:
            std_m = asked.tag_height_std_m
            if height_m is None:
                raise SkylessError(f"--tag-height-std is {std_m:g}; it should be left out: the height is estimated")
        settle_s = asked.settle_s if asked.settle_s is not None else (2.0 if truth is None else 3.0)
        above_m = flight_height(asked.above_m, truth)
        self._asked = asked
        self.judge = Judge(truth, planar=height_m is not None, settle_s=settle_s, above_m=above_m)
        request = ReplayRequest(
            path=asked.path,
            anchors_m=anchors_m,
            format=asked.format,
            listener=asked.listener,
            height_m=height_m,
            height_std_m=std_m,
            qa=asked.qa,
            tdoa_std_m=asked.tdoa_std_m,
            calibration=asked.calibration,
            measurements=asked.measurements,
        )
        self.replay = Replay(request, self.judge)

    def check(self, report: ReplayReport, truth_table: Path | None) -> None:
        """See that the listener was in the recording, and that the table of truth was of it. Raises SkylessError."""
        if self._asked.listener is not None and report.receptions == 0:
            right = "one that the recording names"
            raise ConfigurationError(self._asked.path, "listener", self._asked.listener, right)
        if truth_table is not None and self._asked.truth is not None:
            _check_times(truth_table, self._asked.truth, self.judge)

    def summary(self, report: ReplayReport) -> dict[str, Any]:
        """The report as one tree of plain values."""
        distances = distances_of(self._asked.path, report.format)
        return {**msgspec.to_builtins(report), "height_note": self.height_note, "anchor_distances_m": distances}


def _check_carries_anchors(asked: CaptureRequest) -> None:
    """See that a recording without a table of anchors says something of them itself, before the whole of it is read.

    Raises SkylessError.
    """
    read = 0
    with open_recording(asked.path, asked.format, asked.listener) as recording:
        for read, record in enumerate(islice(recording, _MOST_WITHOUT_ANCHORS), start=1):  # noqa: B007 - used below
            if any(getattr(record, name, None) is not None for name in ("position_m", "a_m", "b_m")):
                return
        name = recording.format.name
    if read and not distances_of(asked.path, name):  # those are worth a replay by themselves
        raise SkylessError(
            f"--anchors is missing: {asked.path} ({name}) does not say where its anchors are; give their table, "
            "id,x_m,y_m,z_m, or --site"
        )


def _stated_anchors(asked: CaptureRequest) -> dict[int, Point]:
    """Where the anchors of a recording of DL-TDoA say that they are."""
    if not format_of(asked.path, asked.format).is_dl_tdoa:
        return {}
    with open_recording(asked.path, asked.format) as recording:
        packets = [record for record in islice(recording, _MOST_TO_FIND_ANCHORS) if isinstance(record, Packet)]
    return {packet.anchor: packet.position_m for packet in packets if packet.position_m is not None}


def _check_times(table: Path, truth: Truth, judge: Judge) -> None:
    """Fixes without any truth mean that the table belongs to another recording, or to another clock."""
    times_s, true_x_m = judge.track.rows[:, 0], judge.track.rows[:, 4]
    if len(times_s) and np.isnan(true_x_m).all():
        span = f"{truth.t_s[0]:.3f} to {truth.t_s[-1]:.3f}"
        expected = f"in the time of the recording, whose fixes are from {times_s.min():.3f} to {times_s.max():.3f}"
        raise ConfigurationError(table, "column t_s", span, expected)


def distances_of(file: Path, name: str) -> dict[str, float]:
    """Distances of the anchors, where the recording itself measures them."""
    if name != "avalue":
        return {}
    return {f"{a:X}-{b:X}": metres for (a, b), metres in sorted(anchor_distances_m(file, Counter()).items())}
