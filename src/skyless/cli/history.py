"""``skyless history``: keep a site's fixes and events in Parquet files, and query them."""

import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import App, Parameter
from msgspec import Struct
from msgspec.structs import asdict

from skyless.arguments import Option, Options, Positive, whole
from skyless.cli.common import (
    NO_FIX,
    JsonOptions,
    RecordingFile,
    check_folder,
    check_new,
    check_picture,
    command,
    console,
    make_folder,
    print_json,
    with_status,
    write_picture,
)
from skyless.cli.nodes.options import SiteId, SiteOptions, log, run_until_stopped
from skyless.core.errors import SkylessError
from skyless.machine import extra_module
from skyless.run.history.answers import span_of, time_text

if TYPE_CHECKING:
    from collections.abc import Awaitable

    from skyless.run.gather.subjects import NatsAddress
    from skyless.run.history.answers import Span
    from skyless.run.history.program import HistoryNode, HistoryState, HubHistory
    from skyless.run.history.queries import History
    from skyless.run.history.writer import Keep
    from skyless.run.mqtt.address import MqttAddress

    _History = HistoryNode | HubHistory


# ``skyless history track``, ``heatmap``, ``dwell``, ``contacts`` and ``sql``.

_LONGEST_TABLE = 40
"""Rows that a table shows; --json gives all."""
_LONGEST_LIST = 10
"""Cells of a heat map that a table shows."""

_HEADINGS = {"seconds": "duration"}
_OF_TAGS = ("tag", "other")
_Row = dict[str, Any]
_Tag = Annotated[str, Parameter(help="Name of the tag, or of its asset.")]
_Tags = Annotated[str, Parameter(help="Names of tags, or of their assets.")]
_Points = Annotated[int, whole(2, 20_000), Parameter(help="How many points of the way are given at most.")]
_Cell = Annotated[Positive, Parameter(help="Side of a cell in metres.")]
_Zone = Annotated[str | None, Parameter(help="Identifier of the only zone; by default all.")]
_Within = Annotated[Positive, Parameter(help="Metres in the plane at which tags are near each other.")]

questions = App(name="history")


class _Asked(JsonOptions, frozen=True, kw_only=True):
    begin: Annotated[str, Option("from")] = "today"
    """When the range begins: 14:00, yesterday 8:00, 2 hours ago, an ISO time, or seconds since 1970."""
    end: Annotated[str | None, Option("to")] = None
    """When the range ends, in the same words, a time of day on the day on which it begins; by default now."""
    history: Path | None = None
    """Folder of the history; by default history in the user's data folder."""
    site_id: SiteId | None = None
    """Number of the site; by default the only one in the folder."""

    def opened(self) -> "tuple[History, Span]":
        """Open the history, and parse the time range. Raises SkylessError."""
        from skyless.run.history.layout import sites_in
        from skyless.run.history.queries import History
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
        """Check that the picture can be written."""
        check_picture(self.plot)

    def answer(self, name: str, ask: "Callable[[History, Span], Struct | Sequence[Struct]]") -> int:
        """Query the history, and write the answer as JSON or a table, and as a picture of ``history_pictures``."""
        history, span = self.opened()
        found = ask(history, span)
        assets = history.assets()
        given: Any = _named(found, assets) if isinstance(found, Struct) else [_named(one, assets) for one in found]
        rows = _ROWS[name](given) if name in _ROWS else given
        if self.json:
            _print(history, span, {name: given})
        else:
            _table(_range(span), rows)
        if self.plot is not None:
            from skyless.cli.history_pictures import FIGURES

            write_picture(self.plot, FIGURES[name](given, history.zones(), _range(span)))
        return NO_FIX if isinstance(given, dict) and not rows else 0


def _named(answer: Struct, assets: Mapping[str, str]) -> _Row:
    """The fields of an answer; a field that names tags is followed by their assets' names."""
    row = {}
    for key, value in asdict(answer).items():
        row[key] = value
        if key in _OF_TAGS:
            row[f"{key}_name"] = "~".join(assets.get(tag, tag) for tag in value.split("~"))
    return row


