"""``skyless site``: write and check site files; for their keys see ``site_keys``."""

import math
import secrets
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, Final, Literal

import numpy as np
from cyclopts import App, Parameter
from msgspec.structs import replace

from skyless.arguments import number, numbers, read_height, whole
from skyless.cli.common import (
    JsonOptions,
    check_folder,
    check_new,
    command,
    console,
    print_facts,
    print_json,
    print_table,
    print_warnings,
    write_file,
)
from skyless.cli.nodes.options import SiteId
from skyless.core.air.almanac import OFFERED_HZ, SHORTEST_PERIOD_S
from skyless.core.air.beacon import HAS_AUTHENTICATION, HAS_PAGE, HAS_POSITION, bare_bytes
from skyless.core.air.frame import HEARD_BYTES, MAX_FRAME_BYTES, air_time_s
from skyless.core.any_anchor import beacon_period_s
from skyless.core.errors import SkylessError
from skyless.core.geometry import RADIO_REACH_M, anchor_positions, anchors_in_reach, pairs_within
from skyless.core.protocol1.beacon import first_slots, schedule_of
from skyless.core.site import FloorSite, ScheduleSite, Site
from skyless.core.ticks import TICK_S
from skyless.radio.serial.link import Writer
from skyless.sim.lab import lab_site
from skyless.site.file.check import ANY_ADDRESS, check_site
from skyless.site.file.load import load_site
from skyless.site.file.template import grid_site, rectangle, rectangular_site, site_template, unplaced_site

_Metres = Annotated[float, number(above=0.0, most=10_000.0)]
_RoomMetres = Annotated[float, number(least=0.1, most=10_000.0)]
"""Length of a room's side, long enough for 255 anchors along the walls."""
_GRID_HEIGHT_M: Final = 4.0
_TAGS_BELOW_A_GRID_M: Final = 1.2
_PAPER_SLOT_S: Final = 2.5e-3
_LINE_BYTES_PER_S: Final = 457_143 / 10
"""What the debugger of a DWM1001-DEV carries: 460,800 baud, of which an nRF52832 makes 457,143; 10 bits a byte."""
_PACED: Final = "# So few beacons that a tag's line is half full at most, with all anchors in view: a DWM1001-DEV's.\n"
_LONGEST_TABLE: Final = 40
"""Most anchors to show one per row; for more there is only a summary."""
_Count = Annotated[int, whole(1, 255)]

app = App(name="site", help_epilogue="Example: skyless site check site.toml")
app.command("skyless.cli.site_keys:app", name="keys", help="Make, replace and show the keys of a site.")


class NewOptions(JsonOptions, frozen=True, kw_only=True):
    """Options of ``skyless site new``."""

    file: Path
    """The site file to write."""
    name: str | None = None
    """Name of the site; by default the file's."""
    width: _RoomMetres | None = None
    """The room's width along x in metres."""
    depth: _RoomMetres | None = None
    """The room's depth along y in metres."""
    anchor_count: _Count | None = None
    """How many anchors hang evenly along the room's walls; 6 by default."""
    height: _Metres | None = None
    """The room's height in metres, 3 by default; the anchors alternate between floor and ceiling. With --spacing the
    height of all anchors, 4 by default."""
    spacing: _Metres | None = None
    """Spacing in metres of a square grid of anchors, which may be of any size."""
    unplaced: _Count | None = None
    """How many anchors, 1 to this number, without positions."""
    paper: bool = False
    """Use the paper's protocol (mode master): the anchor that the others receive best is the master."""
    phases: bool = False
    """Let anchors relay carrier phases (DW1000), at the rate that tags in hands need to lock: as many as fit."""
    board: Literal["dwm1001-dev"] | None = None
    """The tags' board, if its serial port carries less than anchors send by default: they then send more rarely, and
    with --phases tags in hands may not lock."""
    tag_height: str | None = None
    """The tags' height: metres, at which all of them move (2-D), or free, the default: estimated (3-D). With --spacing,
    whose anchors lie in one plane, the default is 1.2."""
    site_id: SiteId | None = None
    """Number of the site on the air, which neighbouring sites must not share; by default a random one."""
    force: bool = False
    """Overwrite what is there, if the file exists."""


