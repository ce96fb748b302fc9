"""A calibration from a recording to the anchors' constants, and to the antenna delays of a site."""

from collections import Counter
from functools import partial
from os import PathLike
from typing import Final

from msgspec import Struct

from skyless.air.masterless_packets import Point
from skyless.constants import TICK_M
from skyless.errors import ConfigurationError, SkylessError
from skyless.evaluation.judge import Judge
from skyless.recordings.foreign.formats import open_recording
from skyless.recordings.mcap.recording import McapRecording
from skyless.recordings.truth import Truth
from skyless.replay.site import SITE_FORMAT, recorded_site, recorded_truth
from skyless.site.check import SITE_LIMITS
from skyless.site.model import Site
from skyless.site.rewrite import DELAY_KEY
from skyless.survey.tags.estimate import CalibrationEstimate, estimate
from skyless.survey_inputs.samples import (
    First,
    PositionAt,
    Samples,
    Stay,
    gather,
    joined,
    position_of_stays,
    position_of_truth,
    site_tdoas,
    tdoas_of,
)

_DELAY: Final = SITE_LIMITS[f"anchors.{DELAY_KEY}"]


class CalibrationRequest(Struct, frozen=True):
    """What is asked of a calibration: a recording, and where its tag was."""

    path: str | PathLike[str]
    stays: tuple[Stay, ...] = ()
    truth: Truth | None = None
    above_m: float | None = None
    """Of the truth's height."""
    first: First = First()
    anchors_m: dict[int, Point] = {}
    height_m: float | None = None
    """Of stays without one."""
    format: str | None = None
    listener: str | None = None
    tag: str | None = None


class Calibrated(Struct, frozen=True):
    """What came of it."""

    format: str
    estimate: CalibrationEstimate
    samples: Samples
    site: Site | None
    """As recorded; None for recordings of other systems."""

    def tx_delays_ticks(self) -> dict[int, tuple[int, int]]:
        """Old and new TX antenna delay of every anchor whose constant is determined; empty without a site.

        A signal that leaves later than its stamp needs a larger delay. What an anchor's receptions are off shows
        in its clock, and so in the same differences; it goes into the TX delay as well.

        Raises:
            SkylessError: no radio has such a delay.
        """
        bias_m = {anchor.anchor: anchor.bias_m for anchor in self.estimate.anchors}
        changes: dict[int, tuple[int, int]] = {}
        for anchor in () if self.site is None else self.site.anchors:
            found_m = bias_m.get(anchor.id)
            if found_m is None:
                continue
            ticks = anchor.tx_antenna_delay_ticks + round(found_m / TICK_M)
            if not _DELAY.contains(ticks):
                raise SkylessError(f"anchor {anchor.id} would need an antenna delay of {ticks}; it should be {_DELAY}")
            changes[anchor.id] = (anchor.tx_antenna_delay_ticks, ticks)
        return changes


def calibrate_capture(request: CalibrationRequest) -> Calibrated:
    """Calibrate the anchors of another system; the zero is the mean of their constants.

    Raises:
        SkylessError: the recording cannot be used, or holds nothing at a known position.
    """
    with open_recording(request.path, request.format, request.listener) as recording:
        tdoas = tdoas_of(recording, request.anchors_m)
        samples = gather(tdoas, request.anchors_m, partial(_position_from, request, request.truth), request.first)
        name = recording.format.name
    _require_some(samples)
    return Calibrated(name, estimate(samples.differences), samples, None)


def calibrate_site(request: CalibrationRequest, identifier: int | None) -> Calibrated:
    """Calibrate the anchors of a site from a recording of ``skyless record``; the zero is the master.

    Raises:
        SkylessError: the recording cannot be used, is of another site than ``identifier``, or holds nothing at a
            known position.
    """
    with McapRecording(request.path) as recording:
        site = recorded_site(recording, identifier)
        samples = joined([_of_tag(recording, site, tag, request) for tag in _tags(recording, request)])
    _require_some(samples)
    master = int(samples.differences.anchor_a[0])
    return Calibrated(SITE_FORMAT, estimate(samples.differences, zero=master, slope=False), samples, site)


def _tags(recording: McapRecording, request: CalibrationRequest) -> tuple[str, ...]:
    raw = recording.summary().raw_tags
    if not raw:
        raise ConfigurationError(request.path, "raw receptions", None, "a recording that skyless record made")
    names = ", ".join(raw)
    if request.tag is not None:
        if request.tag not in raw:
            raise ConfigurationError(request.path, "tag", request.tag, f"one of {names}")
        return (request.tag,)
    if len(raw) > 1 and (request.stays or request.truth is not None):
        raise SkylessError(f"--tag is missing; it should name the tag whose position is known, one of {names}")
    return raw


def _of_tag(recording: McapRecording, site: Site, tag: str, request: CalibrationRequest) -> Samples:
    anchors_m = {anchor.id: (anchor.x_m, anchor.y_m, anchor.z_m) for anchor in site.anchors}
    truth = recorded_truth(recording).get(tag) if request.truth is None else request.truth
    at_rest = CalibrationRequest(
        request.path, request.stays, truth, request.above_m, height_m=site.tags.height_m, tag=tag
    )
    drops: Counter[str] = Counter()
    tdoas = site_tdoas(recording, (tag,), site.id, drops)
    samples = gather(tdoas, anchors_m, partial(_position_from, at_rest, truth), request.first)
    return Samples(samples.differences, samples.anchors_m, samples.seen, samples.drops | drops)


def _position_from(request: CalibrationRequest, truth: Truth | None, begin_s: float) -> PositionAt:
    if request.stays:
        return position_of_stays(request.stays, request.height_m, begin_s)
    return position_of_truth(Judge(truth, planar=False), request.above_m)


def _require_some(samples: Samples) -> None:
    if len(samples.differences.t_s):
        return
    reasons = ", ".join(f"{count} × {reason}" for reason, count in samples.drops.items())
    raise SkylessError(
        f"no time difference could be used ({reasons or 'the recording gives none'}); the recording should hold "
        "where the tag was, or --truth or --at, and --anchors or --site where the anchors are"
    )
