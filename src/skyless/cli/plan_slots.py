"""``skyless plan`` at a site of protocol 2: shows what its slots give, and writes them into the file."""

from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from skyless.cli.common.output import number, print_facts, print_warnings, write_file
from skyless.errors import SkylessError

if TYPE_CHECKING:
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


def write_slots(site: "Site", file: Path) -> None:
    """Write the slots into the site's file, everything else unchanged. Raises SkylessError."""
    from skyless.site.rewrite import with_slots_written

    slots = {anchor.id: anchor.slot for anchor in site.all_anchors if anchor.slot is not None}
    text = with_slots_written(file.read_bytes().decode("utf-8-sig"), slots, site.schedule.slots or 0, file)
    write_file(file, text.encode())


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