@app.command(help_epilogue="Example: skyless site new hall.toml --width 30 --depth 20 --anchor-count 8 --height 4")
@command
def new(asked: NewOptions) -> None:
    """Write a commented site file to start from: the lab, with --width and --depth a room, with --spacing a large hall.

    With --unplaced the anchors have no positions yet, which skyless survey then finds.
    """
    file = asked.file
    _check_free(file, force=asked.force)
    site = _new_site(asked)
    number = 1 + secrets.randbelow(ANY_ADDRESS) if asked.site_id is None else asked.site_id  # any on the air but 0
    site = replace(site, name=asked.name or file.stem, id=number)
    if asked.phases:
        if asked.paper:
            raise SkylessError("--phases needs anchors that send without a master; leave --paper out")
        site = replace(site, schedule=replace(site.schedule, carrier_phase=True))
    if asked.board is not None:
        site = _paced(site)
    check_site(site, file)
    write_file(file, site_template(site, "" if asked.board is None else _PACED).encode())
    if asked.json:
        print_json({"file": file, "name": site.name, "id": site.id, "anchors": len(site.all_anchors)})
    else:
        console().print(f"wrote {file}; next: skyless site check {file}", markup=False)


def _new_site(asked: NewOptions) -> Site:
    """Create the requested site, without its name and number. Raises SkylessError."""
    width, depth, spacing, unplaced = asked.width, asked.depth, asked.spacing, asked.unplaced
    if asked.paper and (unplaced is not None or spacing is not None):
        raise SkylessError("--paper is for one room; its anchors need positions, and all receive one master")
    sizes = asked.given("width", "depth", "anchor_count", "height")
    if asked.tag_height is None:
        height_m = None if spacing is None else _TAGS_BELOW_A_GRID_M
    else:
        wish = read_height("--tag-height", asked.tag_height, ("free",))
        height_m = None if isinstance(wish, str) else wish
    if unplaced is not None:
        if sizes or spacing is not None:
            raise SkylessError(f"--unplaced is {unplaced}; it takes no sizes: anchors without positions fill no room")
        return unplaced_site(unplaced, height_m)
    if spacing is not None:
        if width is None or depth is None or asked.anchor_count is not None:
            raise SkylessError("a grid needs --spacing, --width and --depth; how many --anchor-count follows from them")
        try:
            return grid_site(width, depth, spacing, asked.height or _GRID_HEIGHT_M, height_m)
        except ValueError as error:
            raise SkylessError(f"no grid of {spacing:g} m: {error}") from None
    if width is not None and depth is not None:
        site = rectangular_site(width, depth, asked.anchor_count or 6, asked.height or 3.0, height_m)
        check_site(site, asked.file)
    elif not sizes and asked.tag_height is None:
        site = replace(lab_site(), outline_m=rectangle(6.0, 8.0))
    else:
        raise SkylessError("a room needs both --width and --depth; without them the lab is written")
    if asked.paper:
        from skyless.site.channel import ChannelModel
        from skyless.site.planning.superframe import with_best_master

        site = with_best_master(replace(site, schedule=ScheduleSite(slot_s=_PAPER_SLOT_S)), ChannelModel())
    return site


def _paced(site: Site) -> Site:
    """The site with half as many beacons as a DWM1001-DEV's line carries, or fewer. Raises SkylessError.

    In view are all anchors of a room: those that a tag receives at once are within twice the reach of each other.
    """
    near = pairs_within(anchor_positions(site), 2.0 * RADIO_REACH_M)
    others = Counter(row for pair in near for rows in pair[:2] for row in rows.tolist())
    in_view = len(site.unplaced) or 1 + max(others.values(), default=0)
    relaying = bare_bytes(HAS_POSITION | HAS_PAGE | HAS_AUTHENTICATION) + HEARD_BYTES * (in_view - 1)
    frame = bytes(MAX_FRAME_BYTES if site.schedule.needs_master else min(relaying, MAX_FRAME_BYTES))
    beacons_per_s = 0.5 * _LINE_BYTES_PER_S / len(Writer().rx(0, 0, 0, 0, frame, phase=0))  # tags ask for phases
    if site.schedule.needs_master:
        return replace(site, schedule=replace(site.schedule, slot_s=math.ceil(1e4 / beacons_per_s) / 1e4))
    if in_view > beacons_per_s:
        most = int(beacons_per_s)
        raise SkylessError(f"--board is dwm1001-dev; its line carries {most} anchors in view, not {in_view}")
    rate_hz = math.floor(10.0 * min(beacons_per_s / in_view, 1.0 / SHORTEST_PERIOD_S)) / 10.0
    return replace(site, schedule=replace(site.schedule, rate_hz=rate_hz))


