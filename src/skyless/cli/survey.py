"""``skyless survey`` and ``skyless calibrate``: anchors from their receptions, delays from a tag at known positions."""

import asyncio
import contextlib
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Final

from cyclopts import App
from msgspec.structs import replace

from skyless.arguments import Options, Positive
from skyless.cli.common import (
    JsonOptions,
    check_folder,
    check_new,
    check_output,
    check_picture,
    cm,
    command,
    console,
    number,
    print_facts,
    print_json,
    print_table,
    print_warnings,
    progress_bar,
    with_status,
    write_file,
    write_picture,
)
from skyless.cli.nodes.options import MqttCa, SiteId, log, run_until_stopped
from skyless.core.errors import SkylessError
from skyless.core.site import Site
from skyless.research.calibration.options import CalibrateOptions, SurveyOptions, facts_of
from skyless.run.find_site import find_site
from skyless.run.mqtt.address import mqtt_address
from skyless.run.process import run
from skyless.site.file.load import load_site

if TYPE_CHECKING:
    from skyless.cli.api.survey import SurveyResult
    from skyless.research.calibration.biases import Gathered
    from skyless.run.survey.program import SurveyNode
    from skyless.site.survey.facts import Facts, Survey, SurveyedPair, TapeAdvice

NOTHING_DETERMINED: Final = 1
"""Exit code of a survey without a position or a delay."""

_WORST: Final = 8
"""Number of pairs that are shown, those with the largest residuals."""

app = App(
    name="survey",
    help_epilogue="Example: skyless survey --recording site.mcap --site site.toml --distance 1-5=8.94 --out new.toml",
)


class LiveOptions(Options, frozen=True, kw_only=True):
    """Options of a survey at a running site."""

    mqtt: str | None = None
    """Broker to survey the running site of: its anchors publish their stamps."""
    mqtt_ca: MqttCa = None
    """Certificates (PEM) to trust for mqtts."""
    site_id: SiteId | None = None
    """Number of the site; by default that of --site, or the one whose programs are online."""
    duration: Positive | None = None
    """Seconds to listen before the survey; 30 by default."""
    serve: bool = False
    """Stay until Ctrl-C: survey all the while, serve the page, save on its request, and watch the anchors."""

    def check(self) -> None:
        """Check that the options are compatible. Raises SkylessError."""
        if self.mqtt is None:
            self.leave_out("duration", "serve", "site_id", why="a running site is surveyed by --mqtt")
        if self.serve:
            self.leave_out("duration", why="with --serve the survey does not end")


class Output(JsonOptions, frozen=True, kw_only=True):
    """What a survey or a calibration writes."""

    out: Path | None = None
    """Write the result here: the site file of --site with the survey in it (.toml), or a table of anchors (.csv)."""
    force: bool = False
    """Overwrite what is there, if --out exists; what was there is kept under another name."""
    plot: Path | None = None
    """Draw the picture into this file (PNG, SVG or PDF): the anchors from above, or their constants."""

    def check_files(self, site: object, *inputs: object) -> None:
        """Check before the work that outputs can be written. Raises SkylessError."""
        files = [Path(one) for one in inputs if isinstance(one, str | Path)]
        sites = [Path(site)] if isinstance(site, str | Path) else []
        out = self.out
        check_output("out", out, *files)
        check_output("plot", self.plot, *files, *sites, out)
        check_picture(self.plot)
        if out is None:
            self.leave_out("force", why="nothing is written without --out")
            return
        check_folder("--out", out)
        if out.suffix.lower() not in {".toml", ".csv"}:
            raise SkylessError(f"--out is {str(out)!r}; its ending should be .toml for a site or .csv for a table")
        if out.suffix.lower() == ".toml" and site is None:
            raise SkylessError(
                f"--out is {str(out)!r}; a site file needs --site to start from (skyless site new --unplaced makes one)"
            )
        check_new(out, force=self.force)


@app.default
@command
def survey(*, asked: SurveyOptions, live: LiveOptions, output: Output) -> int:
    """Find the anchors' positions and the errors of their antenna delays, and what the ranges cannot determine.

    From a recording of skyless record, or of another system whose anchors relay their stamps; from a table of ranges;
    or from a running site (--mqtt).

    Ends with exit code 1 if no anchor is determined.
    """
    if (asked.recording is None) == (live.mqtt is None):
        raise SkylessError("a survey needs a recording or a table of ranges (--recording), or a running site (--mqtt)")
    heights = asked.anchor_height_m.values() if isinstance(asked.anchor_height_m, dict) else ()
    output.check_files(asked.site, asked.recording, *heights)
    if live.serve:
        run_until_stopped(_serve(live, asked))
        return 0
    from skyless.cli.api.survey import gathered, surveyed

    with progress_bar("surveying") as reach:
        if asked.recording is None:
            given = _gather_live(live, asked)
        else:
            given = gathered(asked.recording, asked.site, None, reach)
        found = surveyed(asked, given)
    return report(found, output)


