"""``skyless plan`` at a site of protocol 2: colours the slots, shows what they give, and writes them into the file."""

from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import msgspec

from skyless.cli.common.output import number, print_facts, print_warnings, write_file
from skyless.errors import ConfigurationError, SkylessError

if TYPE_CHECKING:
    from skyless.planning.floor import Floor
    from skyless.planning.slot_plan import RateMap
    from skyless.simulation.channel import ChannelModel
    from skyless.site.model import Site

_NO_ACCURACY: Final = "not predicted: the maps of the error assume one master (docs/planning.md)"


def conflicts_of(path: Path | None, site: "Site") -> list[tuple[int, int]]:
    """Pairs of anchors that were received at once, from a table with two identifiers in each line.

    Raises SkylessError naming the file, the line and what it should be.
    """
    if path is None:
        return []
    known = {anchor.id for anchor in site.all_anchors}
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise SkylessError(f"--conflicts is {str(path)!r}, which cannot be read: {error}") from None
    pairs = []
    for row, line in enumerate(lines, start=1):
        text = line.partition("#")[0].strip()
        if not text:
            continue
        parts = [part.strip() for part in text.split(",")]
        if len(parts) != 2 or not all(part.isdecimal() and int(part) in known for part in parts):
            right = "two identifiers of the site's anchors with a comma between"
            raise SkylessError(f"{path}: line {row} is {text!r}; it should be {right}")
        pairs.append((int(parts[0]), int(parts[1])))
    return pairs


def with_planned_slots(
    site: "Site", file: Path, conflicts: list[tuple[int, int]], recolour: bool
) -> tuple["Site", str | None]:
    """Return a site in mode slots with its slots, and why those of its file were not taken; None if they were.

    Raises SkylessError when a superframe has too few slots.
    """
    from skyless.site.check import check_site, has_slots
    from skyless.site.slot_colours import SlotShortageError, with_slots

    reason = "new slots were asked for"
    if not recolour and not conflicts:
        try:
            check_site(site, file)
        except ConfigurationError as error:
            reason = str(error) if has_slots(site) else "the site file has none"
        else:
            return site, None
    try:
        coloured = with_slots(site, conflicts)
    except SlotShortageError as error:
        raise SkylessError(f"{file}: {error}") from None
    check_site(coloured, file)
    return coloured, reason


def write_slots(site: "Site", file: Path) -> None:
    """Write the slots into the site's file, everything else unchanged. Raises SkylessError."""
    from skyless.site.rewrite import with_slots_written

    slots = {anchor.id: anchor.slot for anchor in site.all_anchors if anchor.slot is not None}
    text = with_slots_written(file.read_bytes().decode(), slots, site.schedule.slots or 0, file)
    write_file(file, text.encode())


def slot_report(
    site: "Site",
    floor: "Floor | None",
    mapped: "RateMap | None",
    channel: "ChannelModel",
    exponent: float,
    recoloured: str | None,
    written: bool,
) -> dict[str, Any]:
    """The whole report, SI units."""
    from skyless.planning.links import range_of
    from skyless.planning.slot_plan import nearest_sharing_m, slot_warnings
    from skyless.site.slots import beacon_period_s, schedule_of

    with_slots = site.schedule.mode == "slots"
    warnings = slot_warnings(site, mapped, channel, exponent)
    return {
        "site": site.name,
        "mode": site.schedule.mode,
        "exponent": exponent,
        "range_m": range_of(channel, exponent),
        "slots": site.schedule.slots if with_slots else None,
        "slot_s": site.schedule.slot_s if with_slots else None,
        "superframe_s": 1.0 / schedule_of(site).superframe_rate_hz if with_slots else None,
        "reuse_m": site.schedule.reuse_m if with_slots else None,
        "nearest_sharing_m": nearest_sharing_m(site) if with_slots else None,
        "slots_of_file": with_slots and recoloured is None,
        "written": written,
        "beacons_per_s_of_each_anchor": 1.0 / beacon_period_s(site),
        "outline_m": None if floor is None else floor.outline_m,
        "region_m": None if floor is None else floor.region_m,
        "heights_m": None if mapped is None else mapped.grid.heights_m,
        "step_m": None if mapped is None else mapped.grid.step_m,
        "points": None if mapped is None else mapped.grid.points,
        "reception": None if mapped is None else msgspec.to_builtins(mapped.reception),
        "accuracy": None,
        "anchors": [
            {"id": anchor.id, "x_m": anchor.x_m, "y_m": anchor.y_m, "z_m": anchor.z_m, "slot": anchor.slot}
            for anchor in site.anchors
        ],
        "unplaced": [{"id": anchor.id, "slot": anchor.slot} for anchor in site.unplaced],
        "warnings": warnings,
    }


def described(result: dict[str, Any]) -> str:
    """The schedule in one line."""
    each = f"{result['beacons_per_s_of_each_anchor']:.1f} beacons/s of each anchor"
    if result["mode"] == "free":
        return f"mode free, {each}"
    slots = f"{result['slots']} slots of {1e3 * result['slot_s']:g} ms"
    return f"{slots}, shared by anchors {result['reuse_m']:g} m or more apart, {each}"


def show_slots(file: Path, result: dict[str, Any]) -> None:
    """Show the plan in the terminal."""
    print_facts(f"{result['site']} ({file})", _facts(result).items())
    print_warnings(result["warnings"])


def _facts(result: dict[str, Any]) -> dict[str, str]:
    unplaced = len(result["unplaced"])
    without = f", {unplaced} of them without a position" if unplaced else ""
    facts = {
        "anchors": f"{len(result['anchors']) + unplaced}{without}",
        "mode": result["mode"],
        "range in the open": f"{result['range_m']:.0f} m (path loss exponent {result['exponent']:g})",
    }
    if result["mode"] == "slots":
        superframe = f"superframe of {1e3 * result['superframe_s']:.1f} ms"
        origin = "from the site file" if result["slots_of_file"] else "new"
        facts["slots"] = f"{result['slots']} of {1e3 * result['slot_s']:g} ms ({origin}): {superframe}"
        nearest = result["nearest_sharing_m"]
        farther = f"farther than {2 * result['reuse_m']:g} m" if nearest is None else f"{nearest:.1f} m"
        facts["nearest in one slot"] = f"{farther} (reuse_m {result['reuse_m']:g} m)"
    facts["each anchor sends"] = f"{result['beacons_per_s_of_each_anchor']:.1f} beacons/s"
    if result["reception"] is not None:
        found = result["reception"]
        facts["positions"] = f"{result['points']}, one in each square of {result['step_m']:.3g} m"
        facts["beacons/s at a tag"] = _distribution(found["beacons_per_s"], "{:.0f}")
        facts["anchors received"] = _distribution(found["anchors_received"], "{:.0f}")
        facts["anchors in reach"] = _distribution(found["anchors_in_reach"], "{:.0f}")
        if result["mode"] == "slots":
            facts["in mode free instead"] = f"median {found['beacons_per_s_if_free']:.0f} beacons/s"
    facts["accuracy"] = _NO_ACCURACY
    if result["written"]:
        facts["written"] = "the slots, into the site file"
    return facts


def _distribution(values: dict[str, float], form: str) -> str:
    median, worst, least = (number(values[key], form) for key in ("median", "worst_5_percent", "least"))
    return f"median {median}, worst 5 % {worst}, least {least}"
