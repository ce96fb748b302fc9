"""``skyless history``: what happened at a site, kept in Parquet files."""

import asyncio
import contextlib
import sys
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

from cyclopts import App, Parameter

from skyless.cli.common.options import command, make_folder
from skyless.cli.common.output import print_json
from skyless.cli.history_queries import questions
from skyless.cli.nodes.options import MqttOptions, SiteId, log
from skyless.core.arguments import Positive
from skyless.core.errors import SkylessError
from skyless.core.extras import extra_module

if TYPE_CHECKING:
    from collections.abc import Awaitable, Callable

    from skyless.run.gather.streams import NatsAddress
    from skyless.run.history.program import HistoryNode, HistoryState, HubHistory
    from skyless.run.history.writer import Keep
    from skyless.run.mqtt.address import MqttAddress

    _History = HistoryNode | HubHistory

_STATUS_S: Final = 0.5

HistoryFolder = Annotated[Path, Parameter(name="--to")]

app = App(name="history", help_epilogue="Example: skyless history run --to history")
app.update(questions)


@app.command(help_epilogue="Example: skyless history run --to history --keep-days 90")
@command
def run(
    *,
    to: HistoryFolder,
    broker: MqttOptions,
    nats: Annotated[str | None, Parameter(env_var="SKYLESS_NATS")] = None,
    from_: Annotated[str | None, Parameter(name="--from")] = None,
    site_id: SiteId | None = None,
    keep_days: Positive = 400.0,
    full_days: Positive = 7.0,
    event_days: Positive = 365.0,
    json: bool = False,
) -> int:
    """Keep the fixes and events of a running site, or of a hub's, until Ctrl-C, in Parquet files for any tool.

    What was received 0.1 s before a kill -9 is kept. Give the same folder at every start. The exit code is 1 where the
    disk did not take everything.

    Parameters
    ----------
    to
        Where fixes are kept: a folder, which several sites may share.
    nats
        NATS server of a site with a gather, nats://[USER@]HOST[:PORT] or tls://...: its stream then gives the fixes.
    from_
        Servers of a hub, nats://[USER@]HOST[:PORT],HOST... or tls://...: all its sites are kept, or that of --site-id.
    site_id
        Number of the site; by default the one whose programs are online.
    keep_days
        Days after which fixes are removed.
    full_days
        Days after which fixes are thinned: of a moving tag one in ten seconds stays, of a tag at rest one in a minute.
    event_days
        Days after which events are removed: entered and left zones, alarms, anchors and tags that came and went.
    json
        Write one JSON object at the end instead of text.
    """
    from skyless.run import process
    from skyless.run.gather.streams import nats_address
    from skyless.run.history.writer import Keep

    keep = Keep(keep_days, full_days, event_days)
    found: list[_History] = []
    if from_ is not None:
        extra_module("nats", "--from")
        if broker.mqtt is not None or nats is not None:
            raise SkylessError(f"--from is {from_!r}; give it without --mqtt and --nats, which are of a single site")
        hub = nats_address(from_, "--from", broker.mqtt_ca)
        hub.tls_context()
        opening = partial(_of_hub, to, hub, site_id, keep)
    else:
        address = broker.required("the broker of the site whose history to keep")
        opening = partial(_of_broker, to, address, site_id, keep, None if nats is None else nats_address(nats))
    make_folder("--to", to)
    with contextlib.suppress(KeyboardInterrupt):
        process.run(_keep(opening, found))
    state = found[0].state() if found else None
    if json:
        import msgspec

        print_json({"folder": to, **({} if state is None else msgspec.to_builtins(state))})
    elif state is None:
        print(f"{to}: nothing was kept, as no program of a site was online")
    else:
        print(f"{to}: {_counts(state)} in {state.seconds:.0f} s{_losses(state)}")
    return 1 if state is not None and (state.disk or state.lost) else 0


async def _of_broker(
    folder: Path, address: "MqttAddress", site_id: int | None, keep: "Keep", nats: "NatsAddress | None"
) -> "_History":
    from skyless.run.find_site import find_site
    from skyless.run.history.program import HistoryNode
    from skyless.run.history.writer import Writer

    site = await find_site(address) if site_id is None else site_id
    return HistoryNode(Writer(folder, site), address, keep, log, nats)


async def _of_hub(folder: Path, hub: "NatsAddress", site_id: int | None, keep: "Keep") -> "_History":
    from skyless.run.history.program import HubHistory

    return HubHistory(folder, hub, site_id, keep, log)


async def _keep(opening: "Callable[[], Awaitable[_History]]", found: "list[_History]") -> None:
    """Keep a history until cancelled; ``found`` gets it."""
    node = await opening()
    found.append(node)
    screen = asyncio.ensure_future(_status(node)) if sys.stderr.isatty() else None
    try:
        await node.run()
    finally:
        if screen is not None:
            screen.cancel()
            print(file=sys.stderr)


async def _status(node: "_History") -> None:
    """One line on a terminal, kept up to date."""
    while True:
        await asyncio.sleep(_STATUS_S)
        now = node.state()
        trouble = now.disk or (f"no broker, {now.trouble}" if now.trouble else "Ctrl-C ends")
        line = (
            f"history, {now.seconds:.0f} s: {_counts(now)}, {now.waiting} rows in the journal{_losses(now)}; {trouble}"
        )
        print(f"\r\x1b[2K{line}", end="", file=sys.stderr, flush=True)


def _counts(state: "HistoryState") -> str:
    return f"{state.fixes} fixes of {state.tags} tags and {state.events} events"


def _losses(state: "HistoryState") -> str:
    lost = [f"{count} {reason}" for reason, count in sorted(state.drops.items())]
    lost += [f"{state.lost} that the disk did not take"] if state.lost else []
    return f"; not kept: {', '.join(lost)}" if lost else ""


@app.command(name="import", help_epilogue="Example: skyless history import walk.mcap --to history")
@command
def import_file(recording: Path, /, *, to: HistoryFolder, site_id: SiteId | None = None, json: bool = False) -> None:
    """Add the fixes, zone events and zones of a recording to a history; what that has already is left out.

    Parameters
    ----------
    recording
        The recording, an MCAP file of skyless record.
    to
        Where fixes are kept: a folder, which several sites may share.
    site_id
        Number of the site; by default the one that was recorded.
    json
        Write one JSON object instead of text.
    """
    import msgspec

    from skyless.cli.common.progress import progress_bar
    from skyless.run.history.program import import_recording
    from skyless.run.history.writer import Writer
    from skyless.run.recordings.recording import McapRecording

    with McapRecording(recording) as source:
        summary = source.summary()
        site = summary.site if site_id is None else site_id
        if site is None:
            raise SkylessError(f"{recording} does not say of which site it is; --site-id should")
        begin_s, end_s = summary.start_s or 0.0, summary.end_s or 0.0
        with progress_bar("importing", end_s - begin_s) as reach:
            writer = Writer(to, site)
            try:
                found = import_recording(source, writer, lambda unix_s: reach(unix_s - begin_s))
            finally:
                writer.close()
    if json:
        print_json({"folder": to, "site": site, **msgspec.to_builtins(found)})
        return
    print(f"{to}: {found.fixes} fixes and {found.events} events of site {site}; {found.known_fixes} fixes were there")
    for reason, number in sorted(found.drops.items()):
        print(f"  dropped: {reason} {number}")
