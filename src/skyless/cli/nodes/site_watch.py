"""``skyless watch``: a running site as text."""

import sys
from typing import Final

from cyclopts import App
from rich.live import Live

from skyless.cli.common import JsonOptions, command, console, print_json
from skyless.cli.nodes.options import SiteOptions, run_until_stopped
from skyless.cli.nodes.site_view import LINK_NAME, Picture, SiteView, drawn, site_number
from skyless.page.condition.evidence import ProcessorUse
from skyless.run.mqtt.address import MqttAddress
from skyless.run.mqtt.link import Link

_FIND_S: Final = 5.0
_PICTURE_S: Final = 3.0
"""One picture is made after this time: tags and anchors report every second."""

app = App(name="watch", help_epilogue="Example: skyless watch --mqtt mqtts://page@hall.example")


@app.default
@command
def watch(*, live: SiteOptions, output: JsonOptions) -> int:
    """Show a running site as text until Ctrl-C: its condition, alarms, tags, anchors and dropped frames.

    With --json, or where standard output is no terminal, one picture is written after some seconds. The exit code is
    then 1 for a site whose condition is bad.
    """
    address = live.required("the broker of the site to watch")
    once = output.json or not sys.stdout.isatty()
    pictures: list[Picture] = []
    run_until_stopped(_watch(address, live.site_id, pictures, once=once))
    if not once:
        return 0
    if output.json:
        print_json(pictures[-1] if pictures else {"site": None})
    elif pictures:
        console().print(drawn(pictures[-1]))
    return 0 if pictures and pictures[-1].condition.level != "bad" else 1


async def _watch(address: MqttAddress, site_id: int | None, pictures: list[Picture], *, once: bool) -> None:
    if site_id is None:
        site_id = await site_number(address, _FIND_S if once else None)
    view = SiteView(Link(address, LINK_NAME, site=site_id, kind="watch"), site_id, used_share=ProcessorUse().share)
    if once:
        await view.run(_PICTURE_S, lambda: pictures.append(view.picture()))
        return
    out = console()
    with Live(console=out, screen=True, auto_refresh=False) as live:
        await view.run(None, lambda: live.update(drawn(view.picture(), out.height), refresh=True))
