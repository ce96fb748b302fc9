"""Raise and end alarms by a site's rules. No I/O: messages, events and the time are passed in.

1. A rule and a subject (a tag, a pair of tags, a zone or an anchor) have one alarm at a time.
2. An alarm is raised when its condition has held for ``after_s``, and ends when it has not held for ``clear_after_s``.
3. Outside a rule's hours nothing is raised, and active alarms end. ``after_s`` counts from the beginning of the hours.
4. An alarm is kept until it has ended and somebody has acknowledged it. A new occurrence replaces one that has ended.
5. A condition that is unknown changes nothing: silence while messages cannot arrive, a tag outside of a zone that goes
   silent, an anchor that the watch no longer judges. After messages may have been lost, a condition must be seen again
   before it raises an alarm.
6. An alarm states the worst value so far, updated at most once a second, and keeps it when it has ended.
7. All engines at a site get the same input; only the leading one raises alarms. An engine that takes over, or was
   restarted, continues from the kept alarms (``resume``).

Conditions are evaluated five times a second, those on zones also with each zone event: a tag may cross a zone faster.
"""

import math
import time
from collections import defaultdict
from collections.abc import Callable, Container, Iterable, Mapping, Sequence
from itertools import product
from typing import Final, Literal

from msgspec import Struct
from msgspec.structs import replace

from skyless.core.alert import Alert
from skyless.core.site import AlarmRule, RuleKind
from skyless.run.mqtt.messages import AlarmMessage, Asset, FixMessage, TagHealth, Vector, WatchMessage, Zone, ZoneEvent
from skyless.run.site_table import THRESHOLDS, Node, SiteTable
from skyless.run.zones import ZoneMonitor
from skyless.site.alarm_rules import GROUP, read_hours

STOREY_M: Final = 2.5
"""Tags whose heights differ by more than this are on different storeys. Only the horizontal distance counts otherwise:
heights are less accurate, and one tag may be on a helmet and the other on a fork."""

_FARTHEST_M: Final = 1e6
_AROUND: Final = tuple(product((-1, 0, 1), repeat=2))


def near_tags(
    positions_m: Mapping[str, Vector], first: Container[str], others: Container[str], reach_m: float
) -> dict[tuple[str, str], float]:
    """Distances of the pairs within ``reach_m``, one tag from ``first`` and one from ``others``, by sorted names."""
    places = {
        name: (math.floor(x / reach_m), math.floor(y / reach_m))
        for name, (x, y, _) in positions_m.items()
        if abs(x) < _FARTHEST_M and abs(y) < _FARTHEST_M
    }
    cells: defaultdict[tuple[int, int], list[str]] = defaultdict(list)
    for name, place in places.items():
        if name in others:
            cells[place].append(name)
    near = {}
    for name, (i, j) in places.items():
        if name not in first:
            continue
        x, y, z = positions_m[name]
        for di, dj in _AROUND:
            for other in cells.get((i + di, j + dj), ()):
                other_x, other_y, other_z = positions_m[other]
                distance_m = math.hypot(x - other_x, y - other_y)
                if distance_m < reach_m and abs(z - other_z) <= STOREY_M and other != name:
                    near[(name, other) if name < other else (other, name)] = distance_m
    return near


EVALUATION_S: Final = 0.2

SETTLE_S: Final = 0.5
"""A tag counts as outside a zone only after two fixes and this time, because it may be about to be found inside."""

_FORGET_PERIOD_S: Final = 60.0

MAX_KEPT: Final = 2_000
"""Largest number of alarms kept. Beyond it the oldest ended ones are dropped; if none has ended, no more are raised."""

_MAX_NAMED: Final = 20

UPDATE_S: Final = 1.0
"""Interval between updates of the sentences of active alarms."""

_LONGER: Final = 1.1
"""A duration is updated when it has grown by this factor, so that a long stay does not send a message each second."""

_LASTING: Final = frozenset({"inside", "outside", "silent", "anchor-offline"})
"""Kinds of rules whose worst value is the time for which the condition has held."""

What = Literal["raised", "updated", "ended", "acknowledged", "dropped"]
Change = tuple[What, AlarmMessage]
"""A change of an alarm. "updated": the worst value is worse; "dropped": there are too many alarms."""
Key = tuple[str, str]
"""Rule and subject."""


