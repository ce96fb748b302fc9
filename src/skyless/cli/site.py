"""``skyless site``: write and check site files; its keys are in ``site_keys``."""

import secrets
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, Literal

import msgspec
from cyclopts import App

from skyless.cli.common.options import check_folder, command
from skyless.cli.common.output import console, print_json, print_warnings, write_file
from skyless.cli.nodes.options import SiteId
from skyless.core.arguments import number, read_height, read_numbers, whole
from skyless.core.errors import SkylessError

if TYPE_CHECKING:
    from rich.table import Table
    from rich.text import Text

    from skyless.core.site import Site

_Metres = Annotated[float, number(above=0.0, most=10_000.0)]
_RoomMetres = Annotated[float, number(least=0.1, most=10_000.0)]
"""Length of a room's side, long enough for 255 anchors along the walls."""
_GRID_HEIGHT_M: Final = 4.0
_TAGS_BELOW_A_GRID_M: Final = 1.2
_PAPER_SLOT_S: Final = 2.5e-3
_LONGEST_TABLE: Final = 40
"""Anchors that are shown one a row; of more only a summary."""
_Count = Annotated[int, whole(1, 255)]

app = App(name="site", help_epilogue="Example: skyless site check site.toml")
app.command("skyless.cli.site_keys:app", name="keys", help="Make, replace and show the keys of a site.")


@app.command(help_epilogue="Example: skyless site new hall.toml --width 30 --depth 20 --anchor-count 8 --height 4")
@command
def new(
    file: Path,
    /,
    *,
    name: str | None = None,
    width: _RoomMetres | None = None,
    depth: _RoomMetres | None = None,
    anchor_count: _Count | None = None,
    height: _Metres | None = None,
    spacing: _Metres | None = None,
    unplaced: _Count | None = None,
    paper: bool = False,
    tag_height: str | None = None,
    site_id: SiteId | None = None,
    force: bool = False,
    json: bool = False,
) -> None:
    """Write a commented site file to start from: the lab, with --width and --depth a room, with --spacing a large hall.

    With --unplaced the anchors have no positions yet, which skyless survey then finds.

    Parameters
    ----------
    file
        The site file to write.
    name
        Name of the site; by default the file's.
    width
        The room's width along x in metres.
    depth
        The room's depth along y in metres.
    anchor_count
        How many anchors hang evenly along the room's walls; 6 by default.
    height
        The room's height in metres, 3 by default; the anchors alternate between floor and ceiling. With --spacing the
        height of all anchors, 4 by default.
    spacing
        Spacing in metres of a square grid of anchors, which may be of any size.
    unplaced
        How many anchors, 1 to this number, without positions.
    paper
        Use the paper's protocol (mode master): the anchor that the others receive best is the master.
    tag_height
        The tags' height: metres, at which all of them move (2-D), or free, the default: estimated (3-D). With
        --spacing, whose anchors lie in one plane, the default is 1.2.
    site_id
        Number of the site on the air, which neighbouring sites must not share; by default a random one.
    force
        Overwrite what is there, if the file exists.
    json
        Write one JSON object instead of a line.
    """
    from skyless.sim.lab import lab_site
    from skyless.site.file.check import check_site
    from skyless.site.file.template import rectangle, rectangular_site, site_template, unplaced_site

    _check_free(file, force=force)
    if paper and (unplaced is not None or spacing is not None):
        raise SkylessError("--paper is for one room; its anchors need positions, and all receive one master")
    sizes = (width, depth, anchor_count, height)
    height_m = _tag_height(tag_height, spacing)
    if unplaced is not None:
        if sizes != (None,) * 4 or spacing is not None:
            raise SkylessError(f"--unplaced is {unplaced}; it takes no sizes: anchors without positions fill no room")
        site = unplaced_site(unplaced, height_m)
    elif spacing is not None and width is not None and depth is not None and anchor_count is None:
        site = _grid(width, depth, spacing, height, height_m)
    elif spacing is not None:
        raise SkylessError("a grid needs --spacing, --width and --depth; how many --anchor-count follows from them")
    elif width is not None and depth is not None:
        site = rectangular_site(width, depth, anchor_count or 6, height or 3.0, height_m)
        check_site(site, file)
    elif (*sizes, tag_height) == (None,) * 5:
        site = msgspec.structs.replace(lab_site(), outline_m=rectangle(6.0, 8.0))
    else:
        raise SkylessError("a room needs both --width and --depth; without them the lab is written")
    if paper:
        site = _with_the_papers_schedule(site)
    site = msgspec.structs.replace(site, name=name or file.stem, id=_new_id() if site_id is None else site_id)
    check_site(site, file)
    write_file(file, site_template(site).encode())
    if json:
        print_json({"file": file, "name": site.name, "id": site.id, "anchors": len(site.all_anchors)})
    else:
        console().print(f"wrote {file}; next: skyless site check {file}", markup=False)


