"""Alarm rules: their validation, and the hours in which they apply."""

import re
from collections.abc import Iterator, Sequence
from typing import Final

from msgspec import Struct

from skyless.core.site import AlarmRule

MAX_RULES: Final = 200
GROUP: Final = "group:"
"""Prefix of the name of a group of assets in ``tags`` and ``others``."""

_MAX_WHO: Final = 1000
_MAX_S: Final = 30 * 86400.0
_GROUP: Final = re.compile(rf"{GROUP}[^\x00-\x1f]{{1,100}}")
_ID: Final = re.compile(r"[A-Za-z0-9_-]{1,32}")
_ZONE: Final = re.compile(r"[A-Za-z0-9_.-]{1,64}")
_DAYS: Final = ("mon", "tue", "wed", "thu", "fri", "sat", "sun")
_DAY_MIN: Final = 24 * 60
_WEEK_MIN: Final = 7 * _DAY_MIN
_DAY: Final = f"({'|'.join(_DAYS)})"
_TIME: Final = "((?:[01]?[0-9]|2[0-3]):[0-5][0-9]|24:00)"
_HOURS: Final = re.compile(rf"(?:{_DAY}(?:\s*-\s*{_DAY})?)?\s*(?:{_TIME}\s*-\s*{_TIME})?")
_RIGHT_HOURS: Final = "days or times or both, as mon-fri 06:00-22:00, sat 08:00-12:00 (mon to sun, 00:00 to 24:00)"

KINDS: Final = {
    "inside": "tags zone",
    "outside": "tags zone",
    "silent": "tags",
    "near": "tags others limit hysteresis",
    "crowded": "tags zone limit hysteresis",
    "anchor-offline": "",
    "anchor-moved": "",
    "protection-level": "tags limit hysteresis",
    "battery": "tags limit hysteresis",
}
"""The keys of each kind of rule, in addition to those common to all."""

_LIMITS: Final = {
    "near": (0.1, 1000.0, "a distance in metres from 0.1 to 1000"),
    "crowded": (0.0, 1e6, "the most tags allowed, a whole number from 0"),
    "protection-level": (0.01, 1000.0, "a number of metres from 0.01 to 1000"),
    "battery": (0.0, 1.0, "a share from 0 to 1"),
}
_SHORTEST_SILENCE_S: Final = 1.0


class BadAlarmRulesError(ValueError):
    """A list of rules is invalid."""

    def __init__(self, row: int | None, rule: str, key: str, value: object, expected: str) -> None:
        """``row``: index of the rule, or None if the list as a whole is wrong."""
        self.row, self.rule, self.key, self.value, self.expected = row, rule, key, value, expected
        where = "the rules of alarms" if row is None else f"alarm rule {rule[:40]!r}"
        found = "is missing" if value is None else f"is {str(value)[:60]!r}"
        super().__init__(f"{where}: {key} {found}; it should be {expected}")


class Hours(Struct, frozen=True):
    """The parts of the week in which a rule applies, in minutes since Monday, 00:00."""

    parts: tuple[tuple[int, int], ...] = ()
    """Begin and end of each; an end beyond the week wraps around. Empty means always."""

    def contain(self, weekday: int, minute: int) -> bool:
        """Whether a time is within these hours; ``weekday``: 0 for Monday, ``minute``: since midnight."""
        at = weekday * _DAY_MIN + minute
        return not self.parts or any(begin <= at < end or at + _WEEK_MIN < end for begin, end in self.parts)


def read_hours(text: str) -> Hours:
    """Parse hours. A range over midnight belongs to the day on which it begins.

    Raises ValueError: the text is invalid; the message says what would be right.
    """
    parts = []
    for piece in text.lower().split(",") if text.strip() else ():
        match = _HOURS.fullmatch(piece.strip())
        first, last, begin, end = match.groups() if match is not None else (None,) * 4
        begin_min, end_min = _minutes(begin or "00:00"), _minutes(end or "24:00")
        if not (first or begin) or begin_min in (end_min, _DAY_MIN):
            raise ValueError(_RIGHT_HOURS)
        day = _DAYS.index(first or "mon")
        for number in range((_DAYS.index(last or first or "sun") - day) % 7 + 1):
            start = (day + number) % 7 * _DAY_MIN + begin_min
            parts.append((start, start + ((end_min - begin_min) % _DAY_MIN or _DAY_MIN)))
    return Hours(tuple(parts))


def _minutes(text: str) -> int:
    hours, minutes = text.split(":")
    return 60 * int(hours) + int(minutes)


def check_rules(rules: Sequence[AlarmRule], others: Sequence[AlarmRule] = ()) -> None:
    """Check rules, whose identifiers must not occur in ``others``. Raises BadAlarmRulesError."""
    if len(rules) > MAX_RULES:
        raise BadAlarmRulesError(None, "", "their number", len(rules), f"at most {MAX_RULES}")
    known = {rule.id for rule in others}
    for row, rule in enumerate(rules):
        for key, value, expected in _faults(rule):
            raise BadAlarmRulesError(row, rule.id, key, value, expected)
        if rule.id in known:
            raise BadAlarmRulesError(row, rule.id, "id", rule.id, "one that no other rule of the site has")
        known.add(rule.id)


def _faults(rule: AlarmRule) -> Iterator[tuple[str, object, str]]:
    """Faults of a rule: key, value, and what would be right."""
    if not _ID.fullmatch(rule.id):
        yield "id", rule.id, "1 to 32 letters, digits, dashes and underscores"
    if len(rule.name) > 100 or not rule.name.isprintable():
        yield "name", rule.name, "a line of at most 100 characters"
    yield from _faults_of_kind(rule)
    for key, names in (("tags", rule.tags), ("others", rule.others)):
        if len(names) > _MAX_WHO:
            yield key, f"a list of {len(names)}", f"a list of at most {_MAX_WHO}"
        for name in names:
            if not _ID.fullmatch(name) and not _GROUP.fullmatch(name):
                yield key, name, "a tag's name (1 to 32 letters, digits, - or _), or group:NAME of a group of assets"
    least_s = _SHORTEST_SILENCE_S if rule.kind == "silent" else 0.0
    for key, seconds, low_s in (("after_s", rule.after_s, least_s), ("clear_after_s", rule.clear_after_s, 0.0)):
        if not low_s <= seconds <= _MAX_S:
            yield key, seconds, f"a number of seconds from {low_s:g} to {_MAX_S:.0f}"
    try:
        read_hours(rule.hours)
    except ValueError as error:
        yield "hours", rule.hours, str(error)


def _faults_of_kind(rule: AlarmRule) -> Iterator[tuple[str, object, str]]:
    """Faults in the keys that depend on the rule's kind."""
    keys, plain = KINDS[rule.kind].split(), AlarmRule(rule.id, rule.kind)
    for key in ("tags", "others", "hysteresis", "zone", "limit"):
        value = getattr(rule, key)
        if key not in keys and value != getattr(plain, key):
            yield key, value, f"left out: it has no meaning for the kind {rule.kind}"
    if "zone" in keys and (rule.zone is None or not _ZONE.fullmatch(rule.zone)):
        yield "zone", rule.zone, "the id of a zone"
    if "limit" in keys:
        low, high, right = _LIMITS[rule.kind]
        if rule.limit is None or not low <= rule.limit <= high or (rule.kind == "crowded" and rule.limit % 1):
            yield "limit", rule.limit, right
        if not 0.0 <= rule.hysteresis <= high:
            yield "hysteresis", rule.hysteresis, f"a number from 0 to {high:g}"