def _track_rows(way: _Row) -> list[_Row]:
    row = {name: way[name] for name in ("tag_name", "fixes", "length_m")}
    for end, point in zip(("first", "last"), (*way["points"][:1], *way["points"][-1:]), strict=False):
        row[end] = f"({point.x_m:.2f}, {point.y_m:.2f}) m at {time_text(point.unix_s)}"
    return [row] if way["fixes"] else []


def _heatmap_rows(found: _Row) -> list[_Row]:
    longest = sorted(enumerate(found["seconds"]), key=lambda one: -one[1])[:_LONGEST_LIST]
    rows = []
    for k, seconds in longest:
        row, column = divmod(k, found["columns"])
        x_m, y_m = (found[f"{name}0_m"] + found["cell_m"] * (n + 0.5) for name, n in (("x", column), ("y", row)))
        rows.append({"x_m": x_m, "y_m": y_m, "seconds": seconds})
    whole = {"x_m": "all", "y_m": f"{found['tags']} tags", "seconds": sum(found["seconds"])}
    return [*rows, whole] if found["tags"] else []


_ROWS: Mapping[str, Callable[[Any], list[_Row]]] = {"track": _track_rows, "heatmap": _heatmap_rows}
"""Functions that convert an answer to table rows, for commands that do not show the answer itself."""


@questions.command(help_epilogue="Example: skyless history track tag7 --from 8:00 --to 16:00 --plot way.png")
@command
def track(tag: _Tag, /, *, asked: _Drawn, points: _Points = 2000) -> int:
    """Where a tag was: its way, thinned to a number of points, with its length."""
    return asked.answer("track", lambda history, span: history.track(tag, span, points))


@questions.command(help_epilogue="Example: skyless history heatmap --from yesterday --to today --plot heat.png")
@command
def heatmap(*tags: _Tags, asked: _Drawn, cell: _Cell = 0.25) -> int:
    """How long tags, by default all, were where."""
    return asked.answer("heatmap", lambda history, span: history.heatmap(span, cell, tags))


@questions.command(help_epilogue="Example: skyless history dwell --from monday --zone dock")
@command
def dwell(*tags: _Tags, asked: _Drawn, zone: _Zone = None) -> int:
    """How long tags, by default all, were in zones."""
    return asked.answer("dwell", lambda history, span: history.dwell(span, tags, zone))


@questions.command(help_epilogue="Example: skyless history contacts tag7 --from yesterday --within 1.5")
@command
def contacts(tag: _Tag, /, *, asked: _Drawn, within: _Within = 2.0) -> int:
    """Which tags were near a tag, and when."""
    return asked.answer("contacts", lambda history, span: history.contacts(tag, span, within))


@questions.command(help_epilogue="Example: skyless history sql 'SELECT kind, count(*) FROM events GROUP BY kind'")
@command
def sql(query: str, /, *, asked: _Asked, write: Path | None = None, force: bool = False) -> None:
    """Ask in SQL, of DuckDB's dialect: one SELECT from fixes, events, zones and assets.

    Fixes and events are those of the range of time. docs/history.md lists their columns.

    Parameters
    ----------
    query
        The SELECT.
    write
        File for the answer instead of the table; its ending .csv or .parquet is its format.
    force
        Overwrite what is there, if the file exists.
    """
    if write is not None:
        check_folder("--write", write)
        check_new(write, force=force)
    history, span = asked.opened()
    if write is not None:
        count = history.write(query, span, write)
        if asked.json:
            _print(history, span, {"file": write, "rows": count})
        else:
            console().print(f"{write}: {count} rows, {_range(span)}", markup=False)
        return
    rows = history.sql(query, span)
    if asked.json:
        _print(history, span, {"sql": rows})
    else:
        _table(_range(span), rows)