class _Case(Struct):
    """The condition of a rule for one subject."""

    holds: bool
    since_s: float
    known_s: float
    """When the condition was last evaluated with a known result."""
    begin_s: float | None = None
    """When the condition first held; pauses too short to end the alarm do not change it."""
    worst: float | None = None
    """As in ``AlarmMessage``."""

    def add(self, kind: RuleKind, value: float | None) -> None:
        """Include a value in the worst one; None means unknown."""
        if value is not None:
            worse = min if kind in ("near", "battery") else max
            self.worst = value if self.worst is None else worse(self.worst, value)


class Concerned:
    """The tags named in ``tags`` or ``others`` of a rule; all tags if the list is empty."""

    def __init__(self, names: Sequence[str], assets: Mapping[str, Asset]) -> None:
        self.named = {name for name in names if not name.startswith(GROUP)}
        self.named |= {tag for tag, asset in assets.items() if f"{GROUP}{asset.group}" in names}
        """Tags that are expected even if they have never been heard."""
        self._all = not names

    def __contains__(self, tag: object) -> bool:
        return self._all or tag in self.named


class _Rule:
    """A rule, the tags it concerns, and its cases by subject."""

    def __init__(self, rule: AlarmRule, assets: Mapping[str, Asset], before: "_Rule | None") -> None:
        """Take over the cases of ``before`` if it has the same kind and zone."""
        self.rule, self.hours, self.limit = rule, read_hours(rule.hours), rule.limit or 0.0
        self.concerned, self.others = Concerned(rule.tags, assets), Concerned(rule.others, assets)
        self.distances_m: dict[str, float] = {}
        """Distances of near pairs, by subject."""
        self.cases: dict[str, _Case] = {}
        self.is_on: bool | None = None  # unknown before the first evaluation
        self.on_since_s = -math.inf
        if before is not None and before.condition == self.condition:
            self.cases, self.is_on, self.on_since_s = before.cases, before.is_on, before.on_since_s

    @property
    def condition(self) -> tuple[str, str | None]:
        return self.rule.kind, self.rule.zone


