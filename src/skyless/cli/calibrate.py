"""``skyless calibrate``: the anchors' antenna delays from a recording during which it was known where the tag was."""

from pathlib import Path
from typing import TYPE_CHECKING

from cyclopts import App

from skyless.cli.calibrate_output import report_of, see_that_it_can_be_written, show, write
from skyless.cli.common.options import Finite, finite_numbers, spare_inputs
from skyless.cli.common.output import print_json
from skyless.cli.common.progress import status
from skyless.cli.replay_input import flight_height, known_anchors, known_truth
from skyless.cli.replay_site import is_mcap, see_that_they_are_left_out
from skyless.errors import SkylessError

if TYPE_CHECKING:
    from skyless.calibration.samples import First, Stay

app = App(
    name="calibrate",
    help_epilogue="Example: skyless calibrate stay.mcap --at 3,4,1.2 --site site.toml --out calibrated.toml",
)


@app.default
def calibrate(
    file: Path,
    /,
    *,
    anchors: Path | None = None,
    site: Path | None = None,
    truth: Path | None = None,
    lever_arm: str | None = None,
    at: list[str] | None = None,
    first: str | None = None,
    above: Finite | None = None,
    format: str | None = None,  # noqa: A002 - the option's natural name
    listener: str | None = None,
    tag: str | None = None,
    out: Path | None = None,
    force: bool = False,
    json: bool = False,
) -> None:
    """Estimate what each anchor's signals seem late by, from a tag whose place was known, and write it back.

    Takes what skyless replay takes. Of a recording of skyless record the antenna delays of the site file are mended;
    of any other the table of anchors gets a column bias_m, which skyless replay then takes off.

    Parameters
    ----------
    file
        The recording, plain or gzip.
    anchors
        Table of anchors: id,x_m,y_m,z_m.
    site
        A site file instead. Of a recording of skyless record: the file whose antenna delays are to be mended.
    truth
        Table of true positions: t_s,x_m,y_m,z_m, with qx,qy,qz,qw if the body turns; t_s in the recording's time, in
        Unix time for a recording of skyless record. MILUV ticks and simulated sites bring their own.
    lever_arm
        The antenna in the body's frame, x,y,z in metres, added to the truth.
    at
        Where the tag stood still instead: x,y,z in metres, or x,y where the site knows its tags' height; with
        @FROM:TO in seconds since the beginning. Several times for several places.
    first
        Use the beginning only: a number of differences (30), seconds (60s) or a part of the time (50%).
    above
        Use the truth only while its height exceeds this; by default 0.3 m for a truth that starts below it and later
        flies.
    format
        Name of the format, if the content should not decide.
    listener
        Whose ears, in recordings with several listeners.
    tag
        Name of the tag, in recordings of skyless record; by default all whose truth is known.
    out
        Write the calibrated table of anchors (.csv) or site file (.toml) here.
    force
        Overwrite --out if it exists.
    json
        Write one JSON object instead of the table.
    """
    from skyless.calibration.run import CalibrationRequest, calibrate_capture, calibrate_site

    spare_inputs("out", out, file, truth)
    own = is_mcap(file)
    see_that_it_can_be_written(out, own=own, site=site, force=force)
    if at and (truth is not None or lever_arm is not None):
        raise SkylessError("--at says where the antenna was; it should be given without --truth and --lever-arm")
    stays, beginning = tuple(map(_stay, at or ())), _first(first)
    if own:
        useless = {"--anchors": anchors, "--format": format, "--listener": listener}
        see_that_they_are_left_out(useless, "a recording of skyless record brings its own")
    else:
        see_that_they_are_left_out({"--tag": tag}, "it is for recordings of skyless record")
    known = None if at or (own and truth is None) else known_truth(file, truth, lever_arm, format, listener)
    with status("calibrating"):
        if own:
            done = calibrate_site(
                CalibrationRequest(file, stays, known, above, beginning, tag=tag), _identifier_of(site)
            )
        else:
            places, height_m = known_anchors(anchors, site)
            above_m = flight_height(above, known)
            done = calibrate_capture(
                CalibrationRequest(file, stays, known, above_m, beginning, places, height_m, format, listener)
            )
    if out is not None:
        write(done, anchors, site, out)
    if json:
        print_json(report_of(done, out))
    else:
        show(done, out)


def _identifier_of(site: Path | None) -> int | None:
    from skyless.site.load import load_site

    return None if site is None else load_site(site).id


def _stay(text: str) -> "Stay":
    """Place of a tag at rest: x,y[,z][@FROM:TO]. Raises SkylessError."""
    from skyless.calibration.samples import Stay

    place, mark, span = text.partition("@")
    x_m, y_m, *z_m = finite_numbers("at", place, (2, 3))
    if not mark:
        return Stay(x_m, y_m, *z_m)
    from_s, to_s = finite_numbers("at", span, (2,), ":")
    if not 0.0 <= from_s < to_s:
        raise SkylessError(f"--at is {text!r}; what follows @ should be two times in seconds, the later one last")
    return Stay(x_m, y_m, z_m[0] if z_m else None, from_s, to_s)


def _first(text: str | None) -> "First":
    """How much of the beginning to use: a number, seconds with s, a part with %. Raises SkylessError."""
    from skyless.calibration.samples import First

    if text is None:
        return First()
    number = text.rstrip("s%")
    unit = text[len(number) :]
    try:
        value = float(number)
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
