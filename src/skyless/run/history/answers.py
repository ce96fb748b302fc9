"""Time ranges and results of queries on a history, shared by the command line, the HTTP interface and the page."""

import contextlib
import math
import re
from datetime import date, datetime
from typing import Final

from msgspec import Struct

from skyless.core.errors import SkylessError


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
    """The track of one tag."""

    tag: str
    points: tuple[TrackPoint, ...]
    fixes: int
    """Number of fixes in the range; more than points if the track was thinned."""
    length_m: float
    """Length in the plane through all fixes, without gaps. Moves of less than a quarter of a metre, or three standard
    deviations, may be noise: they count only once they add up to that."""
    gap_s: float
    """The longest silence in the range that is no absence, 10 s at least. Some shorter ones may be absences."""


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


class Contact(Struct, frozen=True):
    """A period in which two tags were near each other."""

    tag: str
    other: str
    begin_unix_s: float
    end_unix_s: float
    least_m: float


_EXAMPLES: Final = "a time such as 14:00, yesterday 8:00, 2 hours ago, 2026-01-31 06:00, or seconds since 1970"
_TIMES_OF_DAY: Final = ("%H:%M", "%H:%M:%S", "%I:%M%p", "%I:%M %p", "%I%p", "%I %p")
_EARLIEST_S: Final = 1e8
"""Smaller numbers (before 1973) probably mean an hour or a year. 0 is allowed: from the beginning."""
_LATEST_S: Final = 1e11
"""Larger numbers are milliseconds."""
_AT_AN_HOUR: Final = re.compile(r"\bat (\d{1,2})$")


def span_of(from_text: str, to_text: str | None, now_unix_s: float) -> Span:
    """Parse the range between two times, in this machine's time zone if they name none.

    A time without a date is today's; at the end of the range it is on the day on which the range begins. A day without
    a time means its beginning. Without ``to_text`` the range ends now.

    Raises SkylessError: a text is not a time, or the range begins in the future or ends before it begins.
    """
    now = datetime.fromtimestamp(now_unix_s)
    begin_s = _unix_s("from", from_text, now, now.date())
    if begin_s > now_unix_s:
        raise SkylessError(f"from is {from_text!r}, which is in the future ({time_text(begin_s)}); it should be past")
    end_s = now_unix_s
    if to_text is not None:
        end_s = _unix_s("to", to_text, now, datetime.fromtimestamp(begin_s).date())
    if end_s <= begin_s:
        text = "now" if to_text is None else repr(to_text)
        raise SkylessError(f"to is {text} ({time_text(end_s)}); it should be later than from ({time_text(begin_s)})")
    return Span(begin_s, end_s)


def _unix_s(name: str, text: str, now: datetime, day: date) -> float:
    text = " ".join(text.split())
    with contextlib.suppress(ValueError):
        number = float(text)
        if number == 0.0 or _EARLIEST_S <= number <= _LATEST_S:
            return number
    try:
        found_s = _read(text, now, day).timestamp()
    except (ValueError, OverflowError):
        found_s = math.nan
    if not 0.0 <= found_s <= _LATEST_S:
        raise SkylessError(f"{name} is {text[:60]!r}; it should be {_EXAMPLES}")
    return found_s


def _read(text: str, now: datetime, day: date) -> datetime:
    """Parse a time, in this machine's time zone if it names none. Raises ValueError."""
    for form in _TIMES_OF_DAY:
        with contextlib.suppress(ValueError):
            return datetime.combine(day, datetime.strptime(text, form).time())
    with contextlib.suppress(ValueError):
        return datetime.fromisoformat(text)
    from dateparser.date import DateDataParser  # noqa: PLC0415 - takes 0.1 s

    settings = {"RELATIVE_BASE": now, "PREFER_DATES_FROM": "past", "DATE_ORDER": "YMD"}
    settings |= {"RETURN_TIME_AS_PERIOD": True, "PARSERS": ["relative-time", "absolute-time"]}
    found = DateDataParser(languages=["en"], settings=settings).get_date_data(_AT_AN_HOUR.sub(r"\1:00", text))
    when: datetime | None = found.date_obj
    if when is None or not (found.period in {"time", "day"} or text.endswith("ago")):
        raise ValueError  # a month or a year is not a time
    return when if found.period == "time" else when.replace(hour=0, minute=0, second=0, microsecond=0)


def time_text(unix_s: float) -> str:
    """A time for people, in this machine's time zone."""
    return datetime.fromtimestamp(unix_s).isoformat(" ", "seconds")
