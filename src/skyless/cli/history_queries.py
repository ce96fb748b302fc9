"""``skyless history track``, ``heatmap``, ``dwell``, ``occupancy``, ``contacts``, ``alarms`` and ``export``."""

import time
from collections.abc import Iterable, Sequence
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import App

from skyless.cli.common.options import check_folder, check_picture, command
from skyless.cli.common.output import NO_FIX, console, print_facts, print_json, write_picture
from skyless.cli.nodes.options import SiteId
from skyless.core.arguments import Option, Options, Positive, whole
from skyless.core.errors import SkylessError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from skyless.run.history.answers import Span
    from skyless.run.history.queries import History

_LONGEST_TABLE = 40
"""Rows that are shown; --json gives all."""

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
            held = (
                f"it holds the sites {', '.join(map(str, sites))}; --site-id chooses one" if sites else "it holds none"
            )
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

    def draw(self, figure: "Figure") -> None:
        """Write the picture."""
        assert self.plot is not None
        write_picture(self.plot, figure)


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
    if asked.json:
        _print(history, span, track=way)
    else:
        ends = [f"({p.x_m:.2f}, {p.y_m:.2f}) m at {_time(p.unix_s)}" for p in (*way.points[:1], *way.points[-1:])]
        facts = [
            ("fixes", str(way.fixes)),
            ("length", f"{way.length_m:.1f} m"),
            *zip(("first", "last"), ends, strict=False),
        ]
        print_facts(f"{tag}, {_range(span)}", facts)
    if asked.plot is not None:
        from skyless.cli.history_pictures import track_figure

        asked.draw(track_figure(way, history.zones(), f"{tag}, {_range(span)}"))
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
    if asked.json:
        _print(history, span, heatmap=found)
    else:
        best = sorted(enumerate(found.seconds), key=lambda one: -one[1])[:10]
        places = [
            (
                found.x0_m + found.cell_m * (k % found.columns + 0.5),
                found.y0_m + found.cell_m * (k // found.columns + 0.5),
                s,
            )
            for k, s in best
        ]
        rows = [(f"{x:.2f}", f"{y:.2f}", _length(seconds)) for x, y, seconds in places if seconds > 0.0]
        _table(
            f"{found.tags} tags, {_length(sum(found.seconds))} in all, {_range(span)}",
            ("x in m", "y in m", "time"),
            rows,
        )
    if asked.plot is not None:
        from skyless.cli.history_pictures import heatmap_figure

        asked.draw(heatmap_figure(found, history.zones(), _range(span)))
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
    if asked.json:
        _print(history, span, dwell=found)
    else:
        rows = [
            (d.tag, d.zone_name, str(d.visits), _length(d.seconds), _time(d.first_unix_s), _time(d.last_unix_s))
            for d in found
        ]
        _table(_range(span), ("tag", "zone", "visits", "time", "from", "to"), rows)
    if asked.plot is not None:
        from skyless.cli.history_pictures import dwell_figure

        asked.draw(dwell_figure(found, _range(span)))


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
    if asked.json:
        _print(history, span, occupancy=found)
    else:
        rows = [(one.zone_name, _time(one.unix_s), f"{one.mean:.2f}", str(one.most)) for one in found if one.most]
        _table(_range(span), ("zone", "step from", "mean", "most"), rows)
    if asked.plot is not None:
        from skyless.cli.history_pictures import occupancy_figure

        asked.draw(occupancy_figure(found, _range(span)))


@questions.command(help_epilogue="Example: skyless history contacts tag7 --from yesterday --within 1.5")
@command
def contacts(tag: str, /, *, asked: _Asked, within: Positive = 2.0) -> None:
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
    if asked.json:
        _print(history, span, contacts=found)
        return
    rows = [
        (one.other, _time(one.begin_unix_s), _length(one.end_unix_s - one.begin_unix_s), f"{one.least_m:.2f} m")
        for one in found
    ]
    _table(f"{tag}, {_range(span)}", ("near", "from", "time", "least distance"), rows)


@questions.command(help_epilogue="Example: skyless history alarms --from yesterday")
@command
def alarms(*, asked: _Asked) -> None:
    """Alarms of the range, with those that had begun before it and had not ended."""
    history, span = asked.opened()
    found = history.alarms(span)
    if asked.json:
        _print(history, span, alarms=found)
        return
    rows = [
        (
            a.rule,
            a.subject,
            a.text,
            _time(a.raised_unix_s),
            _time(a.ended_unix_s),
            _time(a.acknowledged_unix_s),
            a.acknowledged_by,
        )
        for a in found
    ]
    _table(_range(span), ("rule", "of", "what", "raised", "ended", "seen", "by"), rows)


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
        _print(history, span, file=file, fixes=count)
    else:
        console().print(f"{file}: {count} fixes, {_range(span)}", markup=False)


def _print(history: "History", span: "Span", **answer: Any) -> None:  # noqa: ANN401 - structs of answers
    until = history.known_until_unix_s()
    known = {"from_unix_s": span.from_unix_s, "to_unix_s": span.to_unix_s, "known_until_unix_s": until}
    print_json({"site": history.site, **known, **answer})


def _table(title: str, columns: Iterable[str], rows: Sequence[tuple[str, ...]]) -> None:
    from rich.markup import escape
    from rich.table import Table
    from rich.text import Text

    more = len(rows) - _LONGEST_TABLE
    table = Table(title=escape(title), caption=f"{more} more rows: --json gives all" if more > 0 else None)
    for column in columns:
        table.add_column(column, overflow="fold")
    for row in rows[:_LONGEST_TABLE]:
        table.add_row(*map(Text, row))
    console().print(table if rows else f"{title}: nothing", markup=False)


def _time(unix_s: float | None) -> str:
    return "–" if unix_s is None else datetime.fromtimestamp(unix_s).isoformat(" ", "seconds")


def _range(span: "Span") -> str:
    return f"{_time(span.from_unix_s)} to {_time(span.to_unix_s)}"


def _length(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes:02} min" if hours else f"{minutes} min {rest:02} s"
