"""``skyless record``: record a running site; ``skyless export``: convert a recording to a ROS 2 bag."""

import asyncio
import contextlib
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import msgspec
from cyclopts import App, Parameter

from skyless.arguments import Options, Positive, wrong
from skyless.cli.common import (
    NO_FIX,
    JsonOptions,
    RecordingFile,
    check_output,
    command,
    print_json,
    print_table,
    print_warnings,
    with_status,
)
from skyless.cli.nodes.options import SiteOptions, log
from skyless.core.errors import SkylessError
from skyless.run.find_site import find_site
from skyless.run.mqtt.address import MqttAddress
from skyless.run.process import run

if TYPE_CHECKING:
    from skyless.bridges.rosbag import Bag
    from skyless.run.record import RecorderNode, RecorderState
    from skyless.run.recordings.recorder import McapFile

app = App(name="record", help_epilogue="Example: skyless record walk.mcap --duration 60")


class RecordOptions(SiteOptions, frozen=True, kw_only=True):
    """Options of ``skyless record``."""

    duration: Positive | None = None
    """Seconds to record; by default until Ctrl-C."""
    limit_mb: Positive | None = None
    """Megabytes after which the recording ends."""


@app.default
@command
def record(file: Path | None = None, /, *, asked: RecordOptions, output: JsonOptions) -> int:
    """Record a running site until Ctrl-C: raw receptions, fixes, truth, health, site and zones.

    skyless replay computes every fix of a recording again; the dashboard and Foxglove show it.

    Parameters
    ----------
    file
        The recording, a new MCAP file; by default in this folder, named after the time.
    """
    from skyless.run.recordings.recorder import McapFile

    address = asked.required("the broker of the site to record")
    path = file or Path(time.strftime("skyless-%Y-%m-%dT%H-%M-%S.mcap"))
    out = McapFile(path, None if asked.limit_mb is None else round(asked.limit_mb * 1e6))
    found: list[RecorderNode] = []
    with contextlib.suppress(KeyboardInterrupt, TimeoutError):
        try:
            run(_record(out, address, asked, found))
        except SkylessError:
            if not found:
                path.unlink()  # nothing was recorded
            raise
        finally:
            out.close()
    _report(path, found[0].state() if found else None, json=output.json)
    return 1 if out.failed or not found else 0


async def _record(file: "McapFile", address: MqttAddress, asked: RecordOptions, found: "list[RecorderNode]") -> None:
    from skyless.run.record import RecorderNode

    end_s = None if asked.duration is None else time.monotonic() + asked.duration
    async with asyncio.timeout(asked.duration):
        site_id = await find_site(address) if asked.site_id is None else asked.site_id
    node = RecorderNode(file, address, site_id, log)
    found.append(node)
    before = node.state()

    def words() -> str:
        nonlocal before
        last, before = before, node.state()
        return _line(last, before)

    await with_status(node.run(None if end_s is None else max(end_s - time.monotonic(), 0.0)), words)


def _line(before: "RecorderState", now: "RecorderState") -> str:
    if now.trouble is not None:
        return f"recording, {now.seconds:.0f} s: no broker, {now.trouble}"
    span_s = max(now.seconds - before.seconds, 1e-3)
    heard = (now.receptions - before.receptions) / span_s
    fixes = (now.messages.get("fix", 0) - before.messages.get("fix", 0)) / span_s
    rate = f"{now.tags} tags, {heard:.0f} receptions/s, {fixes:.0f} fixes/s"
    return f"recording, {now.seconds:.0f} s: {rate}, {now.bytes / 1e6:.1f} MB; Ctrl-C ends"


def _report(path: Path, state: "RecorderState | None", *, json: bool) -> None:
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


export_app = App(name="export", help_epilogue="Example: skyless export walk.mcap --to walk_bag")


class ExportOptions(Options, frozen=True, kw_only=True):
    """Options of ``skyless export``."""

    tag: str | None = None
    """Name of the only tag to write; by default all."""
    frame: str = "site"
    """Name of the site's frame in the messages."""
    transforms: bool = False
    """Write a transform from that frame to each tag's, too (/tf)."""
    bag_version: Literal["9", "8"] = "9"
    """Of the bag's metadata: 9 for ROS 2 from Jazzy on, 8 for Humble and Iron."""


_Bag = Annotated[Path, Parameter(help="Where fixes go: the bag, a new folder.")]


@export_app.default
@command
def export(file: RecordingFile, /, *, to: _Bag, asked: ExportOptions, output: JsonOptions) -> int:
    """Write a recording of skyless record as a bag of ROS 2: MCAP, for ros2 bag play, Foxglove, Rerun, PlotJuggler.

    Each tag gets the topics pose, velocity, fix (where the site file has a georeference) and truth (where it is
    simulated) below /skyless/TAG; anchors and health become /skyless/anchors and /diagnostics. Needs the extra ros2.
    """
    from skyless.bridges.rosbag import FRAME_NAME, FRAME_RULE, RosEncoder, write_bag

    check_output("to", to, file)
    if not FRAME_NAME.fullmatch(asked.frame):
        raise wrong("--frame", asked.frame, FRAME_RULE)
    encoder = RosEncoder(asked.frame, transforms=asked.transforms)
    bag = write_bag(file, to, encoder, asked.tag, 8 if asked.bag_version == "8" else 9)
    if output.json:
        print_json(bag)
    else:
        _show(bag)
    return 0 if bag.fixes else NO_FIX


def _show(bag: "Bag") -> None:
    rows = ((topic, bag.types[topic], str(count)) for topic, count in bag.topics.items())
    print_table(f"{bag.path}, {bag.end_s - bag.start_s:.1f} s", ("topic", "type", "messages"), rows)
    warnings = [f"not readable: {reason} {count}" for reason, count in bag.drops.items()]
    if not bag.finished:
        warnings.append(
            "the recording has no end: it was cut off, or is still being written; later messages are missing"
        )
    if bag.unusable:
        warnings.append(f"{bag.unusable} fixes were left out: their alert forbids their use, or they are not finite")
    if not bag.fixes:
        warnings.append("there is no fix in the bag")
    print_warnings(warnings)
