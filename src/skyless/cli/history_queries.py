"""``skyless history track``, ``heatmap``, ``dwell``, ``occupancy``, ``contacts``, ``alarms`` and ``export``."""

import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import App
from msgspec import Struct
from msgspec.structs import asdict

from skyless.cli.common.options import check_folder, check_picture, command
from skyless.cli.common.output import NO_FIX, console, print_json, write_picture
from skyless.cli.nodes.options import SiteId
from skyless.core.arguments import Option, Options, Positive, whole
from skyless.core.errors import SkylessError

if TYPE_CHECKING:
    from types import ModuleType

    from matplotlib.figure import Figure

    from skyless.run.history.answers import Span
    from skyless.run.history.queries import History

_LONGEST_TABLE = 40
"""Rows that are shown; --json gives all."""
_LONGEST_LIST = 10
"""Cells of a heat map that are shown."""

_HEADINGS = {"zone_name": "zone", "subject": "of", "acknowledged_unix_s": "seen", "acknowledged_by": "by"}

questions = App(name="history")


class _Asked(Options, frozen=True, kw_only=True):
    begin: Annotated[str, Option("from")] = "today"
    """When the range begins: 14:00, yesterday 8:00, 2 hours ago, an ISO time, or seconds since 1970."""
    end: Annotated[str | None, Option("to")] = None
    """When the range ends, in the same words, a time of day on the day on which it begins; by default now."""
    history: Path | None = None
    """Folder of the history; by default history in the user's data folder."""
    site_id: SiteId | None = None
    """Number of the site; by default the only one in the folder."""
    json: bool = False
    """Write one JSON object instead of the table."""

    def opened(self) -> "tuple[History, Span]":
        """The history and the range that are asked for. Raises SkylessError."""
        from skyless.run.history.queries import History, sites_in
        from skyless.run.history.times import span_of
        from skyless.run.process import data_folder

        folder = self.history or data_folder() / "history"
        sites = sites_in(folder)
        if self.site_id is None and len(sites) != 1:
            several = f"the sites {', '.join(map(str, sites))}; --site-id chooses one"
            held = f"it holds {several if sites else 'none'}"
            raise SkylessError(f"--history is '{folder}'; it should be the folder of a site's history, and {held}")
        history = History(folder, sites[0] if self.site_id is None else self.site_id)
        try:
            return history, span_of(self.begin, self.end, time.time())
        except SkylessError as error:
            raise SkylessError(f"--{error}") from None


class _Drawn(_Asked, frozen=True, kw_only=True):
    plot: Path | None = None
    """Draw the answer into this file (PNG, SVG or PDF)."""

    def check(self) -> None:
        """See that the picture can be written."""
        check_picture(self.plot)

    def show(
        self,
        asked: "tuple[History, Span]",
        name: str,
        found: Struct | Sequence[Struct],
        rows: Iterable[Mapping[str, object]],
        draw: "Callable[[ModuleType, str], Figure]",
    ) -> None:
        """Write the answer as JSON or a table; ``draw`` gets ``history_pictures`` and a title to make its picture."""
        title = _range(asked[1])
        if self.json:
            _print(*asked, {name: found})
        else:
            _table(title, list(rows))
        if self.plot is not None:
            from skyless.cli import history_pictures

            write_picture(self.plot, draw(history_pictures, title))


@questions.command(help_epilogue="Example: skyless history track tag7 --from 8:00 --to 16:00 --plot way.png")
@command
def track(tag: str, /, *, asked: _Drawn, points: Annotated[int, whole(2, 1_000_000)] = 2000) -> int:
    """Where a tag was: its way, thinned to a number of points, with its length.

    Parameters
    ----------
    tag
        Name of the tag.
    points
        How many points of the way are given at most.
    """
    history, span = asked.opened()
    way = history.track(tag, span, points)
    row = {"tag": tag, "fixes": way.fixes, "length_m": way.length_m}
    for end, point in zip(("first", "last"), (*way.points[:1], *way.points[-1:]), strict=False):
        row[end] = f"({point.x_m:.2f}, {point.y_m:.2f}) m at {_time(point.unix_s)}"
    rows = [row] if way.fixes else []
    asked.show(
        (history, span), "track", way, rows, lambda pictures, title: pictures.track_figure(way, history.zones(), title)
    )
    return 0 if way.fixes else NO_FIX


