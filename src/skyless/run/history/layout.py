"""Folders, files and columns of a site's history (``docs/history.md``).

    FOLDER/site=<n>/day=<yyyy-mm-dd>/<first>-<last>.parquet           fixes; numbers of the first and last row
    FOLDER/site=<n>/events/day=<yyyy-mm-dd>/<first>-<last>.parquet    events
    FOLDER/site=<n>/names.parquet                                     the tags' numbers and names
    FOLDER/site=<n>/assets.parquet                                    the tags' names and their assets' names
    FOLDER/site=<n>/zones.parquet                                     the zones' identifiers, names and corners
    FOLDER/site=<n>/stream                                            a broker without streams: rows not in Parquet yet

The day is that of arrival, in UTC. Any engine that reads Parquet can read and join them. A file whose numbers lie
within those of another has been joined into it and will be removed.
"""

from pathlib import Path
from typing import Final, Literal

from msgspec import Struct

TIME: Final = "TIMESTAMPTZ"

FIX_COLUMNS: Final = {
    "tag": "UINTEGER",
    "t": TIME,
    "x_mm": "INTEGER",
    "y_mm": "INTEGER",
    "z_mm": "INTEGER",
    "std_mm": "USMALLINT",
    "hpl_cm": "USMALLINT",
    "flags": "USMALLINT",
}
"""Kinds are DuckDB's. Sorted by tag and t. ``std_mm`` is the one-sigma radial error; ``hpl_cm`` is 65535 for no level;
``flags`` are those of a record of a batch (``run/fix_batch.py``)."""

EVENT_COLUMNS: Final = {
    "t": TIME,
    "kind": "VARCHAR",
    "tag": "VARCHAR",
    "zone": "VARCHAR",
    "subject": "VARCHAR",
    "alarm": "VARCHAR",
    "text": "VARCHAR",
}
"""``kind`` is an ``EventKind``. ``tag`` is the tag's name and ``zone`` the zone's identifier, null if there is none;
``subject`` is ``anchor-<id>`` or what an alarm is about; ``alarm`` is the alarm's id; ``text`` is for people, and names
the person who acknowledged an alarm."""

EventKind = Literal["enter", "leave", "alarm-raised", "alarm-ended", "alarm-acknowledged", "offline", "online"]

NAME_COLUMNS: Final = {"tag": "UINTEGER", "name": "VARCHAR", "since": TIME}
ASSET_COLUMNS: Final = {"tag": "VARCHAR", "name": "VARCHAR"}
ZONE_COLUMNS: Final = {"zone": "VARCHAR", "name": "VARCHAR", "corners_m": "VARCHAR"}
"""``corners_m`` is a list of pairs in JSON."""

THINNED: Final = "skyless_thinned"
"""Metadata key of files with thinned fixes: one every ten seconds or every minute."""
PLACE: Final = "skyless_place"
"""Metadata key of the place in the site's stream (``Place``, JSON) up to which this file and those before are complete.
"""


class Place(Struct, frozen=True):
    """A place in a stream."""

    stream: str = ""
    """Source of the stream and when it was made; empty before anything was taken from a stream."""
    number: int = 0
    """Number of the last message."""


def site_folder(folder: Path, site: int) -> Path:
    """Folder of one site."""
    return folder / f"site={site}"


def sites_in(folder: Path) -> tuple[int, ...]:
    """Numbers of the sites whose history is in a folder."""
    found = (one.name.removeprefix("site=") for one in folder.glob("site=*"))
    return tuple(sorted(int(number) for number in found if number.isdecimal()))


def file_name(first: int, last: int) -> str:
    """Name of the file with these rows."""
    return f"{first:012}-{last:012}.parquet"


def rows_of(file: Path) -> tuple[int, int] | None:
    """First and last row number from a file's name; None for other files."""
    first, dash, last = file.stem.partition("-")
    if not dash or not (first.isdecimal() and last.isdecimal()):
        return None
    return int(first), int(last)


def day_of(file: Path) -> str:
    """Day from the name of a file's folder."""
    return file.parent.name.removeprefix("day=")


def current_files(folder: Path, site: int) -> tuple[Path, ...]:
    """Files that together hold each fix once, by number.

    A file may be joined into a larger one and then removed. A reader that finds it gone should list the files again.
    """
    return largest_files(site_folder(folder, site))


def current_events(folder: Path, site: int) -> tuple[Path, ...]:
    """Files that together hold each event once, by number."""
    return largest_files(site_folder(folder, site) / "events")


def largest_files(folder: Path) -> tuple[Path, ...]:
    """Files in a folder's days, without those whose rows are all in another file."""
    found = [(rows[0], -rows[1], file) for file in folder.glob("day=*/*.parquet") if (rows := rows_of(file))]
    kept: list[Path] = []
    end = -1
    for _, minus_last, file in sorted(found):  # of files with the same first row, the longest comes first
        if -minus_last > end:
            kept.append(file)
            end = -minus_last
    return tuple(kept)