def _check_free(file: Path, *, force: bool) -> None:
    """Raise SkylessError if the file cannot be written without loss."""
    if file.is_dir():
        raise SkylessError(f"{file} is a folder; it should be the name of a file to write")
    check_new(file, force=force)


@app.command(help_epilogue="Example: skyless site check site.toml --json")
@command
def check(file: Annotated[Path, Parameter(help="The site file.")], /, *, output: JsonOptions) -> None:
    """Check a site file, and show what it makes: anchors, slots, rates, and what may cost accuracy.

    A mistake ends with exit code 2 and a message that names the key and what it should be; warnings do not.
    """
    report = _report(load_site(file))
    if output.json:
        print_json(report)
    else:
        _show(file, report)


class SheetOptions(JsonOptions, frozen=True, kw_only=True):
    """Options of ``skyless site sheet``."""

    file: Path
    """The site file."""
    output: Path
    """The sheet to write, .pdf or .png."""
    cables_from: Annotated[tuple[float, ...] | None, numbers(2, 3, form="X,Y or X,Y,HEIGHT")] = None
    """Where the cables begin, such as the switch, in metres; the height is 0 by default. The sheet then has their
    lengths."""
    force: bool = False
    """Overwrite what is there, if the sheet exists."""


@app.command(help_epilogue="Example: skyless site sheet site.toml sheet.pdf --cables-from 0.5,0.5")
@command
def sheet(asked: SheetOptions) -> None:
    """Write the sheet for those who mount the anchors: a page A4 with plan and table for each floor."""
    from skyless.site.planning.sheet import mounts, sheet

    output = asked.output
    kinds: dict[str, Literal["pdf", "png"]] = {".pdf": "pdf", ".png": "png"}
    if (kind := kinds.get(output.suffix.lower())) is None:
        raise SkylessError(f"OUTPUT is {str(output)!r}; its ending should be .pdf or .png")
    check_folder("OUTPUT", output)
    _check_free(output, force=asked.force)
    start = None
    if asked.cables_from is not None:
        x_m, y_m, z_m = (*asked.cables_from, 0.0)[:3]
        start = x_m, y_m, z_m
    site = load_site(asked.file)
    write_file(output, sheet(site, asked.file, kind, time.strftime("%Y-%m-%d"), start))
    if asked.json:
        print_json({"file": output, "anchors": mounts(site, start)})
    else:
        console().print(f"wrote {output}: {len(site.anchors)} anchors", markup=False)


def _report(site: Site) -> dict[str, Any]:
    """The report on a valid site, SI units."""
    from skyless.site.channel import ChannelModel
    from skyless.site.file.advice import warnings_of
    from skyless.site.planning.superframe import master_warnings, reception_of

    period_s, frame_s = beacon_period_s(site), air_time_s(MAX_FRAME_BYTES)
    anchors: list[dict[str, Any]] = [
        {"id": one.id, "x_m": one.x_m, "y_m": one.y_m, "z_m": one.z_m} for one in site.anchors
    ]
    warnings = warnings_of(site)
    report: dict[str, Any] = {
        "name": site.name,
        "id": site.id,
        "mode": site.schedule.mode,
        "master": site.master if site.schedule.needs_master else None,
        "tag_height_m": site.tags.height_m,
        "floors": [_floor(floor, site) for floor in site.storeys],
        "anchors": anchors,
        "unplaced": [{"id": anchor.id} for anchor in site.unplaced],
        "beacons_per_s_of_each_anchor": 1.0 / period_s,
        "longest_frame_s": frame_s,
    }
    if site.schedule.needs_master:
        schedule, first = schedule_of(site), first_slots(site)
        for anchor, share in zip(anchors, reception_of(site, ChannelModel()).share.tolist(), strict=True):
            anchor |= {"slots": schedule.slots_of(first[anchor["id"]]), "hears_master": share}
        messages_per_s = schedule.messages_per_s(len(site.all_anchors))
        warnings += master_warnings(site, ChannelModel())
        report |= {
            "slots": schedule.slots,
            "slot_s": schedule.slot_ticks * TICK_S,
            "superframe_s": schedule.superframe_ticks * TICK_S,
            "superframes_per_s": schedule.superframe_rate_hz,
            "messages_per_s": messages_per_s,
            "occupancy": messages_per_s * frame_s,
        }
    else:
        in_reach = anchors_in_reach(site) if site.anchors else np.zeros(1)
        report |= {
            "reach_m": RADIO_REACH_M,
            "fewest_in_reach": int(in_reach.min()),
            "median_in_reach": float(np.median(in_reach)),
            "most_in_reach": int(in_reach.max()),
            "offered_in_reach_per_s": float(np.median(in_reach)) / period_s,
            "best_offered_per_s": OFFERED_HZ,
        }
    return report | {"warnings": warnings}


