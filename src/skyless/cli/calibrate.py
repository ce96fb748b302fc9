"""``skyless calibrate``: the anchors' antenna delays from a recording during which it was known where the tag was."""

from collections.abc import Sequence
from math import inf
from pathlib import Path
from typing import TYPE_CHECKING

from cyclopts import App

from skyless.cli.common.options import (
    Finite,
    check_folder,
    check_left_out,
    check_output,
    finite_numbers,
    metres,
    options,
)
from skyless.cli.common.output import console, number, print_json, write_file
from skyless.cli.common.progress import status
from skyless.cli.common.recording_inputs import is_mcap, lever_arm
from skyless.errors import SkylessError

if TYPE_CHECKING:
    from skyless.survey_inputs.run import Calibrated
    from skyless.survey_inputs.samples import First, Stay

app = App(
    name="calibrate",
    help_epilogue="Example: skyless calibrate stay.mcap --at 3,4,1.2 --site site.toml --out calibrated.toml",
)


@options
class CalibrateOptions:
    """Options of ``skyless calibrate``."""

    anchors: Path | None = None
    """Table of anchors: id,x_m,y_m,z_m."""
    site: Path | None = None
    """Site file instead of --anchors. Of a recording of skyless record: the file whose antenna delays are to be
    corrected."""
    truth: Path | None = None
    """Table of true positions: t_s,x_m,y_m,z_m, with qx,qy,qz,qw if the body turns; t_s in the recording's time, in
    Unix time for a recording of skyless record. MILUV ticks and simulated sites bring their own."""
    lever_arm: str | None = None
    """The antenna in the body's frame, x,y,z in metres, added to the truth."""
    at: list[str] | None = None
    """Where the tag stood still instead: x,y,z in metres, or x,y where the site knows its tags' height; with
    @FROM:TO in seconds since the beginning. Several times for several positions."""
    first: str | None = None
    """Use the beginning only: a number of differences (30), seconds (60s) or a part of the time (50%)."""
    above: Finite | None = None
    """Judge only while the true height exceeds this: the truth below it is not used; by default 0.3 m for a truth that
    starts below it and later flies."""
    format: str | None = None
    """Name of the format, if the content should not decide."""
    listener: str | None = None
    """Which receiver, in recordings with several."""
    tag: str | None = None
    """Name of the tag, in recordings of skyless record; by default all whose truth is known."""
    out: Path | None = None
    """Write the result here: the calibrated table of anchors (.csv) or site file (.toml)."""
    force: bool = False
    """Overwrite what is there, if --out exists."""
    json: bool = False
    """Write one JSON object instead of the table."""


@app.default
def calibrate(file: Path, /, *, asked: CalibrateOptions = CalibrateOptions()) -> None:
    """Estimate by how much each anchor's signals seem late, from a tag at known positions, and write a corrected file.

    Takes what skyless replay takes. Of a recording of skyless record the antenna delays of the site file are corrected;
    of any other the table of anchors gets a column bias_m, which skyless replay then takes off.

    Parameters
    ----------
    file
        The recording, plain or gzip.
    """
    from skyless.replays.inputs import flight_height, known_anchors, known_truth
    from skyless.survey_inputs.report import calibration_report
    from skyless.survey_inputs.run import CalibrationRequest, calibrate_capture, calibrate_site

    check_output("out", asked.out, file, asked.truth)
    own = is_mcap(file)
    _check_out(asked, own=own)
    if asked.at and (asked.truth is not None or asked.lever_arm is not None):
        raise SkylessError("--at says where the antenna was; it should be given without --truth and --lever-arm")
    stays, beginning = _stays(asked.at or ()), _first(asked.first)
    if own:
        useless = {
            "anchors": asked.anchors, "format": asked.format, "listener": asked.listener,
            "lever-arm": asked.lever_arm if asked.truth is None else None,
        }  # fmt: skip
        check_left_out(useless, "a recording of skyless record brings its own")
    else:
        check_left_out({"tag": asked.tag}, "it is for recordings of skyless record")
    known = None
    if not asked.at and not (own and asked.truth is None):
        known = known_truth(file, asked.truth, lever_arm(asked.lever_arm), asked.format, asked.listener)
    with status("calibrating"):
        if own:
            request = CalibrationRequest(file, stays, known, asked.above, beginning, tag=asked.tag)
            done = calibrate_site(request, _identifier_of(asked.site))
        else:
            anchors_m, height_m = known_anchors(asked.anchors, asked.site)
            above_m = flight_height(asked.above, known)
            done = calibrate_capture(
                CalibrationRequest(
                    file, stays, known, above_m, beginning, anchors_m, height_m, asked.format, asked.listener
                )
            )
    if asked.out is not None:
        _write(done, asked.anchors, asked.site, asked.out)
    if asked.json:
        print_json({**calibration_report(done), "written": asked.out})
    else:
        _show(done, asked.out)


