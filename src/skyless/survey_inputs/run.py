"""A calibration from a recording to the anchors' constants, and to the antenna delays of a site.

Delays of a site are a survey with kept positions (``skyless.survey``): what the tag received at known positions, and
the ranges between the anchors, which its receptions hold as well.
"""

from collections import Counter
from collections.abc import Callable
from functools import partial
from os import PathLike
from typing import Final

from msgspec import Struct
from msgspec.structs import replace

from skyless.air.masterless_packets import Point
from skyless.constants import TICK_M
from skyless.errors import ConfigurationError, SkylessError
from skyless.evaluation.judge import Judge
from skyless.recordings.foreign.formats import open_recording
from skyless.recordings.mcap.recording import McapRecording, tags_to_replay
from skyless.recordings.truth import Truth
from skyless.replays.site import SITE_FORMAT, recorded_site, recorded_truth
from skyless.site.check import SITE_LIMITS
from skyless.site.model import Site
from skyless.site.rewrite import DELAY_KEY
from skyless.survey.facts import Facts
from skyless.survey.result import Survey
from skyless.survey.solve import run_survey
from skyless.survey.tags.epochs import EPOCH_S, TagEpochs
from skyless.survey.tags.estimate import CalibrationEstimate, estimate
from skyless.survey_inputs.recorded_stamps import ranges_of
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
from skyless.survey_inputs.walk import at_positions, relayed_tdoas, walk_of

_TAG_STD_M: Final = 0.02
"""Of a tag's known position, per axis."""

_OFFSET_STD_M: Final = 0.03
"""Of each anchor's own constant at the tag, which is no delay: reflections that are always there."""

_DELAY_STD_M: Final = 0.15
"""How much delays of boards that nobody has calibrated are expected to be off."""

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
    """The result of a calibration."""

    format: str
    estimate: CalibrationEstimate
    samples: Samples
    site: Site | None
    """As recorded; None for recordings of other systems."""
    survey: Survey | None = None
    """Delays from ranges and tags together; None for recordings of other systems."""

    def tx_delays_ticks(self) -> dict[int, tuple[int, int]]:
        """Old and new TX antenna delay of every anchor whose delay is determined; empty without a site.

        A signal that leaves later than its stamp needs a larger delay. What an anchor's receptions are off shows
        in the same differences and ranges; it goes into the TX delay as well.

        Raises:
            SkylessError: no radio has such a delay.
        """
        delays_m = {} if self.survey is None else {anchor.id: anchor.delay_m for anchor in self.survey.anchors}
        changes: dict[int, tuple[int, int]] = {}
        for anchor in () if self.site is None else self.site.anchors:
            delay_m = delays_m.get(anchor.id)
            if delay_m is None:
                continue
            ticks = anchor.tx_antenna_delay_ticks + round(2.0 * delay_m / TICK_M)
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
    """Calibrate the anchors of a site from a recording of ``skyless record``.

    The constants of the estimate are what the tag alone shows, against the master or, where there is none, against
    their mean; the survey's delays are absolute.

    Raises:
        SkylessError: the recording cannot be used, is of another site than ``identifier``, or holds nothing at a
            known position.
    """
    recorded = ranges_of(request.path, identifier=identifier)
    ranges = recorded.ranges
    ranges_m = {(pair.a, pair.b): pair.range_m for pair in ranges.pairs}
    with McapRecording(request.path) as recording:
        site = recorded_site(recording, identifier)
        tags = _tags(recording, request)
        samples = joined([_of_tag(recording, site, tag, request, ranges_m) for tag in tags])
        samples = replace(samples, drops=recorded.damage | samples.drops)
        _require_some(samples)
        end_s = float(samples.differences.t_s[-1])
        epochs = tuple(_at_known_positions(recording, site, tag, request, end_s) for tag in tags)
    zero = int(samples.differences.anchor_a[0]) if site.schedule.needs_master else None
    found = estimate(samples.differences, zero=zero, slope=False)
    facts = Facts(
        dimensions=3,
        sketch_m={anchor.id: (anchor.x_m, anchor.y_m, anchor.z_m) for anchor in site.anchors},
        sketch_std_m=site.accuracy.survey_std_m,
        keep_positions=True,
        delay_std_m=_DELAY_STD_M,
        tags=epochs,
    )
    return Calibrated(SITE_FORMAT, found, samples, site, run_survey(ranges, facts))


def _at_known_positions(
    recording: McapRecording, site: Site, tag: str, request: CalibrationRequest, end_s: float
) -> TagEpochs:
    """What a tag received while its position was known, until a Unix time."""
    epochs = walk_of(recording, site.id, tag)
    known = _known_positions(recording, site, tag, request)(float(epochs.t_s[0]) - EPOCH_S / 2.0)
    in_use = at_positions(epochs, lambda time_s: known(time_s) if time_s <= end_s else None, _TAG_STD_M, _OFFSET_STD_M)
    return replace(in_use, name=f"{tag} at known positions")


def _tags(recording: McapRecording, request: CalibrationRequest) -> tuple[str, ...]:
    raw = tags_to_replay(recording.summary())
    names = ", ".join(raw)
    if request.tag is not None:
        if request.tag not in raw:
            raise ConfigurationError(request.path, "tag", request.tag, f"one of {names}")
        return (request.tag,)
    if len(raw) > 1 and (request.stays or request.truth is not None):
        raise SkylessError(f"--tag is missing; it should name the tag whose position is known, one of {names}")
    return raw


def _of_tag(
    recording: McapRecording,
    site: Site,
    tag: str,
    request: CalibrationRequest,
    ranges_m: dict[tuple[int, int], float],
) -> Samples:
    anchors_m = {anchor.id: (anchor.x_m, anchor.y_m, anchor.z_m) for anchor in site.anchors}
    drops: Counter[str] = Counter()
    if site.schedule.needs_master:
        tdoas = site_tdoas(recording, (tag,), site.id, drops)
    else:
        tdoas = relayed_tdoas(recording, tag, site.id, ranges_m)
    samples = gather(tdoas, anchors_m, _known_positions(recording, site, tag, request), request.first)
    return Samples(samples.differences, samples.anchors_m, samples.seen, samples.drops | drops)


def _known_positions(
    recording: McapRecording, site: Site, tag: str, request: CalibrationRequest
) -> Callable[[float], PositionAt]:
    """Where a tag of a site was, as a function of the time of its first difference."""
    truth = recorded_truth(recording).get(tag) if request.truth is None else request.truth
    return partial(_position_from, replace(request, height_m=site.tags.height_m), truth)


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