def _floor(floor: FloorSite, site: Site) -> dict[str, Any]:
    loss_db, delay_m = floor.slab
    return {
        "number": floor.number,
        "name": floor.name,
        "low_m": floor.low_m,
        "slab_loss_db": loss_db,
        "slab_delay_m": delay_m,
        "anchors": sum(anchor.floor == floor.number for anchor in site.anchors),
    }


def _show(file: Path, report: dict[str, Any]) -> None:
    title, anchors = f"{report['name']} ({file})", [*report["anchors"], *report["unplaced"]]
    if len(anchors) <= _LONGEST_TABLE:
        more = ("slots", "hears master") if report["master"] is not None else ()
        heads = ("anchor", "x / m", "y / m", "z / m", *more)
        print_table(title, heads, (_row(anchor, report) for anchor in anchors), figures=True)
    else:
        print_facts(title, _summary(report))
    if report["floors"]:
        heads = ("floor", "name", "from / m", "slab / dB", "slab / m", "anchors")
        print_table("floors", heads, ([str(value) for value in floor.values()] for floor in report["floors"]))
    height = report["tag_height_m"]
    tags = "estimate their height (3-D)" if height is None else f"move at a height of {height:g} m (2-D)"
    out = console()
    out.print(f"{_schedule_lines(report)}\ntags {tags}")
    print_warnings(report["warnings"])
    out.print("the site file is valid" if not report["warnings"] else "the site file is valid, with warnings")


def _row(anchor: dict[str, Any], report: dict[str, Any]) -> list[str]:
    role = " (master)" if anchor["id"] == report["master"] else ""
    position = [f"{anchor[axis]:.3f}" if axis in anchor else "?" for axis in ("x_m", "y_m", "z_m")]
    heard = [" ".join(map(str, anchor["slots"])), f"{anchor['hears_master']:.0%}"] if "slots" in anchor else []
    return [f"{anchor['id']}{role}", *position, *heard]


def _summary(report: dict[str, Any]) -> Iterator[tuple[str, str]]:
    """Summary of many anchors in a few lines."""
    anchors, unplaced = report["anchors"], report["unplaced"]
    yield "anchors", str(len(anchors) + len(unplaced))
    if unplaced:
        yield "without a position", str(len(unplaced))
    for axis in ("x_m", "y_m", "z_m") if anchors else ():
        values = [anchor[axis] for anchor in anchors]
        yield f"{axis[0]} / m", f"{min(values):.3f} … {max(values):.3f}"
    if report["mode"] != "master":
        span = f"{report['fewest_in_reach']} … {report['most_in_reach']} anchors with itself"
        yield f"within {report['reach_m']:.0f} m of an anchor", f"{span}, median {report['median_in_reach']:.0f}"


def _schedule_lines(report: dict[str, Any]) -> str:
    """Describe the schedule: rates, and occupancy of the air."""
    frame = f"the longest frame takes {report['longest_frame_s'] * 1e6:.0f} µs"
    rate = f"each anchor sends {report['beacons_per_s_of_each_anchor']:.1f} beacons/s"
    if report["mode"] == "free":
        return (
            f"mode free: {rate} at random instants\n"
            f"anchors in reach of one another send {report['offered_in_reach_per_s']:.0f} beacons/s in all, "
            f"best is {report['best_offered_per_s']:.0f}\n{frame}"
        )
    slots = (
        f"{report['slots']} slots of {report['slot_s'] * 1e3:.3f} ms: {report['superframes_per_s']:.1f} superframes/s"
    )
    return (
        f"{slots}, {report['messages_per_s']:.0f} messages/s\n"
        f"{frame}; the air is occupied {report['occupancy']:.0%} of the time at most"
    )
