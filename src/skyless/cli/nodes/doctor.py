"""``skyless doctor``: checks of a computer, its boards and a running site."""

import asyncio
import contextlib
import math
import platform
import statistics
import time
from collections import Counter, deque
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
from skyless.cli.nodes.site_view import GONE, LINK_NAME, SiteView, site_number
from skyless.core.any_anchor import beacon_period_s
from skyless.core.errors import SkylessError
from skyless.core.geometry import RADIO_REACH_M
from skyless.core.site import NoiseSite, Site, site_digest
from skyless.core.version import installed_version
from skyless.radio.serial.serial_radio import SerialRadio
from skyless.run.condition.evidence import ProcessorUse
from skyless.run.doctor import (
    BoardProbe,
    Check,
    CounterPairs,
    Result,
    clock_check,
    counters_check,
    judged,
    port_checks,
    residuals_check,
    sentence,
)
from skyless.run.mqtt import topics
from skyless.run.mqtt.address import MqttAddress
from skyless.run.mqtt.connection import Introduction, Reactions, RefusedError, open_connection, trouble_with
from skyless.run.mqtt.link import Link
from skyless.run.mqtt.messages import FixMessage, RequestMessage, StampsMessage
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
    title = f"skyless doctor {installed_version()}, {platform.node()}, {time.strftime('%Y-%m-%d %H:%M')}"
    about = f"Python {platform.python_version()} on {platform.platform()}. {EMULATED}"
    text = report_text(title, about, checks)
    if report is not None:
        write_file(report, text.encode())
    return show_checks(checks, text, report, output)


def show_checks(checks: Sequence[Check], text: str, report: Path | None, output: JsonOptions) -> int:
    """Print checks, or their report as text. Returns the exit code."""
    failed = sum(one.result == "failed" for one in checks)
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
    return tuple(one for one in open_radios(radio, "tag", tuple(ports.split(","))) if isinstance(one, SerialRadio))


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


EMULATED: Final = "Simulated radios and emulated boards are checked as if they were real ones."


def report_text(title: str, about: str, checks: Sequence[Check]) -> str:
    """A report as Markdown, failed checks first."""
    order = get_args(Result)
    counts = Counter(check.result for check in checks)
    lines = [
        f"# {title}",
        "",
        about,
        f"{', '.join(f'{counts[result]} {result}' for result in order)}.",
        "",
    ]
    for check in sorted(checks, key=lambda one: order.index(one.result)):
        lines.append(plain(f"- {check.result}: {check.name}: {check.finding}"))
        lines += [plain(f"  {check.advice}")] if check.advice else []
    return "\n".join([*lines, ""])


# At a running site

_LEASE_S: Final = 15.0