class AlarmEngine:
    """The alarms of one site. ``tick`` returns the changes since the last call."""

    def __init__(
        self, monitor: ZoneMonitor, table: SiteTable, local_time: Callable[[float], time.struct_time] = time.localtime
    ) -> None:
        """``monitor`` and ``table`` get the same fixes; the monitor's events are passed in.

        ``local_time`` converts from Unix time.
        """
        self.messages: dict[Key, AlarmMessage] = {}
        """The alarms kept; another engine's while it leads."""
        self.leading = False
        """Whether this engine raises alarms; true from ``resume`` on."""
        self._monitor, self._table, self._local_time = monitor, table, local_time
        self._assets: Mapping[str, Asset] = {}
        self._zones: dict[str, Zone] = {}
        self._members: defaultdict[str, set[str]] = defaultdict(set)
        self._rules: dict[str, _Rule] = {}
        self._zones_s = -math.inf  # when the zones last changed
        self._resumed_s: dict[str, float] = {}  # tags of resumed alarms, and when these were resumed
        self._changed: dict[str, None] = {}  # tags with something new since the last evaluation
        self._anchors: dict[RuleKind, dict[str, str]] = {}
        """Subjects for which a condition on anchors holds, each with a sentence, by kind of rule."""
        self._changes: list[Change] = []
        self._blind_s = self._evaluated_s = self._updated_s = self._forget_due_s = -math.inf
        self._unix_offset_s = math.nan  # until the first tick

    # The site

    @property
    def rules(self) -> tuple[AlarmRule, ...]:
        """The rules in force."""
        return tuple(own.rule for own in self._rules.values())

    def set_rules(self, rules: Iterable[AlarmRule]) -> None:
        """Replace the rules. Alarms continue if the rule keeps its identifier, kind and zone; the others end."""
        self._rules = {rule.id: _Rule(rule, self._assets, self._rules.get(rule.id)) for rule in rules}
        self._evaluate_all()

    def set_assets(self, assets: Mapping[str, Asset]) -> None:
        """Update the names and groups of tags."""
        if assets != self._assets:
            self._assets = assets
            self.set_rules(self.rules)

    def set_zones(self, zones: Iterable[Zone], now_s: float) -> None:
        """Set the zones that the monitor has now. Pass in the monitor's events of this change first."""
        self._zones = {zone.id: zone for zone in zones}
        self._zones_s = now_s
        self._evaluate_all()

    def _evaluate_all(self) -> None:
        self._changed = dict.fromkeys(self._table.all("tag"))
        self._evaluated_s = -math.inf

    # Input

    def on_fix(self, name: str) -> None:
        """Note that the table has a new fix of a tag. Call this before ``on_zone_events`` for the same fix."""
        self._changed[name] = None

    def on_zone_events(self, events: Iterable[ZoneEvent], now_s: float) -> None:
        """Process events of tags entering or leaving zones."""
        for event in events:
            members = self._members[event.zone]
            (members.add if event.kind == "enter" else members.discard)(event.tag)
            for own in self._rules.values():
                if own.rule.zone == event.zone:
                    self._check(own, f"zone-{event.zone}" if own.rule.kind == "crowded" else event.tag, now_s)

    def on_health(self, health: TagHealth) -> None:
        """Note that the table has a tag's health, with the battery's charge."""
        if health.battery_share is not None:
            self._changed[health.tag] = None

    def on_anchors(self, offline: Iterable[str] | None, watch: WatchMessage | None) -> None:
        """Process the list of offline anchors (None if unknown) and the findings of the watch."""
        if offline is not None:
            self._anchors["anchor-offline"] = {f"anchor-{name}": "" for name in sorted(offline)}
        if watch is not None and watch.state == "watching":
            moved = [one for one in watch.findings if one.kind == "moved"]
            self._anchors["anchor-moved"] = {f"anchor-{name}": one.sentence for one in moved for name in one.anchors}

    # Leading, and acknowledgement

    def resume(self, messages: Iterable[AlarmMessage], now_s: float, unix_s: float) -> None:
        """Start leading, continuing with the retained alarms."""
        self.messages = {(one.rule, one.subject): one for one in messages if not is_over(one)}
        self.leading, self._unix_offset_s = True, unix_s - now_s
        for message in self.messages.values():
            own = self._rule_of(message)
            if own is None or message.ended_unix_s is not None:
                continue
            is_new, since_s = message.subject not in own.cases, message.since_unix_s - self._unix_offset_s
            case = own.cases.setdefault(message.subject, _Case(True, since_s, now_s))
            case.begin_s = since_s
            unstated = math.inf if "unknown" in message.sentence else None  # JSON has no infinity
            case.add(message.kind, unstated if message.worst is None else message.worst)
            if is_new:
                self._resumed_s |= dict.fromkeys(message.subject.split("~"), now_s)
        self._evaluate_all()

    @property
    def has_changes(self) -> bool:
        """Whether the next ``tick`` will return changes that have already happened."""
        return bool(self._changes)

    def acknowledge(self, rule: str, subject: str, occurrence: str, by: str, unix_s: float) -> bool:
        """Acknowledge an alarm. Return False if there is no such occurrence or it has already been acknowledged."""
        message = self.messages.get((rule, subject))
        if message is None or message.id != occurrence or message.acknowledged_unix_s is not None:
            return False
        self._keep(replace(message, acknowledged_unix_s=unix_s, acknowledged_by=by), "acknowledged")
        return True

    def tick(self, now_s: float, unix_s: float, *, blind: bool = False) -> list[Change]:
        """Evaluate conditions if due; call this several times a second. ``blind``: messages may be missing."""
        self._unix_offset_s = unix_s - now_s
        if blind or self._blind_s == -math.inf:  # before the first tick messages were missed
            self._blind_s = now_s
        if now_s - self._evaluated_s >= EVALUATION_S:
            self._evaluated_s = now_s
            self._evaluate(now_s)
        changes, self._changes = self._changes, []
        return changes

    # Conditions

    def _evaluate(self, now_s: float) -> None:
        local = self._local_time(now_s + self._unix_offset_s)
        changed, self._changed = self._changed, {}
        for own in self._rules.values():
            is_on = own.hours.contain(local.tm_wday, 60 * local.tm_hour + local.tm_min)
            if is_on and own.is_on is False:
                own.on_since_s = now_s
                for case in own.cases.values():  # values from outside the rule's hours do not count
                    case.begin_s = case.worst = None
            own.is_on = is_on
            for subject in dict.fromkeys((*self._subjects(own, changed, now_s), *own.cases)):
                self._check(own, subject, now_s)
        is_due = now_s - self._updated_s >= UPDATE_S
        self._updated_s = now_s if is_due else self._updated_s
        for message in [one for one in self.messages.values() if self.leading and one.ended_unix_s is None]:
            rule = self._rule_of(message)
            if rule is None or message.subject not in rule.cases:
                self._end(message, now_s)
            elif is_due:
                self._update(message, rule, rule.cases[message.subject].worst)
        self._forget(now_s)

    def _subjects(self, own: _Rule, changed: Iterable[str], now_s: float) -> Iterable[str]:
        """Subjects for which a condition may have begun to hold."""
        match own.rule.kind:
            case "near":
                reach_m = own.limit + own.rule.hysteresis
                there = ((n, tag.fix) for n, tag in self._table.fixed.items() if self._table.is_there(tag, now_s))
                places_m = {name: fix.position_m for name, fix in there if fix is not None}
                near = near_tags(places_m, own.concerned, own.others, reach_m)
                own.distances_m = {"~".join(pair): distance_m for pair, distance_m in near.items()}
                return own.distances_m
            case "crowded":
                return (f"zone-{own.rule.zone}",)
            case "anchor-offline" | "anchor-moved" as kind:
                return self._anchors.get(kind, ())
            case "silent":
                names: Iterable[str] = own.concerned.named if own.rule.tags else self._table.fixed
                return sorted(name for name in names if self._silent_s(name, now_s) >= own.rule.after_s)
        return changed

    def _holds(  # noqa: PLR0911, PLR0912 - some for each kind
        self, own: _Rule, subject: str, now_s: float, *, held: bool
    ) -> bool | None:
        """Whether the condition holds; None if unknown, so that the case stays unchanged."""
        rule, tag, inside = own.rule, self._table.get("tag", subject), self._members[own.rule.zone or ""]
        limit, hysteresis = own.limit, rule.hysteresis if held else 0.0
        if rule.zone is not None and rule.zone not in self._zones:
            return False
        match rule.kind:
            case "near":
                if subject in own.distances_m:
                    return own.distances_m[subject] < limit + hysteresis
                return None if any(self._is_missed(name, now_s) for name in subject.split("~")) else False
            case "crowded":
                return len(self._crowd(own)) > limit - hysteresis or (
                    None if now_s - self._blind_s < THRESHOLDS.grace_s else False
                )
            case "anchor-offline" | "anchor-moved" as kind:
                return subject in self._anchors[kind] if kind in self._anchors else None
        if subject not in own.concerned:
            return False
        is_there = tag is not None and self._table.is_there(tag, now_s)
        is_settled = tag is not None and self._is_settled(tag, now_s)
        match rule.kind:
            case "inside":
                is_unknown = self._is_missed(subject, now_s) or (is_there and not is_settled)
                return subject in inside or (None if is_unknown else False)
            case "outside":
                return False if subject in inside else True if is_there and is_settled else None
            case "silent":
                if self._silent_s(subject, now_s) < rule.after_s:
                    return False
                return None if now_s - self._blind_s < rule.after_s else True
            case "battery":
                share = self._battery(tag)
                return None if share is None else share < limit + hysteresis
            case _:
                level_m = _level_m(tag)
                if level_m is None:
                    return None if self._is_missed(subject, now_s) else False
                return level_m > limit - hysteresis

    def _silent_s(self, name: str, now_s: float) -> float:
        """For how long a tag has had no fix and has not been asleep; infinite before its first one."""
        tag = self._table.get("tag", name)
        return math.inf if tag is None else now_s - max(tag.fix_s, tag.asleep_until_s)

    def _is_settled(self, tag: Node, now_s: float) -> bool:
        """Whether it is known which zones a tag is outside."""
        since_s = max(tag.first_s, self._zones_s)
        return tag.fix_s > since_s and now_s - since_s >= SETTLE_S

    @staticmethod
    def _battery(tag: Node | None) -> float | None:
        health = None if tag is None else tag.health
        return health.battery_share if isinstance(health, TagHealth) else None

    def _is_missed(self, name: str, now_s: float) -> bool:
        """Whether a tag may be present although nothing has been received from it since messages were missed."""
        tag = self._table.get("tag", name)
        if tag is None or tag.fix_s == -math.inf:
            longest_s = self._table.longest_s if name in self._resumed_s else THRESHOLDS.grace_s
            return now_s - self._blind_s < longest_s
        is_unheard = tag.fix_s <= self._blind_s and tag.online is not False
        return is_unheard and now_s - self._blind_s < self._table.gone_after_s(tag)

    def _crowd(self, own: _Rule) -> list[str]:
        return [tag for tag in self._members[own.rule.zone or ""] if tag in own.concerned]

    def _forget(self, now_s: float) -> None:
        if now_s < self._forget_due_s:
            return
        self._forget_due_s = now_s + _FORGET_PERIOD_S
        last_s = now_s - THRESHOLDS.forgotten_s
        self._resumed_s = {name: at_s for name, at_s in self._resumed_s.items() if at_s > last_s}
        for own in self._rules.values():
            if own.rule.kind not in ("crowded", "anchor-offline", "anchor-moved"):
                for subject in list(own.cases):
                    known = (self._table.get("tag", name) or name in self._resumed_s for name in subject.split("~"))
                    if not any(known) and subject not in own.concerned.named:
                        del own.cases[subject]

    # From conditions to alarms

    def _check(self, own: _Rule, subject: str, now_s: float) -> None:
        """Evaluate a condition, and raise or end its alarm if due."""
        rule, case = own.rule, own.cases.get(subject)
        holds = self._holds(own, subject, now_s, held=case is not None and case.holds)
        if case is None:
            if not holds:
                return
            case = own.cases[subject] = _Case(False, now_s, now_s)
        if holds is not None:
            case.known_s = now_s
            if holds != case.holds:
                is_silent = holds and rule.kind == "silent"
                since_s = max(now_s - self._silent_s(subject, now_s), self._blind_s) if is_silent else now_s
                case.holds, case.since_s = holds, since_s
        message = self.messages.get((rule.id, subject))
        is_active = self.leading and message is not None and message.ended_unix_s is None
        if case.holds and own.is_on is not False:
            case.begin_s = case.since_s if case.begin_s is None else case.begin_s
            case.add(rule.kind, self._value(own, subject, now_s - case.begin_s))
        if message is not None and is_active:
            if own.is_on is False or (not case.holds and now_s - case.since_s >= rule.clear_after_s):
                sentence = self._sentence(own, subject, case.worst, "ended") or message.sentence
                self._end(replace(message, sentence=sentence, worst=case.worst), now_s)
                is_active = False
        elif case.holds and self.leading and own.is_on and case.known_s >= self._blind_s:
            lasted_s = now_s - max(case.since_s, own.on_since_s)
            if lasted_s >= rule.after_s:
                self._raise(own, subject, case, now_s)
        if not case.holds and not is_active:
            del own.cases[subject]

    def _rule_of(self, message: AlarmMessage) -> _Rule | None:
        own = self._rules.get(message.rule)
        return own if own is not None and own.condition == (message.kind, message.zone) else None

    def _raise(self, own: _Rule, subject: str, case: _Case, now_s: float) -> None:
        rule, unix_s = own.rule, now_s + self._unix_offset_s
        if (rule.id, subject) not in self.messages and not self._make_room():
            return
        is_of_tags = rule.kind not in ("crowded", "anchor-offline", "anchor-moved")
        tags = tuple(subject.split("~") if is_of_tags else sorted(self._crowd(own)))
        first = self._table.get("tag", tags[0]) if is_of_tags else None
        fix = None if first is None else first.fix
        message = AlarmMessage(
            id=f"{rule.id}/{subject}/{round(1000.0 * unix_s)}",
            rule=rule.id,
            name=rule.name or rule.id,
            kind=rule.kind,
            severity=rule.severity,
            subject=subject,
            since_unix_s=case.since_s + self._unix_offset_s,
            unix_s=unix_s,
            sentence=self._sentence(own, subject, case.worst, "raised"),
            tags=tags[:_MAX_NAMED],
            zone=rule.zone,
            place=self._place(tags[0], fix) if is_of_tags else self._zone_name(rule.zone),
            position_m=None if fix is None else fix.position_m,
            worst=case.worst,
        )
        self._keep(message, "raised")

    def _update(self, message: AlarmMessage, own: _Rule, worst: float | None) -> None:
        is_longer = worst is not None and worst >= _LONGER * (message.worst or 0.0) + UPDATE_S
        if is_longer if own.rule.kind in _LASTING else worst != message.worst or own.rule.kind == "anchor-moved":
            sentence = self._sentence(own, message.subject, worst, "updated") or message.sentence
            if sentence != message.sentence:
                self._keep(replace(message, sentence=sentence, worst=worst), "updated")

    def _value(self, own: _Rule, subject: str, held_s: float) -> float | None:
        """The value to report as ``AlarmMessage.worst``; None if it is unknown."""
        match own.rule.kind:
            case "near":
                return own.distances_m.get(subject)
            case "crowded":
                return float(len(self._crowd(own)))
            case "battery":
                return self._battery(self._table.get("tag", subject))
            case "protection-level":
                return _level_m(self._table.get("tag", subject))
            case "anchor-moved":
                return None
        return max(own.rule.after_s, held_s)

    def _make_room(self) -> bool:
        if len(self.messages) < MAX_KEPT:
            return True
        ended = [one for one in self.messages.values() if one.ended_unix_s is not None]
        if ended:
            oldest = min(ended, key=lambda one: one.unix_s)
            del self.messages[oldest.rule, oldest.subject]
            self._changes.append(("dropped", oldest))
        return bool(ended)

    def _keep(self, message: AlarmMessage, what: What) -> None:
        """Store an alarm, and report the change if leading; otherwise the leading engine reports it."""
        self.messages[message.rule, message.subject] = message
        if self.leading:
            self._changes.append((what, message))
            if is_over(message):
                del self.messages[message.rule, message.subject]

    def _end(self, message: AlarmMessage, now_s: float) -> None:
        self._keep(replace(message, ended_unix_s=now_s + self._unix_offset_s), "ended")

    # Sentences

    def _who(self, tag: str) -> str:
        name = self._assets[tag].name if tag in self._assets else ""
        return f"{name} ({tag})" if name and name != tag else tag

    def _zone_name(self, zone: str | None) -> str:
        return (self._zones[zone].name or zone) if zone in self._zones else zone or ""

    def _place(self, tag: str, fix: FixMessage | None) -> str:
        names = [zone.name or zone.id for zone in self._monitor.zones_with(tag)]
        return ", ".join(names) or ("" if fix is None else "at x {:.1f}, y {:.1f} m".format(*fix.position_m))

    def _sentence(self, own: _Rule, subject: str, worst: float | None, what: What) -> str:
        """The sentence of an alarm; empty if its value is no longer known."""
        rule, limit, zone = own.rule, own.limit, self._zone_name(own.rule.zone)
        if worst is None and what != "raised" and rule.kind != "anchor-moved":
            return ""
        who = " and ".join(map(self._who, subject.split("~")))
        anchor, was = subject.replace("-", " "), what != "raised"
        value, least, most = worst or 0.0, " at the least" if was else "", " at the most" if was else ""
        lasting = f" for {_span(value)}" if value >= 1.0 and rule.kind in _LASTING else ""
        be = "was" if what == "ended" else "has been" if lasting else "is"
        was_or_is = "was" if was else "is"
        be_not = "has not been" if be == "has been" else f"{be} not"
        level = "unknown" if worst is None or worst == math.inf else f"{worst:.2f} m{most}"
        moved = self._anchors.get("anchor-moved", {}).get(subject)
        moved = moved if moved or was else f"{anchor} has moved"
        return {
            "inside": f"{who} {be} in {zone}{lasting}",
            "outside": f"{who} {be_not} in {zone}{lasting}",
            "silent": f"{who} {'' if what == 'ended' else 'has '}sent no fixes{lasting}",
            "near": f"{who} {'were' if was else 'are'} {value:.1f} m apart{least}; at least {limit:g} m is right",
            "crowded": f"{value:.0f} tags {'were' if was else 'are'} in {zone}{most}; at most {limit:g} are allowed",
            "anchor-offline": f"{anchor} {be} offline{lasting}",
            "anchor-moved": (moved or "").rstrip("."),
            "battery": f"the battery of {who} {was_or_is} at {value:.0%}{least}; {limit:.0%} is the least",
            "protection-level": f"the protection level of {who} {was_or_is} {level}; at most {limit:g} m is allowed",
        }[rule.kind]


def is_over(message: AlarmMessage) -> bool:
    """Whether an alarm has ended and been acknowledged, so that it is no longer kept."""
    return message.ended_unix_s is not None and message.acknowledged_unix_s is not None


def _level_m(tag: Node | None) -> float | None:
    """Horizontal protection level in m; infinite if none can be computed, None if the method has none."""
    fix = None if tag is None else tag.fix
    if fix is None or fix.hpl_m is not None:
        return None if fix is None else fix.hpl_m
    return math.inf if fix.alert in (Alert.UNAVAILABLE, Alert.NOT_EXCLUDED) else None


def _span(seconds: float) -> str:
    if seconds < 120.0:
        return f"{seconds:.0f} s"
    return f"{seconds / 60.0:.0f} min" if seconds < 7200.0 else f"{seconds / 3600.0:.1f} h"