def _print(history: "History", span: "Span", answer: dict[str, Any]) -> None:
    known = {"from_unix_s": span.from_unix_s, "to_unix_s": span.to_unix_s}
    print_json({"site": history.site, **known, "known_until_unix_s": history.known_until_unix_s(), **answer})


def _table(title: str, rows: Sequence[_Row]) -> None:
    """Print a table with a column for each field of its rows."""
    from rich.table import Table
    from rich.text import Text

    more = len(rows) - _LONGEST_TABLE
    table = Table(title=title, caption=f"{more} more rows: --json gives all" if more > 0 else None)
    names = [name for name in rows[0] if f"{name}_name" not in rows[0]] if rows else []
    for name in names:
        heading = name.removesuffix("_name").removesuffix("_unix_s")
        heading = f"{heading.removesuffix('_m')} in m" if heading.endswith("_m") else heading.replace("_", " ")
        table.add_column(_HEADINGS.get(name, heading), overflow="fold")
    for row in rows[:_LONGEST_TABLE]:
        table.add_row(*(Text(_shown(name, row[name])) for name in names))
    console().print(table if rows else f"{title}: nothing", markup=False)


def _shown(name: str, value: object) -> str:
    if value is None:
        return "–"
    if not isinstance(value, float):
        return str(value)
    if name.endswith("unix_s"):
        return time_text(value)
    if name != "seconds":
        return f"{value:.2f}"
    minutes, seconds = divmod(round(value), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours} h {minutes:02} min" if hours else f"{minutes} min {seconds:02} s" if minutes else f"{seconds} s"


def _range(span: "Span") -> str:
    return f"{time_text(span.from_unix_s)} to {time_text(span.to_unix_s)}"


HistoryFolder = Annotated[
    Path, Parameter(name="--to", help="Where fixes are kept: a folder, which several sites may share.")
]

app = App(name="history", help_epilogue="Example: skyless history run --to history")
app.update(questions)


class RunOptions(Options, frozen=True, kw_only=True):
    """Options of ``skyless history run``."""

    nats: Annotated[str | None, Parameter(env_var="SKYLESS_NATS")] = None
    """NATS server of the site, nats://[USER@]HOST[:PORT] or tls://...; by default that of a broker with a gather on
    this machine, or else one of its own."""
    hub: Annotated[str | None, Option("from")] = None
    """Servers of a hub, nats://[USER@]HOST[:PORT],HOST... or tls://...: all its sites are kept, or that of
    --site-id."""
    keep_days: Positive = 400.0
    """Days after which fixes are removed."""
    full_days: Positive = 7.0
    """Days after which fixes are thinned: of a moving tag one in ten seconds stays, of a tag at rest one in a
    minute."""
    event_days: Positive = 365.0
    """Days after which events are removed: entered and left zones, alarms, anchors and tags that came and went."""


@app.command(help_epilogue="Example: skyless history run --to history --keep-days 90")
@command
def run(*, to: HistoryFolder, live: SiteOptions, asked: RunOptions, output: JsonOptions) -> int:
    """Keep the fixes and events of a running site, or of a hub's, until Ctrl-C, in Parquet files for any tool.

    A kill -9 loses nothing that has reached the site's stream. Give the same folder at every start. The exit code is 1
    where the disk did not take everything; the next start goes on there.
    """
    from skyless.run.gather.subjects import nats_address
    from skyless.run.history.writer import Keep

    extra_module("nats", "skyless history run")
    keep = Keep(asked.keep_days, asked.full_days, asked.event_days)
    found: list[_History] = []
    if asked.hub is not None:
        if live.mqtt is not None or asked.nats is not None:
            raise SkylessError(
                f"--from is {asked.hub!r}; give it without --mqtt and --nats, which are of a single site"
            )
        hub = nats_address(asked.hub, "--from", live.mqtt_ca)
        hub.tls_context()
        opening = partial(_of_hub, to, hub, live.site_id, keep)
    else:
        address = live.required("the broker of the site whose history to keep")
        nats = None if asked.nats is None else nats_address(asked.nats)
        opening = partial(_of_broker, to, address, live.site_id, keep, nats)
    make_folder("--to", to)
    run_until_stopped(_keep(opening, found))
    state = found[0].state() if found else None
    if output.json:
        import msgspec

        print_json({"folder": to, **({} if state is None else msgspec.to_builtins(state))})
    elif state is None:
        print(f"{to}: nothing was kept, as no program of a site was online")
    else:
        print(f"{to}: {_counts(state)} in {state.seconds:.0f} s{_losses(state)}")
    return 1 if state is not None and state.disk else 0


