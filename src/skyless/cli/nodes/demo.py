"""``skyless demo``: a whole site as it runs, with emulated radios, from one command."""

import asyncio
import contextlib
import sys
import time
from collections.abc import Awaitable
from shlex import quote
from typing import TYPE_CHECKING, Any, Final

from cyclopts import App

from skyless.cli.common import JsonOptions, command, console, print_json
from skyless.cli.nodes.demo_site import DemoOptions, WholeSite, sentence
from skyless.cli.nodes.options import log, run_until_stopped
from skyless.cli.nodes.site_view import Picture, drawn
from skyless.run.mqtt.address import PASSWORD_VARIABLE, MqttAddress

if TYPE_CHECKING:
    from rich.console import RenderableType

_LONGEST_START_S: Final = 60.0
"""Longest wait until every tag has a fix."""

_POLL_S: Final = 0.05
_FRAME_S: Final = 0.25
"""Interval between two drawings of the site."""

app = App(name="demo", help_epilogue="Example: skyless demo --duration 10 --json")


@app.default
@command
def demo(*, asked: DemoOptions, output: JsonOptions) -> None:
    """Run a site with walking tags in real time; Ctrl-C stops.

    Anchors, tags, broker, page and recorder are the real programs, each a process; radios, clocks and motion are
    simulated. Watch it on the page, or with: mosquitto_sub -t 'skyless/#' -v
    """
    stage = _Stage(asked, output)
    run_until_stopped(stage.run())
    if stage.stopped_early:
        log("stopped")
    summary = stage.summary()
    if output.json:
        print_json(summary)
        return
    if not sys.stdout.isatty() and stage.picture is not None:
        console().print(stage.drawn(stage.picture))
    console().print(sentence(summary), soft_wrap=True)
    if gone := stage.whole.gone:
        console().print(f"gone with this demo: {gone}; --history FOLDER keeps them", soft_wrap=True)


class _Stage:
    """A running demo, which is drawn on a terminal several times a second, and summarised."""

    def __init__(self, asked: DemoOptions, output: JsonOptions) -> None:
        self.whole, self._asked, self._json = WholeSite(asked, log), asked, output.json
        self.picture: Picture | None = None
        self.stopped_early = True
        self._took_s = 0.0

    async def run(self) -> None:
        """Start everything, print the addresses, and watch for the requested time."""
        site, begun_s = asyncio.ensure_future(self.whole.run()), None
        try:
            await _either(site, self.whole.ready.wait())
            self._print_addresses()
            await _either(site, self._until_all_fix())
            begun_s = time.monotonic()
            await _either(site, self._watch())
            self.stopped_early = False
        finally:
            if begun_s is not None:
                self._took_s = time.monotonic() - begun_s
            site.cancel()
            await asyncio.gather(site, return_exceptions=True)

    def _print_addresses(self) -> None:
        """Print all addresses, on standard error if standard output is for JSON."""
        whole = self.whole
        lines = [f"page      {whole.page}", f"broker    {whole.address}"]
        if whole.address is not None:
            lines.append(f"fixes     {_subscriber(whole.address)} -t 'skyless/v1/#' -v")
        lines.append(f"air       --radio ether:127.0.0.1:{whole.ether_port}, for tags and anchors of your own")
        for tag, port in whole.boards.items():
            lines.append(
                f"board     {tag} computes by itself (emulated), at {port}; skyless tag --from-board publishes it"
            )
        if whole.recording is not None:
            lines.append(f"recording {whole.recording}")
        print(*lines, "Ctrl-C stops", sep="\n", file=sys.stderr if self._json else sys.stdout, flush=True)

    async def _until_all_fix(self) -> None:
        """Wait until a fix and the health of every tag have arrived."""
        begun_s = time.monotonic()
        while time.monotonic() - begun_s < _LONGEST_START_S:
            if sum(tag.health is not None for tag in self.whole.figures.tags.values()) >= self._asked.tags:
                return
            await asyncio.sleep(_POLL_S)
        log("not all tags have a fix yet; skyless/… on the broker and the page show more")

    async def _watch(self) -> None:
        """Draw the site, if there is a terminal, until the time is over."""
        from rich.live import Live  # while the site's programs start

        out = console()
        shown = Live(console=out, auto_refresh=False) if out.is_terminal and not self._json else None
        with shown or contextlib.nullcontext(), contextlib.suppress(TimeoutError):
            async with asyncio.timeout(self._asked.duration):
                while True:
                    if self.whole.view is not None:
                        self.whole.view.evaluate()
                        self.picture = self.whole.view.picture()
                        if shown is not None:
                            shown.update(self.drawn(self.picture, out.height - 1), refresh=True)
                    await asyncio.sleep(_FRAME_S)

    def drawn(self, picture: Picture, height: int = sys.maxsize) -> "RenderableType":
        """The site as ``skyless watch`` shows it, with the errors of its fixes."""
        return drawn(picture, height, {name: tag.error_m for name, tag in self.whole.figures.tags.items()})

    def summary(self) -> dict[str, Any]:
        """The figures for JSON."""
        return {
            **self.whole.figures.summary(),
            "restarts": sum(max(0, child.starts - 1) for child in self.whole.children),
            "duration_s": self._took_s,
            "page": self.whole.page,
            "broker": str(self.whole.address),
        }


async def _either(site: asyncio.Task[None], part: Awaitable[object]) -> None:
    """Wait for ``part``, or raise the site's error if it fails first."""
    waiting = asyncio.ensure_future(part)
    try:
        for done in (await asyncio.wait((site, waiting), return_when=asyncio.FIRST_COMPLETED))[0]:
            done.result()
    finally:
        waiting.cancel()


def _subscriber(address: MqttAddress) -> str:
    """Command line of ``mosquitto_sub`` for this broker."""
    words = ["mosquitto_sub"]
    if address.host != "127.0.0.1":
        words.append(f"-h {address.host}")
    words.append(f"-p {address.port}")
    if address.user is not None:
        words.append(f'-u {quote(address.user)} -P "${PASSWORD_VARIABLE}"')
    if address.tls:
        words.append("--tls-use-os-certs" if address.ca is None else f"--cafile {quote(str(address.ca))}")
    return " ".join(words)
