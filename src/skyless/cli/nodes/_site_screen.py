"""The text view of a site: a picture of it in a given number of columns and lines."""

import time
from typing import Final

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from skyless.cli.nodes._site_view import AnchorRow, Picture, TagRow
from skyless.page.condition.evidence import ALERTS, FRESH_S
from skyless.run.mqtt.messages import AlarmMessage

_COLOURS: Final = {"good": "bold green", "waiting": "bold cyan", "warning": "bold yellow", "bad": "bold red"}
_ALERTS: Final = {
    "detected-excluded": "excluded",
    "detected-not-excluded": "FAULT",
    "alert-limit-exceeded": "LIMIT",
}
_MAX_REASONS: Final = 3
_WIDE: Final = 100
_MIN_ROWS: Final = 3
"""Rows that tags, anchors and alarms have each where there is little space, the last saying how many more there are."""


def drawn(picture: Picture, width: int, height: int, last_line: str = "") -> RenderableType:
    """The whole picture in ``width`` columns and ``height`` lines; ``last_line`` is the last warning."""
    head = [_title(picture), *_reasons(picture)]
    foot = [_line("drops ", ", ".join(f"{why} {count}" for why, count in picture.drops.items()) or "none")]
    if picture.wrong_messages:
        foot.append(_line("unreadable messages ", str(picture.wrong_messages), "yellow"))
    if last_line:
        foot.append(_line("log ", last_line, "yellow"))
    counts = [len(picture.alarms), len(picture.tags), len(picture.anchors)]
    headings = 2 + bool(counts[0])
    most = _shares(counts, max(height - len(head) - len(foot) - headings, 0))
    parts: list[RenderableType] = list(head)
    if picture.alarms:
        parts += [
            _line("", f"alarms ({counts[0]})", "bold"),
            *_fitted([_alarm(one) for one in picture.alarms], most[0]),
        ]
    return Group(*parts, _tags(picture, most[1], width), _anchors(picture, most[2], width), *foot)


def summary(picture: Picture) -> str:
    """One line, for where there is no terminal."""
    with_fix = sum(row.state == "fix" for row in picture.tags)
    heard = sum(row.state not in ("silent", "offline") for row in picture.anchors)
    waiting = sum(one.acknowledged_unix_s is None for one in picture.alarms)
    condition = picture.condition.level + (f" ({picture.condition.text})" if picture.condition.text else "")
    return plain(
        f"{time.strftime('%H:%M:%S', time.localtime(picture.unix_s))} {condition}; {with_fix} of {len(picture.tags)} "
        f"tags with a fix; {heard} of {len(picture.anchors)} anchors; {waiting} of {len(picture.alarms)} alarms "
        f"not acknowledged; broker {picture.trouble or 'connected'}"
    )


def plain(text: str) -> str:
    """A text from the network without characters that would control the terminal."""
    return "".join(one if one.isprintable() else "\N{REPLACEMENT CHARACTER}" for one in text)


def _line(label: str, words: str, style: str = "") -> Text:
    return Text.assemble((label, "dim"), (plain(words), style), no_wrap=True, overflow="ellipsis")


def _title(picture: Picture) -> Text:
    level, trouble = picture.condition.level, picture.trouble
    line = _line("", f"{picture.site or 'no site yet'} (site {picture.number})", "bold")
    line.append(" simulated" if picture.simulated else "", "dim")
    line.append(f"  {level}  ", _COLOURS[level])
    line.append(time.strftime("%H:%M:%S  ", time.localtime(picture.unix_s)))
    line.append(plain(f"{picture.broker} {trouble or 'connected'}"), "red" if trouble else "dim")
    return line


def _reasons(picture: Picture) -> list[Text]:
    condition = picture.condition
    lines = [_line("", reason.text, _COLOURS[reason.level]) for reason in condition.reasons]
    if not condition.reasons:
        return [_line("", condition.text)] if condition.text else []
    return [*_fitted(lines, _MAX_REASONS), _line("", condition.reasons[0].advice)]


def _alarm(alarm: AlarmMessage) -> Text:
    seen = alarm.acknowledged_unix_s is not None
    since = time.strftime("%H:%M:%S ", time.localtime(alarm.since_unix_s))
    ended = " (ended)" if alarm.ended_unix_s is not None else ""
    by = f" (seen by {alarm.acknowledged_by})" if seen else ""
    return _line(since, f"{alarm.severity} {alarm.sentence}{ended}{by}", "dim" if seen else "bold red")


