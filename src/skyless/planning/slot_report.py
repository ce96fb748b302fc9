"""The plan of a site of protocol 2: slots that anchors share, and its report as one tree of plain values."""

from pathlib import Path
from typing import Any

import msgspec

from skyless.errors import ConfigurationError, SkylessError
from skyless.planning.floor import Floor
from skyless.planning.links import range_of
from skyless.planning.slot_plan import RateMap, nearest_sharing_m, slot_warnings
from skyless.simulation.channel import ChannelModel
from skyless.site.check import check_site, has_slots
from skyless.site.model import Site
from skyless.site.slot_colours import SlotShortageError, with_slots
from skyless.site.slots import beacon_period_s, schedule_of


def with_planned_slots(
    site: Site, file: Path, conflicts: list[tuple[int, int]], recolour: bool
) -> tuple[Site, str | None]:
    """Return a site in mode slots with its slots, and why those of its file were not taken; None if they were.

    Raises SkylessError when a superframe has too few slots.
    """
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


def slot_report(
    site: Site,
    floor: Floor | None,
    mapped: RateMap | None,
    channel: ChannelModel,
    exponent: float,
    recoloured: str | None,
    written: bool,
) -> dict[str, Any]:
    """The whole report, SI units."""
    is_shared = site.schedule.mode == "slots"
    warnings = slot_warnings(site, mapped, channel, exponent)
    return {
        "site": site.name,
        "mode": site.schedule.mode,
        "exponent": exponent,
        "range_m": range_of(channel, exponent),
        "slots": site.schedule.slots if is_shared else None,
        "slot_s": site.schedule.slot_s if is_shared else None,
        "superframe_s": 1.0 / schedule_of(site).superframe_rate_hz if is_shared else None,
        "reuse_m": site.schedule.reuse_m if is_shared else None,
        "nearest_sharing_m": nearest_sharing_m(site) if is_shared else None,
        "slots_of_file": is_shared and recoloured is None,
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


def described_slots(result: dict[str, Any]) -> str:
    """The schedule in one line."""
    each = f"{result['beacons_per_s_of_each_anchor']:.1f} beacons/s of each anchor"
    if result["mode"] == "free":
        return f"mode free, {each}"
    slots = f"{result['slots']} slots of {1e3 * result['slot_s']:g} ms"
    return f"{slots}, shared by anchors {result['reuse_m']:g} m or more apart, {each}"
