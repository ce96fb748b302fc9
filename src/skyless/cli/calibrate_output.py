"""What ``skyless calibrate`` writes: the table or site file with the calibration in it, and the report."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

from skyless.cli.common.output import console, write_atomically
from skyless.errors import SkylessError

if TYPE_CHECKING:
    from skyless.calibration.estimate import CalibrationEstimate
    from skyless.calibration.run import Calibrated

MANY_OUTLIERS = 0.05
UNEXPLAINED_SHARE = 0.5


def see_that_it_can_be_written(out: Path | None, *, own: bool, site: Path | None, force: bool) -> None:
    """Look at --out before the long work, not after it. Raises SkylessError."""
    if out is None:
        return
    if own and (out.suffix.lower() != ".toml" or site is None):
        raise SkylessError(
            f"--out is {str(out)!r}; of a recording of skyless record the site file is mended: --out should be a "
            ".toml, and --site the file to start from"
        )
    if not own and out.suffix.lower() == ".toml":
        raise SkylessError(
            f"--out is {str(out)!r}; it should be a table, .csv: a site file holds antenna delays, which only a "
            "recording of skyless record can mend"
        )
    if out.exists() and not force:
        raise SkylessError(f"{out} exists; --force overwrites it")


def write(done: "Calibrated", anchors: Path | None, site: Path | None, out: Path) -> None:
    """Write the calibration atomically. Raises SkylessError."""
    if site is not None and done.site is not None:
        from skyless.site.rewrite import with_tx_delays

        delays_ticks = {anchor: new for anchor, (_, new) in done.tx_delays_ticks().items()}
        text = with_tx_delays(site.read_bytes().decode(), delays_ticks, site)
    else:
        from skyless.recordings.anchor_table import calibrated_table, new_table

        known = done.estimate.calibration()
        text = new_table(done.samples.anchors_m, known) if anchors is None else calibrated_table(anchors, known)
    try:
        write_atomically(out, text.encode())
    except OSError as error:
        raise SkylessError(f"{out} cannot be written: {error.strerror}") from None


def report_of(done: "Calibrated", out: Path | None) -> dict[str, Any]:
    """The report as one object."""
    import msgspec

    return {
        "format": done.format,
        **msgspec.to_builtins(done.estimate),
        "tx_antenna_delay_ticks": {str(anchor): new for anchor, (_, new) in done.tx_delays_ticks().items()},
        "drops": done.samples.drops,
        "notes": _notes(done.estimate),
        "written": out,
    }


def show(done: "Calibrated", out: Path | None) -> None:
    """Show the report as a table."""
    from rich.table import Table

    found, delays = done.estimate, done.tx_delays_ticks()
    names = (
        "anchor",
        "bias / m",
        "std error / m",
        "noise / m",
        "differences",
        *(("TX delay / ticks",) if delays else ()),
    )
    table = Table(*names, title=f"{done.format}: {found.used} differences used, {found.rejected} outliers")
    for column in table.columns:
        column.justify = "right"
    for anchor in found.anchors:
        old, new = delays.get(anchor.anchor, (0, 0))
        fields = [_number(value) for value in (anchor.bias_m, anchor.std_m, anchor.noise_m)]
        change = [f"{old} → {new}" if anchor.anchor in delays else "–"] if delays else []
        table.add_row(str(anchor.anchor), *fields, str(anchor.count), *change)
    screen = console()
    screen.print(table)
    zero = "the mean of the constants" if found.zero == "mean" else f"{found.zero}, the master"
    screen.print(f"only differences can be seen; the zero is {zero}")
    screen.print(f"noise of a difference: {_number(found.noise_before_m)} m before, {_number(found.noise_m)} m after")
    if found.slope_m is not None:
        slope = f"{found.slope_m:.3f} ± {_number(found.slope_std_m)} m while the range grows by the factor e"
        screen.print(f"range bias (received power): {slope}")
    for note in _notes(found):
        screen.print(f"note: {note}", markup=False)
    for reason, count in done.samples.drops.items():
        screen.print(f"left out: {count} × {reason}")
    if out is not None:
        screen.print(f"wrote {out}", markup=False)


def _notes(found: "CalibrationEstimate") -> list[str]:
    """What the user should know."""
    notes = [f"anchor {one.anchor} is not determined: {one.reason}" for one in found.anchors if one.reason]
    if found.rejected > MANY_OUTLIERS * (found.used + found.rejected):
        part = found.rejected / (found.used + found.rejected)
        notes.append(f"{part:.0%} of the differences are outliers: calibrate where every anchor is in sight")
    if (found.loop_m or 0.0) > UNEXPLAINED_SHARE * (found.noise_m or 0.0):
        notes.append(
            f"pairs of anchors remain {found.loop_m:.3f} m off, which no constants explain: something may stand "
            "between anchors or in the tag's way"
        )
    return notes


def _number(value: float | None) -> str:
    return "–" if value is None else f"{value:.3f}"
