"""``skyless doctor``: checks of a computer, its boards and a running site."""

import asyncio
import contextlib
import platform
import time
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Final, get_args

from cyclopts import App

from skyless.cli.common.options import check_folder, command
from skyless.cli.common.output import plain, print_json, write_file
from skyless.cli.nodes.options import MqttOptions, SiteId, log
from skyless.core.arguments import Positive
from skyless.core.errors import SkylessError

if TYPE_CHECKING:
    from skyless.core.site import Site
    from skyless.radio.serial.serial_radio import SerialRadio
    from skyless.run.doctor.check import Check
    from skyless.run.mqtt.address import MqttAddress

_FIND_S: Final = 8.0

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
        File to write the report to as well, Markdown.
    force
        Overwrite what is there, if the report exists.
    json
        Write one JSON object instead of the report.
    """
    from skyless.cli.common.progress import progress_bar
    from skyless.run.process import run
    from skyless.site.file.load import load_site

    if report is not None:
        check_folder("report", report)
        if report.exists() and not force:
            raise SkylessError(f"{report} exists; --force overwrites it")
    file_site = None if site is None else load_site(site)
    if site_id is None and file_site is not None:
        site_id = file_site.id
    boards, address = _boards(radio), broker.address()
    checks: list[Check] = []

    async def work() -> None:
        with progress_bar("listening", duration) as bar:
            checks.extend(await _examine(boards, address, site_id, file_site, duration, bar.reach))

    log(f"checking for {duration:.0f} s")
    run(work())
    if not checks:
        return 1
    if report is not None:
        write_file(report, _report(checks).encode())
    if json:
        print_json({"checks": checks, "failed": sum(one.result == "failed" for one in checks), "report": report})
    else:
        print(_report(checks), end="")
    return 1 if any(one.result == "failed" for one in checks) else 0


def _boards(radio: str | None) -> "tuple[SerialRadio, ...]":
    """The boards that are to listen. Raises SkylessError."""
    from skyless.radio.serial.serial_radio import SerialRadio
    from skyless.run.open_radio import open_radios

    if radio is None:
        return ()
    kind, _, ports = radio.partition(":")
    if kind != "serial":
        raise SkylessError(f"--radio is {radio!r}; it should be a board, serial:PATH[@BAUD], as serial:/dev/ttyACM0")
    boards = open_radios(radio, "tag", tuple(ports.split(",")))
    return tuple(one for one in boards if isinstance(one, SerialRadio))


async def _examine(
    boards: "Sequence[SerialRadio]",
    broker: "MqttAddress | None",
    site_id: int | None,
    file_site: "Site | None",
    seconds: float,
    progress: Callable[[float], None],
) -> "list[Check]":
    """All checks; ``progress`` is called with the seconds that have gone."""
    from skyless.cli.nodes._site_probe import SiteProbe
    from skyless.cli.nodes._site_view import LINK_NAME, SiteView, site_number
    from skyless.core.site import NoiseSite
    from skyless.page.condition.evidence import ProcessorUse
    from skyless.run.doctor.board import BoardProbe
    from skyless.run.doctor.check import Check
    from skyless.run.doctor.host import clock_check, port_checks
    from skyless.run.mqtt.link import Link
    from skyless.run.process import every, together

    checks = [*port_checks(), clock_check()]
    probes = [BoardProbe(radio, site_id) for radio in boards]
    site: SiteProbe | None = None
    try:
        if broker is not None:
            number = await site_number(broker, min(_FIND_S, seconds)) if site_id is None else site_id
            link = Link(broker, LINK_NAME, site=number, kind="doctor")
            site = SiteProbe(SiteView(link, number, used_share=ProcessorUse().share))
    except SkylessError as error:
        advice = "Start the broker and the site's programs, or give --mqtt or --mqtt none."
        checks.append(Check("site", "failed", f"{error}.", advice))
    work = [probe.run() for probe in probes] + ([] if site is None else [site.view.run(None, site.sample)])
    began_s = time.monotonic()
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(seconds if work else 0.0):
            await together(*work, every(1.0, lambda: progress(time.monotonic() - began_s)))
    known = file_site or (None if site is None or site.view.site is None else site.view.site.site)
    for probe in probes:
        checks += probe.checks(NoiseSite() if known is None else known.noise)
    return checks if site is None else [*checks, *site.checks(file_site)]


def _report(checks: "Sequence[Check]") -> str:
    """The report as Markdown, what has failed first."""
    from skyless.core.version import installed_version
    from skyless.run.doctor.check import Result

    order = get_args(Result)
    counts = Counter(check.result for check in checks)
    lines = [
        f"# skyless doctor {installed_version()}, {platform.node()}, {time.strftime('%Y-%m-%d %H:%M')}",
        "",
        f"Python {platform.python_version()} on {platform.platform()}. "
        "Simulated radios and emulated boards are checked as if they were real ones.",
        f"{', '.join(f'{counts[result]} {result}' for result in order)}.",
        "",
    ]
    for check in sorted(checks, key=lambda one: order.index(one.result)):
        lines.append(plain(f"- {check.result}: {check.name}: {check.finding}"))
        lines += [plain(f"  {check.advice}")] if check.advice else []
    return "\n".join([*lines, ""])
