"""The text view of a site: a picture of it in a given number of lines."""

import sys
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Final, TypeVar

from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from skyless.cli.common.output import number, plain
from skyless.cli.nodes._site_view import GONE, AnchorRow, Picture, TagRow
from skyless.page.condition.evidence import ALERTS, FRESH_S
from skyless.run.mqtt.messages import AlarmMessage

_COLOURS: Final = {"good": "bold green", "waiting": "bold cyan", "warning": "bold yellow", "bad": "bold red"}
_ALERTS: Final[dict[str | None, str]] = {
    "detected-excluded": "excluded",
    "detected-not-excluded": "FAULT",
    "alert-limit-exceeded": "LIMIT",
}
_MAX_REASONS: Final = 3
_MIN_ROWS: Final = 3
_T = TypeVar("_T")


def drawn(
    picture: Picture, height: int = sys.maxsize, errors_m: Mapping[str, float | None] | None = None
) -> RenderableType:
    """The picture in ``height`` lines. What does not fit is counted in the last row of its table.

    ``errors_m`` are those of the tags' fixes, where the truth is known.
    """
    condition, alarms, anchors = picture.condition, picture.alarms, picture.anchors
    reasons = condition.reasons
    head = [_title(picture), *(_text(one.text, _COLOURS[one.level]) for one in reasons[:_MAX_REASONS])]
    if len(reasons) > _MAX_REASONS:
        head.append(_text(f"and {len(reasons) - _MAX_REASONS} more", "dim"))
    if reasons or condition.text:
        head.append(_text(reasons[0].advice if reasons else condition.text))
    foot = [_text("drops " + (", ".join(f"{why} {count}" for why, count in picture.drops.items()) or "none"))]
    if picture.wrong_messages:
        foot.append(_text(f"unreadable messages {picture.wrong_messages}", "yellow"))
    rows = height - len(head) - len(foot) - 2 - bool(alarms)
    most_alarms = min(len(alarms), max(rows // 4, rows - len(picture.tags) - len(anchors), _MIN_ROWS))
    rows -= most_alarms
    most_anchors = min(len(anchors), max(rows // 3, rows - len(picture.tags), _MIN_ROWS))
    columns = ("x/m", "y/m", "z/m") if errors_m is None else ("x/m", "y/m", "z/m", "error/cm")
    return Group(
        *head,
        *([_table("alarms", (), alarms, most_alarms, _alarm)] if alarms else ()),
        _table("tags", (*columns, "σ/cm", "HPL/cm", "Hz", "from", "age", ""), picture.tags, rows - most_anchors,
               partial(_tag, errors_m=errors_m)),
        _table("anchors", ("role", "hears", "report", "missed"), anchors, most_anchors, _anchor),
        *foot,
    )  # fmt: skip


def _title(picture: Picture) -> Text:
    level, trouble = picture.condition.level, picture.trouble
    line = _text(f"{picture.site or 'no site yet'} (site {picture.number})", "bold")
    line.append(" simulated" if picture.simulated else "", "dim")
    line.append(f"  {level}  ", _COLOURS[level])
    line.append(time.strftime("%H:%M:%S  ", time.localtime(picture.unix_s)))
    line.append(plain(f"{picture.broker} {trouble or 'connected'}"), "red" if trouble else "dim")
    return line


def _text(words: str, style: str = "") -> Text:
    return Text(plain(words), style, no_wrap=True, overflow="ellipsis")


def _table(
    name: str, columns: tuple[str, ...], items: Sequence[_T], most: int, cells: Callable[[_T], list[Text]]
) -> Table:
    """At most ``most`` rows. Columns of figures keep their width; the first column and an unnamed last one give way."""
    table = Table(box=None, padding=(0, 1, 0, 0), pad_edge=False, header_style="dim")
    table.add_column(Text(f"{name} ({len(items)})", "bold"))
    for title in columns:
        table.add_column(title, justify="right" if title else "left", no_wrap=bool(title))
    shown = len(items) if len(items) <= most else max(most - 1, 0)
    for item in items[:shown]:
        table.add_row(*cells(item))
    if shown < len(items):
        table.add_row(Text(f"and {len(items) - shown} more", "dim"))
    return table


def _alarm(alarm: AlarmMessage) -> list[Text]:
    seen = alarm.acknowledged_unix_s is not None
    since = time.strftime("%H:%M:%S", time.localtime(alarm.since_unix_s))
    ended = " (ended)" if alarm.ended_unix_s is not None else ""
    by = f" (seen by {alarm.acknowledged_by})" if seen else ""
    return [_text(f"{since} {alarm.severity} {alarm.sentence}{ended}{by}", "dim" if seen else "bold red")]


def _tag(row: TagRow, errors_m: Mapping[str, float | None] | None) -> list[Text]:
    """The cells of a tag. What is not of now is dim, and its age is in words, in red."""
    fix, health, fresh = row.fix, row.health, row.state == "fix"
    style = "" if fresh else "dim"
    errors = () if errors_m is None else (errors_m.get(row.tag),)
    figures = ["–"] * (7 + len(errors))
    if fix is not None:
        lengths = (number(value, "{:.1f}", 100.0) for value in (*errors, fix.std_m, fix.hpl_m))
        rate = number(None if health is None else health.updates_per_s, "{:.0f}")
        figures = [*(f"{value:.2f}" for value in fix.position_m), *lengths, rate, str(len(fix.anchors))]
    age = _text(f"{max(row.age_s or 0.0, 0.0):.1f} s")
    if row.state == "offline":
        age = _text("offline", "dim")
    elif not fresh:
        age = _text("no fix" if row.age_s is None else f"no fix for {row.age_s:.0f} s", "bold red")
    alert = fix.alert if fix is not None and fresh else None
    why = _text(_ALERTS.get(alert, ""), "bold red" if ALERTS.get(alert, 0) > 1 else "yellow")
    if not fresh:
        why = _text((health.reason if health is not None else None) or "", "dim")
    name = f"{row.name or row.tag}{' board' if health is not None and health.on_board else ''}"
    return [_text(name, style), *(_text(one, style) for one in figures), age, why]


def _anchor(row: AnchorRow) -> list[Text]:
    health, gone = row.health, row.state in GONE
    style = "dim" if gone else ""
    old = row.age_s is not None and row.age_s > FRESH_S
    hears, missed = "–", "–"
    if health is not None:
        hears = str(sum(heard_s < FRESH_S for heard_s in health.heard_age_s.values()))
        missed = f"{health.missed_share:.0%}"
    return [
        _text(row.anchor, style), _text(row.state, "bold red" if gone else ""), _text(hears, style),
        _text(number(row.age_s, "{:.0f} s ago"), "bold red" if old else style), _text(missed, style),
    ]  # fmt: skip
