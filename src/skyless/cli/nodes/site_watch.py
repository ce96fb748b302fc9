"""``skyless watch``: a running site as text."""

import asyncio
import contextlib
import logging
import math
import os
import sys
import time
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Final

from cyclopts import App

from skyless.cli.common.options import command
from skyless.cli.common.output import console, print_json
from skyless.cli.nodes.options import MqttOptions, SiteId, log
from skyless.core.errors import SkylessError

if TYPE_CHECKING:
    from skyless.cli.nodes._site_view import Picture, SiteView
    from skyless.run.mqtt.address import MqttAddress

_FIND_S: Final = 5.0
_ONCE_S: Final = 2.5
"""--once looks for this long once the broker is connected: tags and anchors report every second."""
_LINE_S: Final = 1.0
_WAIT_SHARE: Final = 3.0
_FEW_LINES: Final = 24

app = App(name="watch", help_epilogue="Example: skyless watch --mqtt mqtts://page@hall.example")


@app.default
@command
def watch(*, broker: MqttOptions, site_id: SiteId | None = None, once: bool = False, json: bool = False) -> int:
    """Show a running site as text until q or Ctrl-C: its condition, alarms, tags, anchors and dropped frames.

    Where standard output is no terminal, a line is written each second. With --once the exit code is 1 for a site whose
    condition is bad.

    Parameters
    ----------
    site_id
        Number of the site; by default the one whose programs are online.
    once
        Write one picture after some seconds, and end.
    json
        Write one JSON object at the end instead of text.
    """
    from skyless.run.process import run

    address = broker.address()
    if address is None:
        raise SkylessError("--mqtt is 'none'; it should be the broker of the site to watch")
    address.tls_context()
    last: list[Picture] = []
    with contextlib.suppress(KeyboardInterrupt):
        run(_watch(address, site_id, last, once=once, quiet=json))
    if json:
        print_json(last[0] if last else {"site": None})
    elif once and last:
        from skyless.cli.nodes._site_screen import drawn

        out = console()
        out.print(drawn(last[0], out.width, max(out.height - 1, _FEW_LINES) if out.is_terminal else sys.maxsize))
    return 1 if once and not (last and last[0].condition.level != "bad") else 0


async def _watch(
    address: "MqttAddress", site_id: int | None, last: "list[Picture]", *, once: bool, quiet: bool
) -> None:
    from skyless.cli.nodes._site_view import SiteView
    from skyless.page.condition.evidence import ProcessorUse
    from skyless.page.condition.monitor import EVALUATION_S
    from skyless.run.find_site import find_site
    from skyless.run.mqtt.link import Link
    from skyless.run.process import keep

    if site_id is None:
        try:
            async with asyncio.timeout(_FIND_S if once else None):
                site_id = await find_site(address)
        except TimeoutError:
            raise SkylessError(
                f"no program of a site is online at {address}; --site-id shows one all the same"
            ) from None
    link = Link(address, f"{os.uname().nodename}-{os.getpid()}", site=site_id, kind="watch")
    view = SiteView(link, site_id, used_share=ProcessorUse().share)
    ends_s = [time.monotonic() + _FIND_S if once else math.inf]
    if once:
        link.on_state.append(lambda up: ends_s.append(time.monotonic() + _ONCE_S) if up else None)
    running, quit_ = asyncio.ensure_future(keep(link, log)), asyncio.Event()
    hidden = contextlib.nullcontext(_nothing)
    shown = hidden if once or quiet else _screen(view, quit_) if sys.stdout.isatty() else _lines(view)
    try:
        with shown as show:
            due_s = time.monotonic()
            while not quit_.is_set() and time.monotonic() < ends_s[-1]:
                began_s = time.monotonic()
                view.evaluate(began_s - due_s)
                show()
                # Of very many tags it takes longer, and the messages are to be read as well.
                wait_s = max(EVALUATION_S, _WAIT_SHARE * (time.monotonic() - began_s))
                due_s = time.monotonic() + wait_s
                with contextlib.suppress(TimeoutError):
                    async with asyncio.timeout(wait_s):
                        await quit_.wait()
    finally:
        last.append(view.picture())
        running.cancel()
        await asyncio.gather(running, return_exceptions=True)


def _nothing() -> None:
    pass


@contextlib.contextmanager
def _lines(view: "SiteView") -> Iterator[Callable[[], None]]:
    """A line each second, for pipes and files."""
    from skyless.cli.nodes._site_screen import summary

    due_s = [time.monotonic() + _LINE_S]

    def show() -> None:
        if time.monotonic() >= due_s[0]:
            due_s[0] = time.monotonic() + _LINE_S
            print(summary(view.picture()), flush=True)

    yield show


@contextlib.contextmanager
def _screen(view: "SiteView", quit_: asyncio.Event) -> Iterator[Callable[[], None]]:
    """The terminal's other screen, whose keys end it. Warnings stand in its last line meanwhile."""
    from rich.live import Live

    from skyless.cli.nodes._site_screen import drawn

    class LastWarning(logging.Handler):
        text = ""

        def emit(self, record: logging.LogRecord) -> None:
            self.text = record.getMessage()

    warnings, logger, out = LastWarning(), logging.getLogger("skyless"), console()
    logger.addHandler(warnings)
    try:
        with _keys(quit_), Live(console=out, screen=True, auto_refresh=False) as live:
            yield lambda: live.update(drawn(view.picture(), *out.size, warnings.text), refresh=True)
    finally:
        logger.removeHandler(warnings)


@contextlib.contextmanager
def _keys(quit_: asyncio.Event) -> Iterator[None]:
    """Let the key q set the event, where standard input is a terminal."""
    if not sys.stdin.isatty():
        yield
        return
    import termios
    import tty

    loop, terminal = asyncio.get_running_loop(), sys.stdin.fileno()
    before = termios.tcgetattr(terminal)

    def read() -> None:
        keys = os.read(terminal, 64)
        if not keys or b"q" in keys.lower():
            quit_.set()

    tty.setcbreak(terminal)
    loop.add_reader(terminal, read)
    try:
        yield
    finally:
        loop.remove_reader(terminal)
        termios.tcsetattr(terminal, termios.TCSADRAIN, before)
