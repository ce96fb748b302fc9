"""``skyless doctor``: checks of a computer, its boards and a running site."""

import asyncio
import contextlib
import platform
import time
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Final, get_args

from cyclopts import App

from skyless.arguments import Options, Positive
from skyless.cli.common import (
    JsonOptions,
    check_folder,
    check_new,
    command,
    plain,
    print_json,
    progress_bar,
    write_file,
)
from skyless.cli.nodes.options import SiteOptions, log
from skyless.cli.nodes.site_probe import SiteProbe, broker_failed
from skyless.cli.nodes.site_view import LINK_NAME, SiteView, site_number
from skyless.core.errors import SkylessError
from skyless.core.site import NoiseSite, Site
from skyless.core.version import installed_version
from skyless.page.condition.evidence import ProcessorUse
from skyless.radio.serial.serial_radio import SerialRadio
from skyless.run.doctor import BoardProbe, Check, Result, clock_check, port_checks, sentence
from skyless.run.mqtt.address import MqttAddress
from skyless.run.mqtt.connection import Introduction, Reactions, RefusedError, open_connection, trouble_with
from skyless.run.mqtt.link import Link
from skyless.run.open_radio import open_radios
from skyless.run.process import every, run, together
from skyless.site.file.load import load_site

_FIND_S: Final = 8.0
_NAMED_S: Final = 3.0
"""Time by which a site's retained messages, and fixes of its tags, have arrived."""

app = App(name="doctor", help_epilogue="Example: skyless doctor --radio serial:/dev/ttyACM0 --mqtt none --duration 30")


class DoctorOptions(Options, frozen=True, kw_only=True):
    """Options of ``skyless doctor``."""

    site: Path | None = None
    """Site file that the running site should have, and by default its number; its noise figures are those that clocks
    are compared with."""
    radio: str | None = None
    """Radio of a board that no other program uses, to listen with it: serial:PATH[@BAUD], or several with commas."""
    duration: Positive = 120.0
    """Seconds to listen; 120 by default."""
    report: Path | None = None
    """File to write the report to as well, Markdown."""
    force: bool = False
    """Overwrite what is there, if the report exists."""


@app.default
@command
def doctor(*, asked: DoctorOptions, live: SiteOptions, output: JsonOptions) -> int:
    """Check this computer, its boards and a running site, and say what to do next.

    The exit code is 1 if anything has failed.
    """
    report = asked.report
    if report is not None:
        check_folder("--report", report)
        check_new(report, force=asked.force)
    file_site = None if asked.site is None else load_site(asked.site)
    site_id = file_site.id if live.site_id is None and file_site is not None else live.site_id
    boards, address = _boards(asked.radio), live.address()
    checks: list[Check] = []

    async def work() -> None:
        with progress_bar("listening", asked.duration) as reach:
            checks.extend(await _examine(boards, address, site_id, file_site, asked.duration, reach))

    log(f"checking for {asked.duration:.0f} s")
    run(work())
    if not checks:
        return 1
    failed = sum(one.result == "failed" for one in checks)
    text = _report(checks)
    if report is not None:
        write_file(report, text.encode())
    if output.json:
        print_json({"checks": checks, "failed": failed, "report": report})
    else:
        print(text, end="")
    return 1 if failed else 0


def _boards(radio: str | None) -> tuple[SerialRadio, ...]:
    """Open the boards that shall listen. Raises SkylessError."""
    if radio is None:
        return ()
    kind, _, ports = radio.partition(":")
    if kind != "serial":
        raise SkylessError(f"--radio is {radio!r}; it should be a board, serial:PATH[@BAUD], as serial:/dev/ttyACM0")
    boards = open_radios(radio, "tag", tuple(ports.split(",")))
    return tuple(one for one in boards if isinstance(one, SerialRadio))


async def _examine(
    boards: Sequence[SerialRadio],
    broker: MqttAddress | None,
    site_id: int | None,
    file_site: Site | None,
    seconds: float,
    progress: Callable[[float], None],
) -> list[Check]:
    """Run all checks, logging each as soon as it is known; ``progress`` is called with the seconds passed."""
    checks = [*port_checks(), clock_check()]
    shown: set[str] = set()

    def tell(found: Iterable[Check]) -> None:
        for check in found:
            if check.name not in shown:
                shown.add(check.name)
                log(plain(f"{check.result}: {check.name}: {check.finding}"))

    def look() -> None:
        passed_s = time.monotonic() - began_s
        progress(passed_s)
        for probe in probes:
            tell(one for one in probe.checks(NoiseSite())[:1] if one.result != "failed")
        if site is not None:
            tell(site.known(file_site, named=passed_s > _NAMED_S))

    tell(checks)
    probes = [BoardProbe(radio, site_id) for radio in boards]
    site: SiteProbe | None = None
    try:
        if broker is not None:
            if site_id is None:
                connection = await open_connection(broker, broker.tls_context(), Introduction("", 10), Reactions())
                await connection.leave()
                site_id = await site_number(broker, min(_FIND_S, seconds))
            link = Link(broker, LINK_NAME, site=site_id, kind="doctor")
            site = SiteProbe(SiteView(link, site_id, used_share=ProcessorUse().share))
    except (OSError, RefusedError) as error:
        assert broker is not None
        checks.append(broker_failed(trouble_with(broker, error)))
    except SkylessError as error:
        advice = "Start the site's anchors and tags, or give another broker with --mqtt; --mqtt none checks no site."
        checks.append(Check("site", "failed", sentence(str(error)), advice))
    work = [probe.run() for probe in probes] + ([] if site is None else [site.view.run(None, site.sample)])
    began_s = time.monotonic()
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(seconds if work else 0.0):
            await together(*work, every(1.0, look))
    known = file_site or (None if site is None or site.view.site is None else site.view.site.site)
    for probe in probes:
        checks += probe.checks(NoiseSite() if known is None else known.noise)
    return checks if site is None else [*checks, *site.checks(file_site)]


def _report(checks: Sequence[Check]) -> str:
    """The report as Markdown, failed checks first."""
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
