"""``skyless survey``: positions and antenna delays of anchors, from what they receive of one another."""

import time
from math import inf
from pathlib import Path
from typing import TYPE_CHECKING, Final

from cyclopts import App
from msgspec import Struct
from msgspec.structs import replace

from skyless.cli.common.options import (
    Coordinate,
    check_folder,
    check_left_out,
    check_output,
    check_picture,
    finite_numbers,
    options,
)
from skyless.cli.common.output import console
from skyless.cli.common.progress import status
from skyless.cli.common.recording_inputs import is_mcap
from skyless.cli.common.survey_facts import FactOptions, facts_of
from skyless.cli.nodes.survey_live import LiveOptions, gather_live, serve_live
from skyless.cli.survey_report import SurveyReport, print_report, show_report
from skyless.errors import SkylessError

if TYPE_CHECKING:
    from collections.abc import Callable

    from skyless.site.model import Site
    from skyless.survey.ranges import PairRanges
    from skyless.survey.result import Survey
    from skyless.survey.stamps.pair_ranger import PairRanger
    from skyless.survey.tags.epochs import TagEpochs

NOTHING_DETERMINED: Final = 1
"""Exit code of a survey without a position or a delay."""

app = App(
    name="survey",
    help_epilogue="Example: skyless survey site.mcap --site site.toml --distance 1-5=8.94 --out surveyed.toml",
)


@options
class SurveyOptions:
    """Options of ``skyless survey``."""

    ranges: Path | None = None
    """A table of ranges instead of a recording: anchor_a,anchor_b,range_m, each pair any number of times."""
    format: str | None = None
    """Name of the recording's format, if the content should not decide."""
    walk: list[str] | None = None
    """A tag of the recording that was carried around, and when in seconds since its first reception: tag1,
    tag1@60:120. Several times for several tags. Used only where it fits the ranges."""
    walk_height: Coordinate | None = None
    """Height at which it was carried, metres, within some 0.1 m; by default it is free."""
    live: LiveOptions = LiveOptions()
    known: FactOptions = FactOptions()
    out: Path | None = None
    """Write the result here: the site file of --site with the survey in it (.toml), or a table of anchors (.csv)."""
    force: bool = False
    """Overwrite what is there, if --out exists; what was there is kept under another name."""
    json: bool = False
    """Write one JSON object instead of the tables."""
    plot: Path | None = None
    """Draw the picture into this file (PNG, SVG or PDF): the anchors from above."""


@app.default
def survey(recording: Path | None = None, /, *, asked: SurveyOptions = SurveyOptions()) -> int:
    """Find the anchors' positions and the errors of their antenna delays, and what the ranges cannot determine.

    Ends with exit code 1 if no anchor is determined.

    Parameters
    ----------
    recording
        A recording of skyless record, or of another system whose anchors relay their stamps; --ranges takes a table
        instead, --mqtt and --radio survey a running site.
    """
    _check(recording, asked)
    if asked.live.serve:
        serve_live(asked.live, asked.known)
        return 0
    given = _inputs(recording, asked)
    site, ranges = given.site, _with_all_anchors(given.ranges(), given.site)
    facts = facts_of(asked.known, ranges.anchors, site, is_foreign=given.is_foreign)
    facts = replace(facts, tags=_walks(recording, asked, site))
    from skyless.survey.count import count
    from skyless.survey.solve import run_survey
    from skyless.survey.watch.moved import drop_moved, with_changes

    changes = () if given.ranger is None else drop_moved(given.ranger, facts, run_survey)
    if changes:
        ranges = _with_all_anchors(given.ranges(), site)
    counted = count(ranges, facts)
    warnings = () if counted.warning is None else (counted.warning,)
    if not asked.json:
        console().print(counted.sentence, markup=False)
    with status("surveying"):
        result = with_changes(run_survey(ranges, facts), changes, ranges.duration_s)
    report = SurveyReport(result, counted, warnings, given.drops)
    if asked.out is not None and report.usable:
        report = _written(report, ranges, site, asked, asked.out)
    if asked.plot is not None:
        _draw(asked.plot, result)
    if asked.json:
        print_report(report)
    else:
        show_report(report)
    return 0 if report.usable else NOTHING_DETERMINED