def _check_out(asked: CalibrateOptions, *, own: bool) -> None:
    """See that --out can be written, before the long work instead of after it. Raises SkylessError."""
    out = asked.out
    if out is None:
        check_left_out({"force": asked.force or None}, "nothing is written without --out")
        return
    check_folder("out", out)
    if own and (out.suffix.lower() != ".toml" or asked.site is None):
        raise SkylessError(
            f"--out is {str(out)!r}; of a recording of skyless record the site file is corrected: --out should be a "
            ".toml, and --site the file to start from"
        )
    if not own and out.suffix.lower() == ".toml":
        raise SkylessError(
            f"--out is {str(out)!r}; it should be a table, .csv: a site file holds antenna delays, which only a "
            "recording of skyless record can correct"
        )
    if out.exists() and not asked.force:
        raise SkylessError(f"{out} exists; --force overwrites it")


def _identifier_of(site: Path | None) -> int | None:
    from skyless.site.load import load_site

    return None if site is None else load_site(site).id


def _stays(texts: Sequence[str]) -> "tuple[Stay, ...]":
    """The positions of --at. Raises SkylessError."""
    stays = tuple(map(_stay, texts))
    for text, stay in zip(texts[:-1], stays, strict=False):
        if stay.to_s == inf:
            raise SkylessError(f"--at is {text!r}; before another --at it should have its times, @FROM:TO")
    return stays


def _stay(text: str) -> "Stay":
    """Position of a tag at rest: x,y[,z][@FROM:TO]. Raises SkylessError."""
    from skyless.survey_inputs.samples import Stay

    position, mark, span = text.partition("@")
    x_m, y_m, *z_m = metres("at", text, (2, 3), part=position)
    if not mark:
        return Stay(x_m, y_m, *z_m)
    from_s, to_s = finite_numbers("at", text, (2,), ":", part=span)
    if not 0.0 <= from_s < to_s:
        raise SkylessError(f"--at is {text!r}; what follows @ should be two times in seconds, the later one last")
    return Stay(x_m, y_m, z_m[0] if z_m else None, from_s, to_s)


def _first(text: str | None) -> "First":
    """How much of the beginning to use: a number, seconds with s, a part with %. Raises SkylessError."""
    from skyless.survey_inputs.samples import First

    if text is None:
        return First()
    digits = text.rstrip("s%")
    unit = text[len(digits) :]
    try:
        value = float(digits)
    except ValueError:
        value = 0.0
    if 0.0 < value < 1e12:
        if unit == "s":
            return First(seconds=value)
        if unit == "%" and value <= 100.0:
            return First(part=value / 100.0)
        if unit == "" and value == int(value):
            return First(count=int(value))
    raise SkylessError(f"--first is {text!r}; it should be a number of differences, seconds (60s) or a part (50%)")


def _write(done: "Calibrated", anchors: Path | None, site: Path | None, out: Path) -> None:
    """Write the table or site file with the calibration in it. Raises SkylessError."""
    from skyless.survey_inputs.report import corrected_text

    write_file(out, corrected_text(done, anchors, site).encode())


def _show(done: "Calibrated", out: Path | None) -> None:
    """Show the report as a table."""
    from rich.table import Table

    from skyless.survey_inputs.report import calibration_notes

    found, delays = done.estimate, done.tx_delays_ticks()
    names = [
        "anchor",
        "bias / m",
        "std error / m",
        "noise / m",
        "differences",
        *(["delay / m", "std / m", "TX delay / ticks"] if delays else []),
    ]
    table = Table(title=f"{done.format}: {found.used} differences used, {found.rejected} outliers")
    for name in names:
        table.add_column(name, justify="right")
    surveyed = {} if done.survey is None else {one.id: one for one in done.survey.anchors}
    for anchor in found.anchors:
        fields = [number(value) for value in (anchor.bias_m, anchor.std_m, anchor.noise_m)]
        change = ["–", "–", "–"] if delays else []
        if anchor.anchor in delays:
            (old, new), one = delays[anchor.anchor], surveyed[anchor.anchor]
            change = [number(one.delay_m), number(one.delay_std_m), f"{old} → {new}"]
        table.add_row(str(anchor.anchor), *fields, str(anchor.count), *change)
    screen = console()
    screen.print(table)
    zero = "the mean of the constants" if found.zero == "mean" else f"{found.zero}, the master"
    screen.print(f"of biases only differences can be seen; the zero is {zero}")
    if delays:
        screen.print("delays come from ranges between anchors and from the tag; TX delays grow by twice these")
    screen.print(f"noise of a difference: {number(found.noise_before_m)} m before, {number(found.noise_m)} m after")
    if found.slope_m is not None:
        slope = f"{found.slope_m:.3f} ± {number(found.slope_std_m)} m while the range grows by the factor e"
        screen.print(f"range bias (received power): {slope}")
    for note in calibration_notes(done):
        screen.print(f"note: {note}", markup=False)
    for reason, count in done.samples.drops.items():
        screen.print(f"left out: {count} × {reason}")
    if out is not None:
        screen.print(f"wrote {out}", markup=False)
