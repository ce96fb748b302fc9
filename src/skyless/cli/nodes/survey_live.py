"""``skyless survey`` at a running site: gather ranges for some seconds, or serve as the site's survey program."""

import asyncio
import contextlib
import time
from pathlib import Path
from typing import TYPE_CHECKING

from skyless.arguments import Options, Positive
from skyless.cli.common import with_status
from skyless.cli.nodes.options import MqttCa, SiteId, log, run_until_stopped
from skyless.core.errors import SkylessError
from skyless.core.site import Site
from skyless.research.calibration.options import SurveyOptions
from skyless.run.find_site import find_site
from skyless.run.mqtt.address import mqtt_address
from skyless.run.open_radio import open_radios
from skyless.run.process import run
from skyless.site.file.load import load_site

if TYPE_CHECKING:
    from collections.abc import Callable

    from skyless.run.survey.program import SurveyNode
    from skyless.site.survey.facts import Facts, PairRanges
    from skyless.site.survey.pair_ranger import PairRanger

_USUAL_S = 30.0


class LiveOptions(Options, frozen=True, kw_only=True):
    """Options of a survey at a running site."""

    mqtt: str | None = None
    """Broker to survey the running site of: its anchors publish their stamps."""
    mqtt_ca: MqttCa = None
    """Certificates (PEM) to trust for mqtts."""
    radio: str | None = None
    """Radio of a listener, to survey with what it receives instead, as skyless tag --radio; needs --site."""
    radio_name: str = "survey"
    """Name of that listener on an ether, one of its tags, such as tag1."""
    site_id: SiteId | None = None
    """Number of the site; by default that of --site, or the one whose programs are online."""
    duration: Positive | None = None
    """Seconds to listen before the survey; 30 by default."""
    serve: bool = False
    """Stay until Ctrl-C: survey all the while, serve the page, save on its request, and watch the anchors."""

    @property
    def is_live(self) -> bool:
        """Whether to survey a running site."""
        return self.mqtt is not None or self.radio is not None

    def check(self) -> None:
        """Check that the options are compatible. Raises SkylessError."""
        if not self.is_live:
            why = "a running site is surveyed by --mqtt or --radio"
            self.leave_out("duration", "serve", "site_id", why=why)
        if self.serve:
            self.leave_out("duration", why="with --serve the survey does not end")


def gather_live(asked: LiveOptions, known: SurveyOptions) -> "tuple[Site, Callable[[], PairRanges], PairRanger]":
    """Gather ranges for some seconds: the site, its anchors' ranges, and their source. Raises SkylessError."""
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


def serve_live(asked: LiveOptions, known: SurveyOptions) -> None:
    """Run as the survey program of a site until Ctrl-C. Raises SkylessError."""

    async def serve() -> None:
        node = await _node(asked, known, serves=True)
        await with_status(node.run(), lambda: _line(node, None))

    run_until_stopped(serve())


async def _gather(asked: LiveOptions, known: SurveyOptions, found: "list[SurveyNode]") -> None:
    seconds = asked.duration or _USUAL_S
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(seconds + 1.0):  # a moment for the broker and the anchors to answer
            node = await _node(asked, known, serves=False)
            found.append(node)
            await with_status(node.run(), lambda: _line(node, seconds))


async def _node(asked: LiveOptions, known: SurveyOptions, *, serves: bool) -> "SurveyNode":
    """Create the survey program. Raises SkylessError."""
    from skyless.run.survey.program import SurveyNode, SurveySettings
    from skyless.site.survey.solve import run_survey

    address = None if asked.mqtt is None else mqtt_address(asked.mqtt, asked.mqtt_ca)
    file = None if known.site is None else Path(str(known.site))
    site = None if file is None else load_site(file)
    site_id = site.id if asked.site_id is None and site is not None else asked.site_id
    if site is not None:
        _facts(known, site)  # refuses options that do not fit the site before the program serves
        if site_id != site.id:
            raise SkylessError(f"--site-id is {site_id}; the site of {known.site} is number {site.id}")
    if site_id is None:
        assert address is not None  # a radio needs a site file
        site_id = await find_site(address)
    radio = None if asked.radio is None else open_radios(asked.radio, "tag", (asked.radio_name,))[0]
    settings = SurveySettings(site_id, site, file, serves)
    return SurveyNode(settings, lambda one: _facts(known, one), run_survey, address, log, radio)


def _facts(known: SurveyOptions, site: Site) -> "Facts":
    from skyless.research.calibration.options import facts_of

    return facts_of(known, (anchor.id for anchor in site.all_anchors), site)


def _line(node: "SurveyNode", seconds: float | None) -> str:
    live = node.live
    if live is None:
        return "survey: waiting for the site"
    now = live.message(time.monotonic(), time.time(), None)
    n = len(live.site.all_anchors)
    what = f"{len(now.anchors)} of {n} anchors, {len(now.pairs)} of {n * (n - 1) // 2} pairs, {now.duration_s:.0f} s"
    return f"survey: {what}{'' if seconds is None else f' of {seconds:.0f} s'}; {now.error or now.state}"