def _shares(counts: list[int], rows: int) -> list[int]:
    """How many rows each list may have, alarms, tags and anchors: ``_MIN_ROWS``, and tags most of what is left."""
    shares = [min(count, _MIN_ROWS) for count in counts]
    left = max(rows - sum(shares), 0)
    for index, most in ((0, left // 4), (2, left // 3), (1, left), (2, left), (0, left)):
        more = min(counts[index] - shares[index], most, left)
        shares[index], left = shares[index] + more, left - more
    return shares


def _fitted(rows: list[Text], most: int) -> list[Text]:
    return rows if len(rows) <= most else [*rows[: most - 1], _line("", f"and {len(rows) - most + 1} more", "dim")]


def _tags(picture: Picture, most: int, width: int) -> Table:
    numbers = ("x/m", "y/m", "z/m", "σ/cm", "HPL/cm", "Hz", "from")
    table = _table(f"tags ({len(picture.tags)})", numbers, width)
    for name in ("age", "alert", "zone"):
        table.add_column(Text(name), no_wrap=name != "zone")
    return _filled(table, [_tag(row) for row in picture.tags[:most]], len(picture.tags), most)


def _filled(table: Table, rows: list[list[Text]], count: int, most: int) -> Table:
    """The table with at most ``most`` of its ``count`` rows, the last of which says how many more there are."""
    if count > most:
        rows = [*rows[: max(most - 1, 0)], [Text(f"and {count - max(most - 1, 0)} more", "dim")]]
    for row in rows:
        table.add_row(*row)
    return table


def _tag(row: TagRow) -> list[Text]:
    """The cells of a tag. What is not of now is dim, and its age is in words, in red."""
    fresh = row.state == "fix"
    style = "" if fresh else "dim"
    x, y, z = ("–",) * 3 if row.position_m is None else (f"{value:.2f}" for value in row.position_m)
    figures = (x, y, z, _cm(row.std_m), _cm(row.hpl_m), _whole(row.updates_per_s), str(row.anchors or "–"))
    name = plain(f"{row.name} ({row.tag})" if row.name else row.tag)
    if fresh:
        age = Text(f"{max(row.age_s or 0.0, 0.0):.1f} s")
    elif row.state == "offline":
        age = Text("offline", "dim")
    else:
        age = Text("no fix" if row.age_s is None else f"no fix for {duration(row.age_s)}", "bold red")
    alert = _ALERTS.get(row.alert, "") if fresh else ""
    words = plain(", ".join(row.zones)) if fresh else plain(row.reason)
    colour = "bold red" if ALERTS.get(row.alert, 0) > 1 else "yellow"
    return [_cut(name, style), *(Text(one, style) for one in figures), age, Text(alert, colour), _cut(words, style)]


def _anchors(picture: Picture, most: int, width: int) -> Table:
    table = _table(f"anchors ({len(picture.anchors)})", ("role", "hears", "report", "missed"), width)
    return _filled(table, [_anchor(row) for row in picture.anchors[:most]], len(picture.anchors), most)


def _anchor(row: AnchorRow) -> list[Text]:
    gone = row.state in ("silent", "offline")
    style = "dim" if gone else ""
    age = "–" if row.age_s is None else f"{duration(row.age_s)} ago"
    old = row.age_s is not None and row.age_s > FRESH_S
    missed = "–" if row.missed_share is None else f"{100.0 * row.missed_share:.0f} %"
    hears = "–" if row.hears is None else str(row.hears)
    return [
        _cut(plain(row.anchor), style), Text(row.state, "bold red" if gone else ""), Text(hears, style),
        Text(age, "bold red" if old else style), Text(missed, style),
    ]  # fmt: skip


def _table(first: str, columns: tuple[str, ...], width: int) -> Table:
    """A table whose columns of numbers keep their width; names are cut, and the last column where there is no space."""
    gap, most = (2, 28) if width >= _WIDE else (1, 15)
    table = Table(box=None, padding=(0, gap, 0, 0), header_style="dim", pad_edge=False)
    table.add_column(Text(first, "bold"), no_wrap=True, overflow="ellipsis", max_width=most)
    for name in columns:
        table.add_column(Text(name), justify="right", no_wrap=True)
    return table


def _cut(words: str, style: str = "") -> Text:
    return Text(words, style, no_wrap=True, overflow="ellipsis")


def duration(seconds: float) -> str:
    """A time for people, in whole units that have passed: 4 s, 12 min, 3 h."""
    if seconds < 120.0:
        return f"{int(seconds)} s"
    return f"{int(seconds / 60.0)} min" if seconds < 7200.0 else f"{int(seconds / 3600.0)} h"


def _cm(value_m: float | None) -> str:
    return "–" if value_m is None else f"{100.0 * value_m:.1f}" if value_m < 1.0 else f"{100.0 * value_m:.0f}"


def _whole(value: float | None) -> str:
    return "–" if value is None else f"{value:.0f}"