async def _of_broker(
    folder: Path, address: "MqttAddress", site_id: int | None, keep: "Keep", nats: "NatsAddress | None"
) -> "_History":
    from skyless.run.broker import nats_of
    from skyless.run.find_site import find_site
    from skyless.run.history.program import HistoryNode
    from skyless.run.mqtt.address import Role

    if nats is None and address.user not in {*Role} - {Role.OPERATOR}:  # the other roles may not read streams
        nats = nats_of(address)
    site = await find_site(address) if site_id is None else site_id
    return HistoryNode(folder, site, address, keep, log, nats)


async def _of_hub(folder: Path, hub: "NatsAddress", site_id: int | None, keep: "Keep") -> "_History":
    from skyless.run.history.program import HubHistory

    return HubHistory(folder, hub, site_id, keep, log)


async def _keep(opening: "Callable[[], Awaitable[_History]]", found: "list[_History]") -> None:
    """Run a history until cancelled, and append it to ``found``."""
    node = await opening()
    found.append(node)
    await with_status(node.run(), lambda: _line(node.state()))


def _line(now: "HistoryState") -> str:
    trouble = now.disk or (f"no broker, {now.trouble}" if now.trouble else "Ctrl-C ends")
    return f"history, {now.seconds:.0f} s: {_counts(now)}, {now.waiting} in no file yet{_losses(now)}; {trouble}"


def _counts(state: "HistoryState") -> str:
    return f"{state.fixes} fixes of {state.tags} tags and {state.events} events"


def _losses(state: "HistoryState") -> str:
    lost = [f"{count} {reason}" for reason, count in sorted(state.drops.items())]
    return f"; not kept: {', '.join(lost)}" if lost else ""


_RecordedSite = Annotated[SiteId | None, Parameter(help="Number of the site; by default the one that was recorded.")]


@app.command(name="import", help_epilogue="Example: skyless history import walk.mcap --to history")
@command
def import_file(
    recording: RecordingFile, /, *, to: HistoryFolder, site_id: _RecordedSite = None, output: JsonOptions
) -> None:
    """Add the fixes, events, zones and names of a recording to a history; what that has already is left out."""
    import msgspec

    from skyless.cli.common import progress_bar
    from skyless.run.history.program import import_recording
    from skyless.run.history.writer import Writer
    from skyless.run.recordings.recording import McapRecording

    with McapRecording(recording) as source:
        summary = source.summary()
        site = summary.site if site_id is None else site_id
        if site is None:
            raise SkylessError(f"{recording} does not say of which site it is; --site-id should")
        begin_s, end_s = summary.start_s or 0.0, summary.end_s or 0.0
        with progress_bar("importing", end_s - begin_s) as reach:
            writer = Writer(to, site)
            try:
                found = import_recording(source, writer, lambda unix_s: reach(unix_s - begin_s))
            finally:
                writer.close()
    if output.json:
        print_json({"folder": to, "site": site, **msgspec.to_builtins(found)})
        return
    print(f"{to}: {found.fixes} fixes and {found.events} events of site {site}; {found.known_fixes} fixes were there")
    for reason, number in sorted(found.drops.items()):
        print(f"  dropped: {reason} {number}")
