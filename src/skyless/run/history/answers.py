"""What is asked of a history, and the answers: the command line, the HTTP interface and the page give the same."""

from typing import Final

from msgspec import Struct

GAP_S: Final = 5.0
THINNED_GAP_S: Final = 65.0
"""Where a tag is after its last fix is known for this long; in days that are thinned a fix may be the only one of a
minute."""


class Span(Struct, frozen=True):
    """A time range, its end excluded."""

    from_unix_s: float
    to_unix_s: float


class TrackPoint(Struct, frozen=True, array_like=True):
    """One position of a tag."""

    unix_s: float
    x_m: float
    y_m: float
    z_m: float
    std_m: float
    hpl_m: float | None
    alert: str | None


class Track(Struct, frozen=True):
    """The way of one tag."""

    tag: str
    points: tuple[TrackPoint, ...]
    fixes: int
    """How many fixes there are in the range; more than points where the way was thinned."""
    length_m: float
    """Of the way through all fixes in the plane, without gaps of more than ``GAP_S`` (``THINNED_GAP_S``). Moves of less
    than a quarter of a metre, or three standard deviations, count when they add up to that: they may be noise."""


class Heatmap(Struct, frozen=True):
    """How long tags were in each cell of a grid."""

    x0_m: float
    y0_m: float
    """The lower left corner."""
    cell_m: float
    columns: int
    rows: int
    seconds: tuple[float, ...]
    """Row by row, the lowest row first."""
    tags: int


class Dwell(Struct, frozen=True):
    """How long one tag was in one zone."""

    tag: str
    zone: str
    zone_name: str
    visits: int
    seconds: float
    first_unix_s: float
    last_unix_s: float


class Occupancy(Struct, frozen=True):
    """How many tags were in a zone within one step of time."""

    zone: str
    zone_name: str
    unix_s: float
    mean: float
    most: int


class Contact(Struct, frozen=True):
    """Two tags were near each other."""

    tag: str
    other: str
    begin_unix_s: float
    end_unix_s: float
    least_m: float


class AlarmRow(Struct, frozen=True):
    """One alarm of the past."""

    id: str
    rule: str
    subject: str
    text: str
    raised_unix_s: float
    ended_unix_s: float | None
    acknowledged_unix_s: float | None
    acknowledged_by: str
