"""``skyless record``: a running site into a file."""

import asyncio
import contextlib
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING

from cyclopts import App

from skyless.cli.common.options import command
from skyless.cli.common.output import print_json
from skyless.cli.nodes.options import MqttOptions, SiteId, log
from skyless.core.arguments import Positive
from skyless.core.errors import SkylessError

if TYPE_CHECKING:
    from skyless.run.mqtt.address import MqttAddress
    from skyless.run.record import RecorderNode, RecorderState
    from skyless.run.recordings.recorder import McapFile

_STATUS_S = 0.5

app = App(name="record", help_epilogue="Example: skyless record walk.mcap --duration 60")


@app.default
@command
def record(
    file: Path | None = None,
    /,
    *,
    broker: MqttOptions,
    site_id: SiteId | None = None,
    duration: Positive | None = None,
    limit_mb: Positive | None = None,
    json: bool = False,
) -> int:
    """Record a running site until Ctrl-C: raw receptions, fixes, truth, health, site and zones.

    skyless replay computes every fix of a recording again; the dashboard and Foxglove show it.

    Parameters
    ----------
    file
        The recording, a new MCAP file; by default in this folder, named after the time.
    site_id
        Number of the site; by default the one whose programs are online.
    duration
        Seconds to record; by default until Ctrl-C.
    limit_mb
        Megabytes after which the recording ends.
    json
        Write one JSON object at the end instead of text.
    """
    from skyless.run.process import run
    from skyless.run.recordings.recorder import McapFile

    address = broker.address()
    if address is None:
        raise SkylessError("--mqtt is 'none'; it should be the broker of the site to record")
    address.tls_context()
    path = file or Path(time.strftime("skyless-%Y-%m-%dT%H-%M-%S.mcap"))
    out = McapFile(path, None if limit_mb is None else round(limit_mb * 1e6))
    found: list[RecorderNode] = []
    with contextlib.suppress(KeyboardInterrupt, TimeoutError):
        try:
            run(_record(out, address, site_id, duration, found))
        except SkylessError:
            if not found:
                path.unlink()  # nothing was recorded
            raise
        finally:
            out.close()
    _report(path, found[0].state() if found else None, json=json)
    return 1 if out.failed or not found else 0


async def _record(
    file: "McapFile",
    address: "MqttAddress",
    site_id: int | None,
    duration_s: float | None,
    found: "list[RecorderNode]",
) -> None:
    from skyless.run.find_site import find_site
    from skyless.run.record import RecorderNode

    end_s = None if duration_s is None else time.monotonic() + duration_s
    if site_id is None:
        async with asyncio.timeout(duration_s):
            site_id = await find_site(address)
    node = RecorderNode(file, address, site_id, log)
    found.append(node)
    screen = asyncio.ensure_future(_status(node)) if sys.stderr.isatty() else None
    try:
        await node.run(None if end_s is None else max(end_s - time.monotonic(), 0.0))
    finally:
        if screen is not None:
            screen.cancel()
            print(file=sys.stderr)


async def _status(node: "RecorderNode") -> None:
    """One line on a terminal, kept up to date."""
    before = node.state()
    while True:
        await asyncio.sleep(_STATUS_S)
        now = node.state()
        print(f"\r\x1b[2K{_line(before, now)}", end="", file=sys.stderr, flush=True)
        before = now


def _line(before: "RecorderState", now: "RecorderState") -> str:
    if now.trouble is not None:
        return f"recording, {now.seconds:.0f} s: no broker, {now.trouble}"
    span_s = max(now.seconds - before.seconds, 1e-3)
    heard = (now.receptions - before.receptions) / span_s
    fixes = (now.messages.get("fix", 0) - before.messages.get("fix", 0)) / span_s
    rate = f"{now.tags} tags, {heard:.0f} receptions/s, {fixes:.0f} fixes/s"
    return f"recording, {now.seconds:.0f} s: {rate}, {now.bytes / 1e6:.1f} MB; Ctrl-C ends"


def _report(path: Path, state: "RecorderState | None", *, json: bool) -> None:
    import msgspec

    if json:
        print_json({"file": path, **({} if state is None else msgspec.to_builtins(state))})
    elif state is None:
        print(f"{path}: nothing was recorded, as no program of a site was online")
    else:
        print(f"{path}: {state.seconds:.1f} s, {state.bytes / 1e6:.2f} MB, {sum(state.messages.values())} messages")
        for kind, number in sorted(state.messages.items()):
            print(f"  {kind:<12}{number}")
        for reason, number in sorted(state.drops.items()):
            print(f"  dropped: {reason} {number}")
        if state.lost:
            print(f"  not written at the end: {state.lost} messages; {state.ended}")
