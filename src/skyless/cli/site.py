"""``skyless site``: write and check site files."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import msgspec
from cyclopts import App, Parameter
from cyclopts.validators import Number

from skyless.cli.common.output import console, print_json, print_warnings, write_file
from skyless.errors import SkylessError

if TYPE_CHECKING:
    from skyless.site.model import Site

_Metres = Annotated[float, Parameter(validator=Number(gt=0, lte=10_000))]
_Count = Annotated[int, Parameter(validator=Number(gte=1, lte=255))]

app = App(name="site", help_epilogue="Example: skyless site check site.toml")


@app.command(help_epilogue="Example: skyless site new hall.toml --width 30 --depth 20 --anchors 8 --height 4")
def new(
    file: Path,
    /,
    *,
    name: str | None = None,
    width: _Metres | None = None,
    depth: _Metres | None = None,
    anchors: _Count | None = None,
    height: _Metres | None = None,
    tag_height: float | None = None,
    force: bool = False,
) -> None:
    """Write a commented site file to start from: the lab, or with --width and --depth a room.

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
    anchors
        How many anchors hang evenly along the room's walls; 6 by default.
    height
        The room's height in metres, 3 by default; the anchors alternate between floor and ceiling.
    tag_height
        Height in metres at which all tags move (2-D); by default their height is estimated (3-D).
    force
        Overwrite the file if it exists.
    """
    from skyless.site.check import check_site
    from skyless.site.lab import lab_site
    from skyless.site.template import rectangular_site, site_template

    if width is not None and depth is not None:
        site = rectangular_site(width, depth, anchors or 6, height or 3.0, tag_height)
    elif (width, depth, anchors, height, tag_height) == (None,) * 5:
        site = lab_site()
    else:
        raise SkylessError("a room needs both --width and --depth; without them the lab is written")
    site = msgspec.structs.replace(site, name=name or file.stem)
    check_site(site, file)
    if file.exists() and not force:
        raise SkylessError(f"{file} exists; --force overwrites it")
    write_file(file, site_template(site).encode())
    console().print(f"wrote {file}; next: skyless site check {file}", markup=False)


@app.command(help_epilogue="Example: skyless site check site.toml --json")
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
    from skyless.site.load import load_site

    site = load_site(file)
    report = _report(site)
    if json:
        print_json(report)
    else:
        _show(file, report)


def _report(site: "Site") -> dict[str, Any]:
    """The report on a valid site, SI units."""
    from skyless.air.codec import MAX_FRAME_BYTES
    from skyless.air.ieee802154 import air_time_s
    from skyless.constants import TICK_S
    from skyless.site.advice import warnings_of
    from skyless.site.slots import first_slots, schedule_of

    schedule = schedule_of(site)
    first = first_slots(site)
    messages_per_s = schedule.messages_per_s(len(site.anchors))
    return {
        "name": site.name,
        "id": site.id,
        "master": site.master,
        "tag_height_m": site.tags.height_m,
        "anchors": [
            {
                "id": anchor.id,
                "x_m": anchor.x_m,
                "y_m": anchor.y_m,
                "z_m": anchor.z_m,
                "slots": schedule.slots_of(first[anchor.id]),
            }
            for anchor in site.anchors
        ],
        "slots": schedule.slots,
        "slot_s": schedule.slot_ticks * TICK_S,
        "superframe_s": schedule.superframe_ticks * TICK_S,
        "superframes_per_s": schedule.superframe_rate_hz,
        "messages_per_s": messages_per_s,
        "longest_frame_s": air_time_s(MAX_FRAME_BYTES),
        "occupancy": messages_per_s * air_time_s(MAX_FRAME_BYTES),
        "warnings": warnings_of(site),
    }


def _show(file: Path, report: dict[str, Any]) -> None:
    from rich.table import Table
    from rich.text import Text

    table = Table("anchor", "x / m", "y / m", "z / m", "slots", title=Text(f"{report['name']} ({file})"))
    for column in table.columns:
        column.justify = "right"
    for anchor in report["anchors"]:
        role = " (master)" if anchor["id"] == report["master"] else ""
        position = [f"{anchor[axis]:.3f}" for axis in ("x_m", "y_m", "z_m")]
        table.add_row(f"{anchor['id']}{role}", *position, " ".join(map(str, anchor["slots"])))
    out = console()
    out.print(table)
    height = report["tag_height_m"]
    tags = "estimate their height (3-D)" if height is None else f"move at a height of {height:g} m (2-D)"
    out.print(
        f"{report['slots']} slots of {report['slot_s'] * 1e3:.3f} ms: "
        f"{report['superframes_per_s']:.1f} superframes/s, {report['messages_per_s']:.0f} messages/s\n"
        f"the longest frame takes {report['longest_frame_s'] * 1e6:.0f} µs; "
        f"the air is occupied {report['occupancy']:.0%} of the time at most\n"
        f"tags {tags}"
    )
    print_warnings(report["warnings"])
    out.print("the site file is valid" if not report["warnings"] else "the site file is valid, with warnings")