def report(found: "SurveyResult", output: Output) -> int:
    """Write and print a survey. Returns the exit code."""
    written, more = ((), ()) if output.out is None or not found.usable else _written(found, output.out)
    found = replace(found, warnings=(*found.warnings, *more))
    if output.plot is not None:
        write_picture(output.plot, found.plot())
    if output.json:
        unchanged = list(found.unchanged) if written else []
        print_json({**found.summary, "unchanged": unchanged, "written": list(written)})
    else:
        _show(found, written)
    return 0 if found.usable else NOTHING_DETERMINED


# Files


def _written(found: "SurveyResult", out: Path) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Write --out. Returns the written files, and warnings about anchors left out. Raises SkylessError."""
    from skyless.site.survey.surveyed_site import save_survey, write_keeping

    if out.suffix.lower() == ".csv":
        return tuple(map(str, write_keeping(out, {out: _table(found.survey).encode()}))), ()
    assert found.site is not None
    assert found.file is not None
    saved = save_survey(found.file, found.survey, found.ranges, time.time(), out=out)
    known = {anchor.id for anchor in found.site.all_anchors}
    strangers = found.survey.determined.keys() - known
    more = tuple(f"anchor {one} is not in {found.file} and was not written" for one in sorted(strangers))
    return tuple(map(str, saved.written)), more


def _table(result: "Survey") -> str:
    """A table of anchors with their delays, for ``skyless replay --anchors``."""
    from skyless.site.survey.anchor_errors import AnchorCalibration, DifferenceCalibration
    from skyless.site.tables import new_table

    found = result.determined.values()
    positions_m = {
        one.id: (round(one.x_m or 0.0, 4), round(one.y_m or 0.0, 4), round(one.z_m or 0.0, 4)) for one in found
    }
    delays = {one.id: AnchorCalibration(one.delay_m, 0.0, None) for one in found if one.delay_m is not None}
    return new_table(positions_m, DifferenceCalibration(delays))


# Reports


def _show(found: "SurveyResult", written: tuple[str, ...]) -> None:
    """Print the survey: first its counts and warnings about uncertainties, then tables and lines of text."""
    survey, screen = found.survey, console()
    screen.print(found.title(), markup=False)
    print_warnings(
        [
            *found.warnings,
            *(f"ambiguous: {one.sentence}" for one in survey.ambiguities),
            *([] if survey.unchecked is None else [survey.unchecked]),
            *([] if survey.assumed_heights is None else [f"{survey.assumed_heights} (--anchor-height)"]),
            *survey.not_determined,
        ]
    )
    for note in survey.notes:
        screen.print(f"note: {note}", markup=False)
    _print_anchors(survey)
    checked = [pair for pair in survey.pairs if pair.residual_m is not None]
    if checked:
        _print_pairs(checked)
    excluded = ", ".join(
        f"{pair.a}–{pair.b}" + ("" if pair.residual_m is None else f" ({pair.residual_m:+.2f} m)")
        for pair in survey.pairs
        if pair.excluded
    )
    lines = [
        f"left out as late: {excluded or 'no pair'}",
        f"constant error of a pair: {cm(survey.range_std_m)}; {_checks(survey.redundancy)}",
        *_tapes(survey.tapes),
        survey.frame,
        *found.drops,
    ]
    if found.unchanged and written:
        lines.append(f"unchanged in the file: anchor {', '.join(map(str, found.unchanged))}")
    lines += [f"wrote {file}" for file in written]
    lines += [f"next: start the anchors with {file}" for file in written[-2:-1] if file.endswith(".toml")]
    for line in lines:
        screen.print(line, markup=False)


def _print_anchors(survey: "Survey") -> None:
    rows = []
    for one in survey.anchors:
        position = [number(value) for value in (one.x_m, one.y_m, one.z_m)]
        others = [number(value, "{:.2f}", 100.0) for value in (one.std_m, one.delay_m, one.delay_std_m)]
        rows.append((str(one.id), *position, *others, "" if one.determined else "not determined"))
    heads = ("anchor", "x / m", "y / m", "z / m", "± / cm", "delay / cm", "± / cm", "")
    print_table("anchors", heads, rows, figures=True)


def _print_pairs(checked: Sequence["SurveyedPair"]) -> None:
    """Print the pairs whose ranges differ most from the result."""
    worst = sorted(checked, key=lambda pair: -abs(pair.residual_m or 0.0))[:_WORST]
    shown = "all pairs" if len(worst) == len(checked) else f"the {len(worst)} of {len(checked)} pairs that fit worst"
    rows = []
    for pair in worst:
        figures = [number(pair.residual_m, "{:+.2f}", 100.0), number(pair.std_m, "{:.2f}", 100.0)]
        rows.append((f"{pair.a}–{pair.b}", number(pair.range_m), *figures, "left out" if pair.excluded else ""))
    print_table(shown, ("pair", "range / m", "range − result / cm", "± / cm", ""), rows, figures=True)


def _checks(redundancy: int) -> str:
    if redundancy <= 0:
        return "no range checks the result"
    return "1 range checks the result" if redundancy == 1 else f"{redundancy} ranges check the result"


def _tapes(tapes: Sequence["TapeAdvice"]) -> list[str]:
    """Lines on the distances to measure next, and the resulting accuracy."""
    lines = []
    for rank, tape in enumerate(tapes):
        ask = "the tape that helps most" if rank == 0 else "then"
        gain = f"{cm(tape.std_before_m)} → {cm(tape.std_after_m)}"
        lines.append(f"{ask}: between {tape.a} and {tape.b}, {gain} (--distance {tape.a}-{tape.b}=METRES)")
    return lines


# At a running site


def _gather_live(asked: LiveOptions, known: SurveyOptions) -> "Gathered":
    """Gather ranges for some seconds. Raises SkylessError."""
    from skyless.research.calibration.biases import Gathered

    found: list[SurveyNode] = []
    run(_gather(asked, known, found))
    live = found[0].live if found else None
    if live is None:
        raise SkylessError(f"no site was found at {asked.mqtt}: its anchors are not there, or have not begun yet")
    live.ranger.finish()
    given = Gathered(live.ranger, live.site, delays_m=found[0].delays_m)
    if not given.ranges.pairs:
        raise SkylessError(
            f"the anchors of site {live.site.name!r} have no ranges at {asked.mqtt} yet; they should be running"
        )
    return given


async def _serve(asked: LiveOptions, known: SurveyOptions) -> None:
    """Run as the survey program of a site until cancelled. Raises SkylessError."""
    node = await _node(asked, known, serves=True)
    await with_status(node.run(), lambda: _line(node, None))


async def _gather(asked: LiveOptions, known: SurveyOptions, found: "list[SurveyNode]") -> None:
    seconds = asked.duration or 30.0
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(seconds + 1.0):  # a moment for the broker and the anchors to answer
            node = await _node(asked, known, serves=False)
            found.append(node)
            await with_status(node.run(), lambda: _line(node, seconds))


async def _node(asked: LiveOptions, known: SurveyOptions, *, serves: bool) -> "SurveyNode":
    """Create the survey program. Raises SkylessError."""
    from skyless.run.survey.program import SurveyNode, SurveySettings

    def facts(of_site: Site) -> "Facts":
        return facts_of(known, (anchor.id for anchor in of_site.all_anchors), of_site)

    assert asked.mqtt is not None
    address = mqtt_address(asked.mqtt, asked.mqtt_ca)
    file = None if known.site is None else Path(str(known.site))
    site = None if file is None else load_site(file)
    site_id = site.id if asked.site_id is None and site is not None else asked.site_id
    if site is not None:
        facts(site)  # refuses options that do not fit the site before the program serves
        if site_id != site.id:
            raise SkylessError(f"--site-id is {site_id}; the site of {known.site} is number {site.id}")
    if site_id is None:
        site_id = await find_site(address)
    settings = SurveySettings(site_id, site, file, serves)
    return SurveyNode(settings, facts, address, log)


def _line(node: "SurveyNode", seconds: float | None) -> str:
    live = node.live
    if live is None:
        return "survey: waiting for the site"
    now = live.message(time.monotonic(), time.time(), None)
    n = len(live.site.all_anchors)
    what = f"{len(now.anchors)} of {n} anchors, {len(now.pairs)} of {n * (n - 1) // 2} pairs, {now.duration_s:.0f} s"
    return f"survey: {what}{'' if seconds is None else f' of {seconds:.0f} s'}; {now.error or now.state}"


calibrate_app = App(
    name="calibrate",
    help_epilogue="Example: skyless calibrate stay.mcap --at 3,4,1.2 --site site.toml --out calibrated.toml",
)

_ONLY_A_TABLE: Final = (
    "it should be a table, .csv: a site file holds antenna delays, which only a recording of skyless record can correct"
)


@calibrate_app.default
@command
def calibrate(asked: CalibrateOptions, *, output: Output) -> int:
    """Find the errors of antenna delays from a tag at known positions (--at, --truth); the anchors' positions are kept.

    In a recording of skyless record the ranges between the anchors take part. In a recording of another system the tag
    shows by how much each anchor seems late, which skyless replay then takes off.

    Ends with exit code 1 if no delay is determined.
    """
    output.check_files(asked.site, asked.file, asked.truth)
    from skyless.cli.api.survey import SurveyResult, run_calibrate
    from skyless.run.recordings.recording import is_mcap

    if output.out is not None and output.out.suffix.lower() != ".csv" and not is_mcap(asked.file):
        raise SkylessError(f"--out is {str(output.out)!r}; {_ONLY_A_TABLE}")
    with progress_bar("calibrating") as reach:
        found = run_calibrate(replace(asked, progress=reach))
    if isinstance(found, SurveyResult):
        return report(found, output)
    if output.out is not None:
        write_file(output.out, found.corrected_file().encode())
    if output.plot is not None:
        write_picture(output.plot, found.plot())
    if output.json:
        print_json({**found.summary, "written": output.out})
        return 0
    print_facts(found.title(), found.facts())
    if output.out is not None:
        console().print(f"wrote {output.out}", markup=False)
    return 0
