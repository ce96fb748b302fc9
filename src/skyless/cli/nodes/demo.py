"""``skyless demo``: a whole site as it runs, with emulated radios, from one command."""

import asyncio
import contextlib
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

from cyclopts import App, Parameter
from cyclopts.validators import Number

from skyless.cli.common.options import IntegrityRisk, NotNegative, Picoseconds, Positive, integrity_of, known_method
from skyless.cli.common.output import console, print_json
from skyless.cli.common.progress import status
from skyless.cli.nodes.options import MqttCa, broker, say, site_named
from skyless.errors import SkylessError
from skyless.method_names import DEFAULT_METHOD

if TYPE_CHECKING:
    from skyless.cli.nodes.demo_screen import Screen
    from skyless.nodes.demo import SiteRun, WholeSite

_START_S: Final = 60.0
"""Programs that have not made a fix for every tag by then will not."""

_LOOK_S: Final = 0.05
_REDRAW_S: Final = 0.25

app = App(name="demo", help_epilogue="Example: skyless demo --duration 10 --json")


@app.default
def demo(
    *,
    duration: Positive | None = None,
    tags: Annotated[int, Parameter(validator=Number(gte=1, lte=200))] = 3,
    speed: Annotated[float, Parameter(validator=Number(gt=0, lte=10))] = 1.0,
    noise_ps: Picoseconds = 100.0,
    seed: Annotated[int, Parameter(validator=Number(gte=0))] = 1,
    site: Path | None = None,
    method: str = DEFAULT_METHOD,
    integrity_risk: IntegrityRisk | None = None,
    alert_limit_m: Positive | None = None,
    max_acceleration: NotNegative | None = None,
    apart: bool = False,
    mqtt: Annotated[str | None, Parameter(env_var="SKYLESS_MQTT")] = None,
    mqtt_ca: MqttCa = None,
    record: str | None = None,
    json: bool = False,
) -> None:
    """Run a site with walking tags in real time; Ctrl-C stops.

    Anchors, tags, broker, page and recorder are the real programs, each a process; radios, clocks and motion are
    simulated. Watch it on the page, or with: mosquitto_sub -t 'skyless/#' -v

    Parameters
    ----------
    duration
        Seconds to run, from when all tags have a fix; by default until Ctrl-C.
    tags
        How many tags walk.
    speed
        How fast they walk in m/s.
    noise_ps
        Noise of every TX and RX stamp in picoseconds.
    seed
        Same seed, same crystals and noise; what processes do in real time is never the same.
    site
        Site file; by default the lab, six anchors on the walls of 6 m × 8 m.
    method
        How positions are computed.
    integrity_risk
        Probability, for each fix, that the error exceeds its protection level (joint); 1e-4 by default.
    alert_limit_m
        Fixes with a higher protection level than so many metres carry an alert (joint).
    max_acceleration
        The largest acceleration of the tags in m/s², for protection levels that cover their hardest turns (joint).
    apart
        Run every anchor and every tag as a process of its own, to kill and to freeze.
    mqtt
        Another broker than the embedded one.
    mqtt_ca
        Certificates (PEM) to trust for mqtts.
    record
        File for the recording, .mcap, or none; by default one in the folder that the page shows.
    json
        Write one JSON object at the end instead of the tables.
    """
    from skyless.cli.nodes.demo_screen import Screen
    from skyless.evaluation.compile_ahead import compile_kernels
    from skyless.nodes.demo import SiteRun, WholeSite
    from skyless.nodes.process import recordings_folder, run

    known_method(method)
    if mqtt == "none":
        raise SkylessError("--mqtt is 'none'; the demo needs a broker, and brings one where --mqtt is not given")
    if mqtt is None and mqtt_ca is not None:
        raise SkylessError("--mqtt-ca is for another broker; give it together with --mqtt")
    name = f"lab:{noise_ps:g}" if site is None else str(site.absolute())
    folder = recordings_folder()
    asked = SiteRun(
        site=site_named(name),
        site_name=name,
        tags=tags,
        speed_mps=speed,
        noise_ps=noise_ps,
        seed=seed,
        method=method,
        integrity=integrity_of(integrity_risk, alert_limit_m, max_acceleration, method),
        broker=None if mqtt is None else broker(mqtt, mqtt_ca),
        record=_recording(record, folder),
        record_limit_mb=1000.0,
        apart=apart,
        recordings=folder,
    )
    with status("loading the kernels; the first start compiles them, which takes some ten seconds"):
        compile_kernels(method)
    whole = WholeSite(asked, say)
    screen = Screen(whole, show=not json and sys.stdout.isatty())
    with screen, contextlib.suppress(KeyboardInterrupt):
        run(_run(whole, asked, screen, duration, json=json))
    _report(screen, json=json)


def _recording(asked: str | None, folder: Path) -> Path | None:
    """Where to record; None: nowhere. Raises SkylessError."""
    from skyless.nodes.process import new_recording

    if asked == "none":
        return None
    file = new_recording(folder, "demo") if asked is None else Path(asked)
    if file.exists() or not file.parent.is_dir():
        raise SkylessError(f"--record is {asked!r}; it should be a new file in a folder that exists, or none")
    return file


async def _run(whole: "WholeSite", asked: "SiteRun", screen: "Screen", duration: float | None, *, json: bool) -> None:
    """Start everything, tell where it is, and watch for as long as was asked."""
    site = asyncio.ensure_future(whole.run())
    try:
        await _either(site, whole.ready.wait())
        screen.tell_places(asked, json=json)
        await _either(site, _until_all_fix(whole, asked.tags))
        screen.begin()
        await _either(site, _watch(screen, duration))
        screen.stopped_early = False
    finally:
        screen.end()
        site.cancel()
        await asyncio.gather(site, return_exceptions=True)


async def _either(site: "asyncio.Task[None]", part: object) -> None:
    """Wait for a part, unless the site fails first."""
    waiting = asyncio.ensure_future(part)  # type: ignore[call-overload]
    try:
        await asyncio.wait((site, waiting), return_when=asyncio.FIRST_COMPLETED)
        if site.done():
            site.result()
    finally:
        waiting.cancel()


async def _until_all_fix(whole: "WholeSite", tags: int) -> None:
    """Until every tag has been heard with a fix and with its health."""
    begun_s = time.monotonic()
    while time.monotonic() - begun_s < _START_S:
        known = whole.watch.tags.values() if whole.watch is not None else ()
        if sum(tag.health is not None for tag in known) >= tags:
            return
        await asyncio.sleep(_LOOK_S)
    say("not all tags have a fix yet; skyless/… on the broker and the page tell more")


async def _watch(screen: "Screen", duration: float | None) -> None:
    begun_s = time.monotonic()
    while duration is None or time.monotonic() - begun_s < duration:
        screen.draw()
        left_s = _REDRAW_S if duration is None else begun_s + duration - time.monotonic()
        await asyncio.sleep(min(max(left_s, 0.0), _REDRAW_S))


def _report(screen: "Screen", *, json: bool) -> None:
    if screen.stopped_early:
        say("stopped")
    if json:
        print_json(screen.summary())
        return
    if not sys.stdout.isatty():
        console().print(screen.tags())
    console().print(screen.closing(), soft_wrap=True)
