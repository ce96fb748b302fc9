"""``skyless survey`` at a running site: gather for some seconds, or serve as the site's survey program."""

import asyncio
import contextlib
import sys
import time
from typing import TYPE_CHECKING

from skyless.cli.common.options import Positive, check_left_out, options
from skyless.cli.common.survey_facts import FactOptions, facts_of
from skyless.cli.nodes.options import MqttCa, SiteId, log
from skyless.errors import SkylessError

if TYPE_CHECKING:
    from collections.abc import Callable

    from skyless.nodes.survey.program import SurveyNode
    from skyless.radios.interface import Radio
    from skyless.site.model import Site
    from skyless.survey.facts import Facts
    from skyless.survey.ranges import PairRanges
    from skyless.survey.stamps.pair_ranger import PairRanger

_USUAL_S = 30.0
_STATUS_S = 0.5
_ERASED = "\r\x1b[2K"
"""Erases a terminal's line."""


@options
class LiveOptions:
    """Options of a survey at a running site."""

    mqtt: str | None = None
    """Broker to survey the running site of: its anchors publish their stamps."""
    mqtt_ca: MqttCa = None
    """Certificates (PEM) to trust for mqtts."""
    radio: str | None = None
    """Radio of a listener, to survey with what it receives instead, as skyless tag --radio; needs --site."""
    radio_name: str = "survey"
    """Name of that listener on an ether: that of one of its bodies, such as tag1."""
    site_id: SiteId | None = None
    """Number of the site; by default that of --site, or the one whose programs are online."""
    duration: Positive | None = None
    """Seconds to listen before the survey; 30 by default."""
    serve: bool = False
    """Stay until Ctrl-C: survey all the while, serve the page, save on its request, and watch the anchors."""
    no_watch: bool = False
    """Do not watch the anchors (--serve)."""

    @property
    def given(self) -> bool:
        """Whether a running site is to be surveyed."""
        return self.mqtt is not None or self.radio is not None

    def check(self, known: FactOptions) -> None:
        """Raises SkylessError."""
        if not self.given:
            others = {
                "duration": self.duration,
                "serve": self.serve or None,
                "no-watch": self.no_watch or None,
                "site-id": self.site_id,
            }
            check_left_out(others, "a running site is surveyed by --mqtt or --radio")
            return
        if self.radio is not None and known.site is None:
            raise SkylessError("--radio needs --site: the listener does not know which anchors there are")
        if self.serve and self.duration is not None:
            raise SkylessError(f"--duration is {self.duration:g}; with --serve the survey does not end")
        if self.no_watch and not self.serve:
            raise SkylessError("--no-watch is for --serve: nothing else watches")


def gather_live(asked: LiveOptions, known: FactOptions) -> "tuple[Site, Callable[[], PairRanges], PairRanger]":
    """The site, the ranges between its anchors after some seconds, and what makes them. Raises SkylessError."""
    from skyless.nodes.process import run

    found: list[SurveyNode] = []
    run(_gather(asked, known, found))
    live = found[0].live if found else None
    if live is None:
        raise SkylessError(f"no site was found at {asked.mqtt}: its anchors are not there, or have not begun yet")
    if not found[0].final_ranges().pairs:
        where = asked.mqtt or asked.radio
        raise SkylessError(
            f"the anchors of site {live.site.name!r} have no ranges at {where} yet; they should be running"
        )
    return live.site, found[0].final_ranges, live.finish()


def serve_live(asked: LiveOptions, known: FactOptions) -> None:
    """Be the survey program of a site until Ctrl-C. Raises SkylessError."""
    from skyless.nodes.process import run

    with contextlib.suppress(KeyboardInterrupt):
        run(_serve(asked, known))


async def _serve(asked: LiveOptions, known: FactOptions) -> None:
    await _run(await _node(asked, known, serves=True), None)


async def _gather(asked: LiveOptions, known: FactOptions, found: "list[SurveyNode]") -> None:
    seconds = asked.duration or _USUAL_S
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(seconds + 1.0):  # a moment for the broker and the anchors to answer
            node = await _node(asked, known, serves=False)
            found.append(node)
            await _run(node, seconds)


async def _run(node: "SurveyNode", seconds: float | None) -> None:
    """Run it, on a terminal with a status line."""
    screen = asyncio.ensure_future(_status(node, seconds)) if sys.stderr.isatty() else None
    try:
        await node.run()
    finally:
        if screen is not None:
            screen.cancel()
            print(file=sys.stderr)


async def _node(asked: LiveOptions, known: FactOptions, *, serves: bool) -> "SurveyNode":
    """Raises SkylessError."""
    from skyless.mqtt.address import mqtt_address
    from skyless.nodes.find_site import find_site
    from skyless.nodes.open_radio import open_radios
    from skyless.nodes.survey.program import SurveyNode, SurveySettings
    from skyless.site.load import load_site
    from skyless.survey.solve import run_survey

    address = None if asked.mqtt is None else mqtt_address(asked.mqtt, asked.mqtt_ca)
    site = None if known.site is None else load_site(known.site)
    site_id = site.id if asked.site_id is None and site is not None else asked.site_id
    if site is not None:
        _facts(known, site)  # options that do not fit it are refused before the program serves
    if site is not None and site_id != site.id:
        raise SkylessError(f"--site-id is {site_id}; the site of {known.site} is number {site.id}")
    if site_id is None:
        assert address is not None  # a radio needs a site file
        site_id = await find_site(address)
    radio: Radio | None = None if asked.radio is None else open_radios(asked.radio, "tag", (asked.radio_name,))[0]
    settings = SurveySettings(site_id, site, known.site, not asked.no_watch, serves)
    return SurveyNode(settings, lambda one: _facts(known, one), run_survey, address, _log, radio)


def _facts(known: FactOptions, site: "Site") -> "Facts":
    return facts_of(known, (anchor.id for anchor in site.all_anchors), site)


def _log(line: str) -> None:
    """Show a line in place of the status line, which follows again below it."""
    if sys.stderr.isatty():
        print(_ERASED, end="", file=sys.stderr)
    log(line)


async def _status(node: "SurveyNode", seconds: float | None) -> None:
    """One line on a terminal, kept up to date."""
    while True:
        await asyncio.sleep(_STATUS_S)
        print(f"{_ERASED}{_line(node, seconds)}", end="", file=sys.stderr, flush=True)


def _line(node: "SurveyNode", seconds: float | None) -> str:
    live = node.live
    if live is None:
        return "survey: waiting for the site"
    now = live.message(time.monotonic(), time.time(), None)
    n = len(live.site.all_anchors)
    what = f"{len(now.anchors)} of {n} anchors, {len(now.pairs)} of {n * (n - 1) // 2} pairs, {now.duration_s:.0f} s"
    return f"survey: {what}{'' if seconds is None else f' of {seconds:.0f} s'}; {now.error or now.state}"