def _check(recording: Path | None, asked: SurveyOptions) -> None:
    """See that inputs and options fit one another and outputs can be written, before the work. Raises SkylessError."""
    inputs = (recording, asked.ranges, asked.known.anchor_heights)
    asked.live.check(asked.known)
    if (recording is not None) + (asked.ranges is not None) + asked.live.given != 1:
        raise SkylessError(
            "a survey needs a recording of skyless record, or else a table of ranges by --ranges, or else a running "
            "site by --mqtt or --radio"
        )
    if recording is None:
        check_left_out({"format": asked.format, "walk": asked.walk}, "it is for recordings")
    if not asked.walk:
        check_left_out({"walk-height": asked.walk_height}, "it is the height of a tag that --walk names")
    check_output("out", asked.out, *inputs)
    check_output("plot", asked.plot, *inputs, asked.known.site, asked.out)
    check_picture(asked.plot)
    out = asked.out
    if out is None:
        check_left_out({"force": asked.force or None}, "nothing is written without --out")
        return
    if out.suffix.lower() not in {".toml", ".csv"}:
        raise SkylessError(f"--out is {str(out)!r}; its ending should be .toml for a site or .csv for a table")
    if out.suffix.lower() == ".toml" and asked.known.site is None:
        raise SkylessError(
            f"--out is {str(out)!r}; a site file needs --site to start from (skyless site new --unplaced makes one)"
        )
    check_folder("out", out)
    if out.exists() and not asked.force:
        raise SkylessError(f"{out} exists; --force overwrites it")


class _Inputs(Struct, frozen=True):
    """What a survey starts from."""

    site: "Site | None"
    """The site of --site, else that of the recording."""
    ranges: "Callable[[], PairRanges]"
    """With the antenna delays of the site."""
    ranger: "PairRanger | None" = None
    """What makes the ranges, where their times are known."""
    drops: tuple[str, ...] = ()
    """What could not be used of a recording, by reason."""
    is_foreign: bool = False
    """Whether it is a recording of another system."""


def _inputs(recording: Path | None, asked: SurveyOptions) -> _Inputs:
    """The ranges, and the site if one is known. Raises SkylessError."""
    from skyless.site.load import load_site

    if asked.live.given:
        return _Inputs(*gather_live(asked.live, asked.known))
    site = None if asked.known.site is None else load_site(asked.known.site)
    if asked.ranges is not None:
        from skyless.recordings.range_table import read_ranges

        with status("reading ranges"):
            table = read_ranges(asked.ranges)
            return _Inputs(site, lambda: table)
    if recording is None:
        raise SkylessError("a survey needs a recording or --ranges")
    from skyless.survey.surveyed_site import with_delays_of
    from skyless.survey_inputs.recorded_stamps import ranges_of

    with status("reading stamps"):
        found = ranges_of(recording, asked.format, identifier=None if site is None else site.id)
    warnings = tuple(f"left out: {number} × {reason}" for reason, number in found.drops.items())
    recorded, ranger = found.site, found.ranger
    if site is None or recorded is None:
        return _Inputs(site or recorded, ranger.ranges, ranger, warnings, recorded is None)
    return _Inputs(site, lambda: with_delays_of(ranger.ranges(), recorded, site), ranger, warnings)


