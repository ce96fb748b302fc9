"""``skyless doctor``: checks of a computer, its boards and a running site."""

import time
from pathlib import Path
from typing import TYPE_CHECKING

from cyclopts import App

from skyless.cli.common.options import check_folder, command
from skyless.cli.common.output import console, print_json, write_file
from skyless.cli.nodes.options import MqttOptions, SiteId, log
from skyless.core.arguments import Positive
from skyless.core.errors import SkylessError

if TYPE_CHECKING:
    from skyless.radio.serial.serial_radio import SerialRadio
    from skyless.run.doctor.check import Check

_COLOURS = {"ok": "green", "warning": "yellow", "failed": "bold red", "not checked": "dim"}

app = App(name="doctor", help_epilogue="Example: skyless doctor --radio serial:/dev/ttyACM0 --mqtt none --duration 30")


@app.default
@command
def doctor(
    *,
    broker: MqttOptions,
    site: Path | None = None,
    site_id: SiteId | None = None,
    radio: str | None = None,
    duration: Positive = 120.0,
    report: Path | None = None,
    force: bool = False,
    json: bool = False,
) -> int:
    """Check this computer, its boards and a running site, and say what to do next.

    The exit code is 1 if anything has failed.

    Parameters
    ----------
    site
        Site file that the running site should have; its noise figures are those that clocks are compared with.
    site_id
        Number of the site; by default the site file's, or the one whose programs are online.
    radio
        Radio of a board that no other program uses, to listen with it: serial:PATH[@BAUD], or several with commas.
    duration
        Seconds to listen; 120 by default.
    report
        File to write the report to, Markdown.
    force
        Overwrite what is there, if the report exists.
    json
        Write one JSON object instead of the table.
    """
    from skyless.cli.common.progress import progress_bar
    from skyless.run.doctor.check import report as as_markdown
    from skyless.run.doctor.program import Examination, examine
    from skyless.run.process import run
    from skyless.site.file.load import load_site

    if report is not None:
        check_folder("report", report)
        if report.exists() and not force:
            raise SkylessError(f"{report} exists; --force overwrites it")
    file_site = None if site is None else load_site(site)
    if site_id is None and file_site is not None:
        site_id = file_site.id
    asked = Examination(duration, _boards(radio), broker.address(), site_id, file_site)
    checks: list[Check] = []

    async def work() -> None:
        with progress_bar("listening", duration) as bar:
            checks.extend(await examine(asked, log, bar.reach))

    log(f"checking for {duration:.0f} s")
    run(work())
    if not checks:
        return 1
    if report is not None:
        write_file(report, as_markdown(checks, f"skyless doctor, {time.strftime('%Y-%m-%d %H:%M')}").encode())
    if json:
        print_json({"checks": checks, "failed": sum(one.result == "failed" for one in checks), "report": report})
    else:
        _show(checks)
    return 1 if any(one.result == "failed" for one in checks) else 0


def _boards(radio: str | None) -> "tuple[SerialRadio, ...]":
    """The boards that are to listen. Raises SkylessError."""
    from skyless.radio.serial.serial_radio import SerialRadio
    from skyless.run.open_radio import open_radios

    if radio is None:
        return ()
    paths = [part.rpartition("@")[0] or part for part in radio.partition(":")[2].split(",")]
    names = tuple(path.rpartition("/")[2] for path in paths)
    boards = open_radios(radio, "tag", names) if radio.startswith("serial:") else ()
    if not boards or not all(isinstance(one, SerialRadio) for one in boards):
        raise SkylessError(f"--radio is {radio!r}; it should be a board, serial:PATH[@BAUD], as serial:/dev/ttyACM0")
    return tuple(one for one in boards if isinstance(one, SerialRadio))


def _show(checks: "list[Check]") -> None:
    from rich.table import Table
    from rich.text import Text

    from skyless.run.doctor.check import summary

    table = Table.grid(padding=(0, 2, 0, 0))
    for check in checks:
        words = Text.assemble((f"{check.name}: ", "bold"), check.finding)
        if check.advice:
            words.append(f"\n{check.advice}", "yellow")
        table.add_row(Text(check.result, _COLOURS[check.result], no_wrap=True), words)
    out = console()
    out.print(table)
    out.print(summary(checks))