def _check_free(file: Path, *, force: bool) -> None:
    """Raise SkylessError if the file cannot be written without loss."""
    if file.is_dir():
        raise SkylessError(f"{file} is a folder; it should be the name of a file to write")
    if file.exists() and not force:
        raise SkylessError(f"{file} exists; --force overwrites it")


def _with_the_papers_schedule(site: "Site") -> "Site":
    """The same site on the paper's protocol; the anchor that the others receive best is the master."""
    from skyless.core.site import ScheduleSite
    from skyless.site.channel import ChannelModel
    from skyless.site.planning.anchor_clocks import with_best_master

    master = msgspec.structs.replace(site, schedule=ScheduleSite(slot_s=_PAPER_SLOT_S))
    return with_best_master(master, ChannelModel())


def _new_id() -> int:
    """An identifier that a neighbouring site hardly has: any on the air but 0."""
    from skyless.site.file.check import ANY_ADDRESS

    return 1 + secrets.randbelow(ANY_ADDRESS)


def _tag_height(text: str | None, spacing_m: float | None) -> float | None:
    """The tags' height in metres, None where it is estimated. Raises SkylessError."""
    if text is None:
        return None if spacing_m is None else _TAGS_BELOW_A_GRID_M
    height_m = read_height("--tag-height", text, ("free",))
    return None if isinstance(height_m, str) else height_m


def _grid(width_m: float, depth_m: float, spacing_m: float, height_m: float | None, tags_m: float | None) -> "Site":
    from skyless.site.file.template import grid_site

    try:
        return grid_site(width_m, depth_m, spacing_m, height_m or _GRID_HEIGHT_M, tags_m)
    except ValueError as error:
        raise SkylessError(f"no grid of {spacing_m:g} m: {error}") from None


@app.command(help_epilogue="Example: skyless site check site.toml --json")
@command
def check(file: Path, /, *, json: bool = False) -> None:
    """Check a site file, and show what it makes: anchors, slots, rates, and what may cost accuracy.

    A mistake ends with exit code 2 and a message that names the key and what it should be; warnings do not.

    Parameters
    ----------
    file
        The site file.
    json
        Write one JSON object instead of the table.
    """
    from skyless.site.file.load import load_site

    site = load_site(file)
    report = _report(site)
    if json:
        print_json(report)
    else:
        _show(file, report)


@app.command(help_epilogue="Example: skyless site sheet site.toml sheet.pdf --cables-from 0.5,0.5")
@command
def sheet(
    file: Path, output: Path, /, *, cables_from: str | None = None, force: bool = False, json: bool = False
) -> None:
    """Write the sheet for those who mount the anchors: a page A4 with plan and table for each floor.

    Parameters
    ----------
    file
        The site file.
    output
        The sheet to write, .pdf or .png.
    cables_from
        Where the cables begin, such as the switch: X,Y or X,Y,HEIGHT in metres, the height 0 by default. The sheet then
        has their lengths.
    force
        Overwrite what is there, if the sheet exists.
    json
        Write one JSON object instead of a line.
    """
    from skyless.site.file.load import load_site
    from skyless.site.planning.sheet import mounts, sheet

    kinds: dict[str, Literal["pdf", "png"]] = {".pdf": "pdf", ".png": "png"}
    if (kind := kinds.get(output.suffix.lower())) is None:
        raise SkylessError(f"OUTPUT is {str(output)!r}; its ending should be .pdf or .png")
    check_folder("OUTPUT", output)
    _check_free(output, force=force)
    start = None
    if cables_from is not None:
        x_m, y_m, *height_m = read_numbers("--cables-from", cables_from, (2, 3))
        start = (x_m, y_m, height_m[0] if height_m else 0.0)
    site = load_site(file)
    write_file(output, sheet(site, file, kind, time.strftime("%Y-%m-%d"), start))
    if json:
        print_json({"file": output, "anchors": mounts(site, start)})
    else:
        console().print(f"wrote {output}: {len(site.anchors)} anchors", markup=False)


def _report(site: "Site") -> dict[str, Any]:
    """The report on a valid site, SI units."""
    from skyless.core.air.frame import MAX_FRAME_BYTES
    from skyless.core.air.ieee802154 import air_time_s
    from skyless.core.protocols import beacon_period_s
    from skyless.site.channel import ChannelModel
    from skyless.site.file.advice import warnings_of
    from skyless.site.planning.anchor_clocks import master_warnings, reception_of

    report: dict[str, Any] = {
        "name": site.name,
        "id": site.id,
        "mode": site.schedule.mode,
        "master": site.master if site.schedule.needs_master else None,
        "tag_height_m": site.tags.height_m,
        "anchors": _anchors(site),
        "unplaced": [{"id": anchor.id} for anchor in site.unplaced],
        "beacons_per_s_of_each_anchor": 1.0 / beacon_period_s(site),
        "longest_frame_s": air_time_s(MAX_FRAME_BYTES),
    }
    warnings = warnings_of(site)
    if site.schedule.needs_master:
        report |= _superframe(site)
        report["occupancy"] = report["messages_per_s"] * report["longest_frame_s"]
        received = reception_of(site, ChannelModel()).share.tolist()
        report["anchors"] = [
            one | {"hears_master": share} for one, share in zip(report["anchors"], received, strict=True)
        ]
        warnings += master_warnings(site, ChannelModel())
    else:
        report |= _in_reach(site)
    return report | {"warnings": warnings}