def _walks(recording: Path | None, asked: SurveyOptions, site: "Site | None") -> "tuple[TagEpochs, ...]":
    """What the tags of --walk received while they were carried around. Raises SkylessError."""
    if recording is None or not asked.walk:
        return ()
    if site is None or not is_mcap(recording):
        raise SkylessError("--walk names a tag of a recording of skyless record")
    from skyless.recordings.mcap.recording import McapRecording
    from skyless.survey_inputs.walk import walk_of

    walks: list[TagEpochs] = []
    spans: list[tuple[str, float, float]] = []
    with McapRecording(recording) as opened, status("reading the walk"):
        for text in asked.walk:
            tag, mark, span = text.partition("@")
            from_s, to_s = finite_numbers("walk", text, (2,), ":", part=span) if mark else (0.0, inf)
            if not 0.0 <= from_s < to_s:
                raise SkylessError(f"--walk is {text!r}; what follows @ should be two times, the later one last")
            if any(tag == other and from_s < end_s and begin_s < to_s for other, begin_s, end_s in spans):
                raise SkylessError(f"--walk is {text!r}; a walk of {tag} given before covers the same time")
            spans.append((tag, from_s, to_s))
            epochs = walk_of(opened, site.id, tag, (from_s, to_s), asked.walk_height)
            walks.append(replace(epochs, name=f"the walk of {tag}"))
    return tuple(walks)


def _with_all_anchors(ranges: "PairRanges", site: "Site | None") -> "PairRanges":
    """The same ranges, with those anchors of the site added that have none: the survey reports them, too."""
    of_site = set() if site is None else _identifiers(site)
    return replace(ranges, anchors=tuple(sorted({*ranges.anchors, *of_site})))


def _written(
    report: SurveyReport, ranges: "PairRanges", site: "Site | None", asked: SurveyOptions, out: Path
) -> SurveyReport:
    """The report after --out was written. Raises SkylessError."""
    if out.suffix.lower() == ".csv":
        return replace(report, written=_write(out, {out: _table(report.survey).encode()}))
    from skyless.survey.record import SurveyRecord, encode_record, record_path
    from skyless.survey.surveyed_site import delay_changes_ticks, surveyed_text, unchanged_anchors

    if site is None or asked.known.site is None:
        raise SkylessError(f"--out is {str(out)!r}, and there is no --site")
    result = report.survey
    text = surveyed_text(asked.known.site.read_bytes().decode("utf-8-sig"), result, site, asked.known.site)
    record = SurveyRecord(site.name, site.id, time.time(), ranges, result, delay_changes_ticks(site, result))
    strangers = [one.id for one in result.anchors if one.determined and one.id not in _identifiers(site)]
    more = [f"anchor {one} is not in {asked.known.site} and was not written" for one in strangers]
    written = _write(out, {record_path(out): encode_record(record), out: text.encode()})
    return replace(
        report,
        warnings=(*report.warnings, *more),
        unchanged=unchanged_anchors(site, result),
        written=written,
    )


def _identifiers(site: "Site") -> set[int]:
    return {anchor.id for anchor in site.all_anchors}


def _write(out: Path, files: dict[Path, bytes]) -> tuple[str, ...]:
    """Write files, and what ``out`` held under another name: all of them or none.

    The last one is named first. Raises SkylessError.
    """
    from skyless.nodes.survey.files import kept_path
    from skyless.whole_files import replace_files

    try:
        before = {kept_path(out): out.read_bytes()} if out.exists() else {}
        replace_files(before | files)
    except OSError as error:
        raise SkylessError(f"{error.filename or out} cannot be written: {error.strerror}") from None
    return tuple(map(str, (*before, *reversed(files))))


def _table(result: "Survey") -> str:
    """A table of anchors with their delays as ``skyless replay --anchors`` uses them."""
    from skyless.positioning.masterless.anchor_errors import AnchorCalibration, DifferenceCalibration
    from skyless.recordings.anchor_table import new_table

    found = [one for one in result.anchors if one.determined]
    positions_m = {
        one.id: (round(one.x_m or 0.0, 4), round(one.y_m or 0.0, 4), round(one.z_m or 0.0, 4)) for one in found
    }
    delays = {one.id: AnchorCalibration(one.delay_m, 0.0, None) for one in found if one.delay_m is not None}
    return new_table(positions_m, DifferenceCalibration(delays))


def _draw(path: Path, result: "Survey") -> None:
    from skyless.cli.survey_picture import draw

    try:
        draw(path, result)
    except OSError as error:
        raise SkylessError(f"{path} cannot be written: {error.strerror}") from None
