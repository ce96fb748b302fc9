"""What a history takes and answers at most (``docs/limits.md``)."""

from typing import Final

from msgspec import Struct


class HistoryLimits(Struct, frozen=True):
    """A question beyond them is refused with what would be accepted; rows beyond them are counted as dropped."""

    memory_mb: int = 64
    """What DuckDB may use before it writes to temporary files; Python and the libraries take 100 MB besides."""
    points: int = 20_000
    """Points of a way."""
    steps: int = 20_000
    """Steps of time of all zones of an occupancy."""
    rows: int = 100_000
    """Rows of a table of stays or alarms."""
    contacts: int = 100_000
    """Contacts of a tag."""
    contact_m: float = 50.0
    """Distance within which tags count as in contact."""
    cells: int = 1_000_000
    """Cells of a heat map."""
    exported_rows: int = 100_000_000
    """Rows of an exported file."""
    waiting_rows: int = 500_000
    """Fixes, and as many events, that wait in memory while the disk does not take them."""
    tags: int = 200_000
    """Tags of a site."""
    first_unix_s: float = 1e9
    """Earlier times, before 2001, are those of a computer without a clock."""
    last_unix_s: float = 8e9
    """Later times, in more than 200 years, are no times."""


LIMITS: Final = HistoryLimits()