def _anchors(site: "Site") -> list[dict[str, Any]]:
    from skyless.core.protocol1.schedule import first_slots, schedule_of

    slots: dict[int, tuple[int, ...]] = {}
    if site.schedule.needs_master:
        schedule = schedule_of(site)
        slots = {number: schedule.slots_of(first) for number, first in first_slots(site).items()}
    return [
        {"id": anchor.id, "x_m": anchor.x_m, "y_m": anchor.y_m, "z_m": anchor.z_m}
        | ({"slots": slots[anchor.id]} if slots else {})
        for anchor in site.anchors
    ]


def _superframe(site: "Site") -> dict[str, Any]:
    """What the slots make."""
    from skyless.core.constants import TICK_S
    from skyless.core.protocol1.schedule import schedule_of

    schedule = schedule_of(site)
    return {
        "slots": schedule.slots,
        "slot_s": schedule.slot_ticks * TICK_S,
        "superframe_s": schedule.superframe_ticks * TICK_S,
        "superframes_per_s": schedule.superframe_rate_hz,
        "messages_per_s": schedule.messages_per_s(len(site.all_anchors)),
    }


def _in_reach(site: "Site") -> dict[str, Any]:
    """How many anchors are in reach of one another, and what they send."""
    import numpy as np

    from skyless.core.air.instants import OFFERED_HZ
    from skyless.core.geometry import RADIO_REACH_M, anchors_in_reach
    from skyless.core.protocols import beacon_period_s

    in_reach = anchors_in_reach(site) if site.anchors else np.zeros(1)
    return {
        "reach_m": RADIO_REACH_M,
        "fewest_in_reach": int(in_reach.min()),
        "median_in_reach": float(np.median(in_reach)),
        "most_in_reach": int(in_reach.max()),
        "offered_in_reach_per_s": float(np.median(in_reach)) / beacon_period_s(site),
        "best_offered_per_s": OFFERED_HZ,
    }


def _show(file: Path, report: dict[str, Any]) -> None:
    from rich.text import Text

    title = Text(f"{report['name']} ({file})")
    everybody = [*report["anchors"], *report["unplaced"]]
    out = console()
    out.print(_rows(title, everybody, report) if len(everybody) <= _LONGEST_TABLE else _summary(title, report))
    height = report["tag_height_m"]
    tags = "estimate their height (3-D)" if height is None else f"move at a height of {height:g} m (2-D)"
    out.print(f"{_schedule_lines(report)}\ntags {tags}")
    print_warnings(report["warnings"])
    out.print("the site file is valid" if not report["warnings"] else "the site file is valid, with warnings")


def _rows(title: "Text", anchors: list[dict[str, Any]], report: dict[str, Any]) -> "Table":
    """One row for each anchor."""
    from rich.table import Table

    more = ["slots", "hears master"] if report["master"] is not None else []
    table = Table("anchor", "x / m", "y / m", "z / m", *more, title=title)
    for column in table.columns:
        column.justify = "right"
    for anchor in anchors:
        role = " (master)" if anchor["id"] == report["master"] else ""
        position = [f"{anchor[axis]:.3f}" if axis in anchor else "?" for axis in ("x_m", "y_m", "z_m")]
        heard = [" ".join(map(str, anchor["slots"])), f"{anchor['hears_master']:.0%}"] if more else []
        table.add_row(f"{anchor['id']}{role}", *position, *heard)
    return table


def _summary(title: "Text", report: dict[str, Any]) -> "Table":
    """Many anchors in a few lines."""
    from rich.table import Table

    anchors, unplaced = report["anchors"], report["unplaced"]
    table = Table("", "", title=title, show_header=False)
    table.add_row("anchors", str(len(anchors) + len(unplaced)))
    if unplaced:
        table.add_row("without a position", str(len(unplaced)))
    for axis in ("x_m", "y_m", "z_m") if anchors else ():
        values = [anchor[axis] for anchor in anchors]
        table.add_row(f"{axis[0]} / m", f"{min(values):.3f} … {max(values):.3f}")
    if report["mode"] != "master":
        reach = f"within {report['reach_m']:.0f} m of an anchor"
        in_reach = (f"{report['fewest_in_reach']} … {report['most_in_reach']}", f"{report['median_in_reach']:.0f}")
        table.add_row(reach, "{} anchors with itself, median {}".format(*in_reach))
    return table


def _schedule_lines(report: dict[str, Any]) -> str:
    """Who sends how often, and how much of the air that takes."""
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