@questions.command(help_epilogue="Example: skyless history heatmap --from yesterday --to today --plot heat.png")
@command
def heatmap(*tags: str, asked: _Drawn, cell: Positive = 0.25) -> int:
    """How long tags, by default all, were where.

    Parameters
    ----------
    tags
        Names of tags.
    cell
        Side of a cell in metres.
    """
    history, span = asked.opened()
    found = history.heatmap(span, cell, tags)

    longest = sorted(enumerate(found.seconds), key=lambda one: -one[1])[:_LONGEST_LIST]
    rows: list[dict[str, object]] = [
        {
            "x_m": found.x0_m + cell * (k % found.columns + 0.5),
            "y_m": found.y0_m + cell * (k // found.columns + 0.5),
            "seconds": seconds,
        }
        for k, seconds in longest
    ]
    rows += [{"x_m": "all", "y_m": f"{found.tags} tags", "seconds": sum(found.seconds)}] if rows else []
    asked.show(
        (history, span),
        "heatmap",
        found,
        rows,
        lambda pictures, title: pictures.heatmap_figure(found, history.zones(), title),
    )
    return 0 if found.tags else NO_FIX


@questions.command(help_epilogue="Example: skyless history dwell --from monday --zone dock")
@command
def dwell(*tags: str, asked: _Drawn, zone: str | None = None) -> None:
    """How long tags, by default all, were in zones.

    Parameters
    ----------
    tags
        Names of tags.
    zone
        Identifier of the only zone; by default all.
    """
    history, span = asked.opened()
    found = history.dwell(span, tags, zone)
    asked.show(
        (history, span), "dwell", found, map(asdict, found), lambda pictures, title: pictures.dwell_figure(found, title)
    )


@questions.command(help_epilogue="Example: skyless history occupancy --from 6:00 --zone canteen --every 600")
@command
def occupancy(*, asked: _Drawn, zone: str | None = None, every: Positive = 300.0) -> None:
    """How many tags were in zones, over time.

    Parameters
    ----------
    zone
        Identifier of the only zone; by default all.
    every
        Seconds of a step of time.
    """
    history, span = asked.opened()
    found = history.occupancy(span, zone, every)
    asked.show(
        (history, span),
        "occupancy",
        found,
        (asdict(one) for one in found if one.most),
        lambda pictures, title: pictures.occupancy_figure(found, title),
    )


@questions.command(help_epilogue="Example: skyless history contacts tag7 --from yesterday --within 1.5")
@command
def contacts(tag: str, /, *, asked: _Drawn, within: Positive = 2.0) -> None:
    """Which tags were near a tag, and when.

    Parameters
    ----------
    tag
        Name of the tag.
    within
        Metres in the plane at which tags are near each other.
    """
    history, span = asked.opened()
    found = history.contacts(tag, span, within)
    asked.show(
        (history, span),
        "contacts",
        found,
        map(asdict, found),
        lambda pictures, title: pictures.contacts_figure(found, title),
    )


@questions.command(help_epilogue="Example: skyless history alarms --from yesterday")
@command
def alarms(*, asked: _Drawn) -> None:
    """Alarms of the range, with those that had begun before it and had not ended."""
    history, span = asked.opened()
    found = history.alarms(span)
    asked.show(
        (history, span),
        "alarms",
        found,
        map(asdict, found),
        lambda pictures, title: pictures.alarms_figure(found, title),
    )


@questions.command(help_epilogue="Example: skyless history export fixes.csv --from yesterday --to today")
@command
def export(file: Path, /, *tags: str, asked: _Asked, site: Path | None = None, force: bool = False) -> None:
    """Write the fixes of tags, by default all, as a table: CSV, Parquet, or GeoJSON with one feature a line.

    Parameters
    ----------
    file
        The file to write; its ending .csv, .parquet or .geojsonl is its format.
    tags
        Names of tags.
    site
        Site file with a georeference, which GeoJSON needs.
    force
        Overwrite what is there, if the file exists.
    """
    check_folder("file", file)
    if file.exists() and not force:
        raise SkylessError(f"{file} exists; --force overwrites it")
    history, span = asked.opened()
    origin = None
    if site is not None:
        from skyless.site.file.load import load_site

        origin = load_site(site).georeference
    count = history.export(file, span, tags, origin)
    if asked.json:
        _print(history, span, {"file": file, "fixes": count})
    else:
        console().print(f"{file}: {count} fixes, {_range(span)}", markup=False)


def _print(history: "History", span: "Span", answer: dict[str, Any]) -> None:
    known = {"from_unix_s": span.from_unix_s, "to_unix_s": span.to_unix_s}
    print_json({"site": history.site, **known, "known_until_unix_s": history.known_until_unix_s(), **answer})


def _table(title: str, rows: Sequence[Mapping[str, object]]) -> None:
    """A table whose columns are the fields of its rows, by name."""
    from rich.table import Table
    from rich.text import Text

    more = len(rows) - _LONGEST_TABLE
    table = Table(title=title, caption=f"{more} more rows: --json gives all" if more > 0 else None)
    names = [name for name in rows[0] if name not in {"id", "zone"}] if rows else []  # people read zone_name
    for name in names:
        table.add_column(_HEADINGS.get(name) or name.removesuffix("_unix_s").replace("_", " "), overflow="fold")
    for row in rows[:_LONGEST_TABLE]:
        table.add_row(*(Text(_shown(name, row[name])) for name in names))
    console().print(table if rows else f"{title}: nothing", markup=False)


def _shown(name: str, value: object) -> str:
    if value is None:
        return "–"
    if not isinstance(value, float):
        return str(value)
    if name.endswith("unix_s"):
        return _time(value)
    if name != "seconds":
        return f"{value:.2f}"
    minutes, seconds = divmod(round(value), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes:02} min" if hours else f"{minutes} min {seconds:02} s"


def _time(unix_s: float) -> str:
    return datetime.fromtimestamp(unix_s).isoformat(" ", "seconds")


def _range(span: "Span") -> str:
    return f"{_time(span.from_unix_s)} to {_time(span.to_unix_s)}"