class SiteProbe:
    """Requests the anchors' stamps, and gathers data that are judged at the end."""

    def __init__(self, view: SiteView, clock: Callable[[], float] = time.monotonic) -> None:
        self.view, self._clock = view, clock
        self._picture = view.picture()
        self._found: dict[str, Check] = {}  # by kind of the condition's reason
        self._missed: dict[str, list[float]] = {}  # by anchor
        self._fixes: deque[FixMessage] = deque(maxlen=20_000)
        self._pairs = CounterPairs()
        self._stamps: Counter[tuple[int, int]] = Counter()  # by receiver and sender
        self._stamps_s: dict[int, tuple[float, float]] = {}  # by receiver: times of its first and last message
        view.feed.on(StampsMessage, lambda stamps, _: self._on_stamps(stamps))

    def _on_stamps(self, message: StampsMessage) -> None:
        now_s, anchor = self._clock(), message.anchor
        first_s, _ = self._stamps_s.get(anchor, (now_s, now_s))
        self._stamps_s[anchor] = first_s, now_s
        for stamp in message.stamps:
            if first_s != now_s:  # the first message only starts the time span
                self._stamps[anchor, stamp.anchor] += 1
            self._pairs.add(f"{anchor}/{message.run}", stamp.anchor, stamp.tx_ticks, stamp.rx_ticks, now_s)

    def sample(self) -> None:
        """Gather the view's current data, and renew the request for stamps."""
        self._picture = picture = self.view.picture()
        for reason in picture.condition.reasons:
            result: Result = "failed" if reason.level == "bad" else "warning"
            if reason.kind not in self._found or result == "failed":
                self._found[reason.kind] = Check(f"site: {reason.kind}", result, sentence(reason.text), reason.advice)
        for anchor in picture.anchors:
            if anchor.health is not None and anchor.state not in GONE:
                self._missed.setdefault(anchor.anchor, []).append(anchor.health.missed_share)
        self._fixes.extend(tag.fix for tag in picture.tags if tag.fix is not None and tag.state == "fix")
        request = RequestMessage(LINK_NAME, (), _LEASE_S, stamps=True)
        self.view.link.publish(topics.request_topic(self.view.number), request)

    def known(self, file_site: Site | None, *, named: bool) -> Iterable[Check]:
        """Checks that are already final: the site if ``named``, and faults."""
        message = self.view.site
        if named and message is not None:
            yield self._site(message.whole_site, file_site)
        yield from self._found.values()

    def checks(self, file_site: Site | None) -> tuple[Check, ...]:
        """All checks; ``file_site``: the site that should be running."""
        trouble, message = self._picture.trouble, self.view.site
        if trouble is not None:
            return (broker_failed(trouble),)
        if message is None:
            advice = "Start the site's anchors, or give the right --site-id."
            return (Check("site", "failed", f"The broker has no site of number {self.view.number}.", advice),)
        site = message.whole_site
        measured = [counters_check(self._pairs, site.noise, "anchors' clocks")] if self._missed else []
        if self._missed:
            measured += [self._slots(), self._losses(site)]
        if self._fixes:
            measured.append(residuals_check("residuals", f"{len(self._fixes)} fixes looked at", self._fixes))
        return self._site(site, file_site), *self._found.values(), *measured

    def _site(self, site: Site, file_site: Site | None) -> Check:
        condition, simulated = self._picture.condition, " (simulated)" if self._picture.simulated else ""
        finding = (
            f"{site.name}{simulated}: {condition.tags_with_fix} of {condition.tags} tags have a fix, "
            f"{len(site.all_anchors)} anchors"
        )
        if file_site is not None and site_digest(file_site) != site_digest(site):
            advice = "Start the anchors again with this file, or check the one that was surveyed last."
            return Check("site", "warning", f"{finding}; the anchors are not those of the site file.", advice)
        return Check("site", "ok", f"{finding}.")

    def _slots(self) -> Check:
        shares = {anchor: statistics.mean(shares) for anchor, shares in self._missed.items()}
        worst, share = max(shares.items(), key=lambda one: one[1])
        finding = f"Anchor {worst} misses the most transmissions: {share:.1%}."
        advice = "Its computer is too slow or busy: end other programs there, or move anchors to another computer."
        return judged("transmissions", share, 0.1, 0.5, finding, advice)

    def _losses(self, site: Site) -> Check:
        """Check of the share of beacons that anchors receive from those within the range in the open."""
        places = {one.id: (one.x_m, one.y_m, one.z_m) for one in site.anchors if str(one.id) in self._missed}
        shares = {}
        for receiver, (first_s, last_s) in self._stamps_s.items():
            if receiver not in places or last_s - first_s < 1.0:
                continue
            sent = (last_s - first_s) / beacon_period_s(site)
            for sender, place in places.items():
                if sender != receiver and math.dist(places[receiver], place) < RADIO_REACH_M:
                    shares[receiver, sender] = self._stamps[receiver, sender] / sent
        if not shares:
            advice = "See the user's role at the broker."
            return Check("reception", "not checked", "No anchor has sent its stamps.", advice)
        (receiver, sender), worst = min(shares.items(), key=lambda one: one[1])
        finding = (
            f"Anchors receive {statistics.mean(shares.values()):.0%} of what those within {RADIO_REACH_M:.0f} m send; "
            f"anchor {receiver} receives the least, {worst:.0%} of anchor {sender}."
        )
        advice = "See what stands between them, and how their antennas are turned; skyless plan predicts walls."
        return judged("reception", -worst, -0.4, -0.05, finding, advice)


def broker_failed(trouble: str) -> Check:
    """Failed check of a broker that cannot be used."""
    advice = "Start it (skyless broker), or give another with --mqtt; --mqtt none checks no site."
    return Check("broker", "failed", sentence(trouble), advice)
