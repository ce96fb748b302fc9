"""Raises and ends alarms by a site's rules. No I/O: what happens and the time are passed in.

1. A rule and a subject (a tag, a pair of tags, a zone or an anchor) have one alarm at a time.
2. An alarm is raised when its condition has held for ``after_s``, and ends when it has not held for ``clear_after_s``.
3. Outside a rule's hours nothing is raised, and an active alarm ends with them. ``after_s`` counts from their begin.
4. An alarm is kept until it has ended and somebody has acknowledged it. Another occurrence replaces one that has ended.
5. What is not known changes nothing: silence while messages cannot arrive, a tag outside of a zone that goes silent, an
   anchor that the watch no longer judges.
6. Of several engines at a site, all are given what happens, and one that leads raises alarms. Another one, or one that
   was started again, goes on from the kept alarms (``resume``).
"""

import math
import time
from collections.abc import Callable, Iterable, Mapping, Set
from typing import Final, Literal

from msgspec.structs import replace

from skyless.core.alarm_rule import AlarmRule
from skyless.core.alert import Alert
from skyless.run.alarms.near import NearTags
from skyless.run.alarms.rules import Concerned
from skyless.run.mqtt.messages import AlarmMessage, Asset, FixMessage, TagHealth, WatchMessage, Zone, ZoneEvent
from skyless.run.zones.monitor import TAG_TIMEOUT_S, ZoneMonitor
from skyless.site.alarm_rules import read_hours

EVALUATION_S: Final = 0.2
"""Interval at which distances, protection levels and silences are evaluated, with each tag's newest fix."""

CONFIRM_S: Final = 5.0
"""An alarm that was resumed and whose condition has not been seen for this long since ends."""

SETTLE_S: Final = 0.5
"""A tag is not outside a zone before two fixes and this long: it may be about to be found in it."""

FORGET_S: Final = 86_400.0
"""A tag that no rule names is forgotten after this long without a fix."""

MAX_KEPT: Final = 2_000
"""Alarms that are kept. Beyond it the oldest that have ended go, and where none has, no more are raised."""

_MAX_NAMED: Final = 20
_CONFIRMED: Final = frozenset({"inside", "near", "crowded", "protection-level"})
"""Kinds whose condition shows within ``CONFIRM_S`` where it holds. The others hold until there is a sign against it."""

Change = tuple[Literal["raised", "ended", "acknowledged", "dropped"], AlarmMessage]
"""What has become of an alarm. A dropped one is not kept any longer, as there are too many."""
Key = tuple[str, str]
"""Rule and subject."""


class _Tag:
    """What is known of a tag."""

    __slots__ = ("battery", "first_s", "fix", "fixes", "gone", "moved", "seen_s", "settled", "zones")

    def __init__(self, now_s: float) -> None:
        self.fix: FixMessage | None = None
        self.seen_s, self.first_s = -math.inf, now_s  # when the newest fix came, and the first one without a gap
        self.fixes = 0  # since then
        self.settled = self.moved = False
        self.gone = True  # until its next fix
        self.zones: set[str] = set()
        self.battery: float | None = None


class _Case:
    """The condition of a rule for one subject."""

    __slots__ = ("deadline_s", "holds", "rule", "since_s", "subject")

    def __init__(self, rule: "_Rule", subject: str) -> None:
        self.rule, self.subject = rule, subject
        self.holds, self.since_s = False, -math.inf
        self.deadline_s: float | None = None  # when it ends unless it is confirmed; None where it is


class _Rule:
    """A rule, whom it concerns, and its cases."""

    def __init__(self, rule: AlarmRule, assets: Mapping[str, Asset]) -> None:
        self.rule, self.hours = rule, read_hours(rule.hours)
        self.is_on, self.on_since_s = True, -math.inf
        self.cases: dict[str, _Case] = {}
        self.near: NearTags | None = None
        self.set_assets(assets)

    def set_assets(self, assets: Mapping[str, Asset]) -> None:
        rule = self.rule
        self.concerned = Concerned(rule.tags, assets)
        if rule.kind == "near" and rule.limit is not None:
            self.near = NearTags(rule.limit, rule.hysteresis, self.concerned, Concerned(rule.others, assets))


class AlarmEngine:
    """The alarms of one site. What changes is returned by the next ``tick``."""

    def __init__(self, monitor: ZoneMonitor, local_time: Callable[[float], time.struct_time] = time.localtime) -> None:
        """``monitor`` is given the same fixes, and its events come here. ``local_time`` turns Unix time into hours."""
        self.messages: dict[Key, AlarmMessage] = {}
        """The alarms that are kept."""
        self.leading = False
        """Whether it raises alarms: from ``resume`` until ``rest``."""
        self.not_raised = 0
        """Alarms that were not raised, as too many are active."""
        self._monitor, self._local_time = monitor, local_time
        self._assets: Mapping[str, Asset] = {}
        self._zones: dict[str, Zone] = {}
        self._members: dict[str, set[str]] = {}
        self._rules: dict[str, _Rule] = {}
        self._by_kind: dict[str, list[_Rule]] = {}
        self._tags: dict[str, _Tag] = {}
        self._moved: list[str] = []
        self._unsettled: set[str] = set()
        self._silent: set[str] = set()  # tags with a silence that holds
        self._offline: frozenset[str] = frozenset()
        self._displaced: dict[str, str] = {}  # anchors that have moved, and the watch's sentence
        self._pending: dict[_Case, None] = {}
        self._changes: list[Change] = []
        self._begin_s = math.inf
        self._blind_s = self._evaluated_s = self._forgot_s = self._hours_s = -math.inf
        self._resync_s: float | None = None  # when zones are compared with the monitor's again

    # What the site is

    @property
    def rules(self) -> tuple[AlarmRule, ...]:
        """The rules in force."""
        return tuple(own.rule for own in self._rules.values())

    def set_rules(self, rules: Iterable[AlarmRule], now_s: float, unix_s: float) -> None:
        """Replace the rules. Alarms go on where the rule has the same identifier, kind and zone; the others end."""
        before, self._rules = self._rules, {}
        for rule in rules:
            old = before.pop(rule.id, None)
            if old is not None and old.rule == rule:
                self._rules[rule.id] = old
                continue
            own = self._rules[rule.id] = _Rule(rule, self._assets)
            own.is_on = self._is_within(own, unix_s)
            if old is None:
                continue
            if (old.rule.kind, old.rule.zone) != (rule.kind, rule.zone):
                before[rule.id] = old
                continue
            own.cases = old.cases
            for case in own.cases.values():
                case.rule = own
        for old in before.values():
            for case in old.cases.values():
                self._pending.pop(case, None)
            self._end_all(old.rule.id, unix_s)
        self._by_kind = {}
        for own in self._rules.values():
            self._by_kind.setdefault(own.rule.kind, []).append(own)
            self._refresh(own, now_s, unix_s)

    def set_assets(self, assets: Mapping[str, Asset], now_s: float, unix_s: float) -> None:
        """Update the names and groups of tags."""
        if assets == self._assets:
            return
        self._assets = dict(assets)
        for own in self._rules.values():
            own.set_assets(self._assets)
            self._refresh(own, now_s, unix_s)

    def set_zones(self, zones: Iterable[Zone], now_s: float, unix_s: float) -> None:
        """The monitor has these zones now. Its events of the change come first."""
        self._zones = {zone.id: zone for zone in zones}
        self._members = {zone: self._members.get(zone, set()) for zone in self._zones}
        for name, tag in self._tags.items():
            tag.zones &= self._zones.keys()
            self._unsettle(name, tag, now_s)
        for own in (*self._of("inside"), *self._of("outside"), *self._of("crowded")):
            self._refresh(own, now_s, unix_s)

    # What happens

    def on_fix(self, fix: FixMessage, now_s: float, unix_s: float) -> None:
        """A fix of a tag; to be called before the events that the monitor finds with it."""
        name = fix.tag
        tag = self._tags.get(name)
        if tag is None:
            tag = self._tags[name] = _Tag(now_s)
        if tag.gone or now_s - tag.seen_s >= TAG_TIMEOUT_S:
            self._unsettle(name, tag, now_s)
        tag.fix, tag.seen_s, tag.gone = fix, now_s, False
        tag.fixes += 1
        if not tag.moved:
            tag.moved = True
            self._moved.append(name)
        if name in self._silent:
            self._silent.discard(name)
            for own in self._of("silent"):
                self._set(own, name, False, now_s, unix_s)

    def on_zone_events(self, events: Iterable[ZoneEvent], now_s: float, unix_s: float) -> None:
        """Tags have entered or left zones."""
        for event in events:
            tag = self._tags.get(event.tag)
            if tag is None:
                tag = self._tags[event.tag] = _Tag(now_s)
            entered = event.kind == "enter"
            if not entered and self._resync_s is not None and now_s - tag.seen_s >= TAG_TIMEOUT_S:
                continue  # its fixes could not arrive, so that nobody knows where it is
            (tag.zones.add if entered else tag.zones.discard)(event.zone)
            members = self._members.setdefault(event.zone, set())
            (members.add if entered else members.discard)(event.tag)
            for kind, subject in (("inside", event.tag), ("outside", event.tag), ("crowded", f"zone-{event.zone}")):
                for own in self._of(kind):
                    if own.rule.zone == event.zone:
                        self._update(own, subject, now_s, unix_s)

    def on_tag_gone(self, name: str) -> None:
        """A tag's program has ended; to be called before the monitor's events: nobody knows where the tag is."""
        if name in self._tags:
            self._tags[name].gone, self._tags[name].settled = True, False
            self._unsettled.discard(name)

    def on_health(self, health: TagHealth, now_s: float, unix_s: float) -> None:
        """A tag's health, with what is left in its battery."""
        if health.battery_share is not None and self._of("battery"):
            self._tags.setdefault(health.tag, _Tag(now_s)).battery = health.battery_share
            for own in self._of("battery"):
                self._update(own, health.tag, now_s, unix_s)

    def on_anchors(
        self, offline: Iterable[str] | None, watch: WatchMessage | None, now_s: float, unix_s: float
    ) -> None:
        """The anchors that are offline, None where that is not known, and what their watch has found."""
        if offline is not None:
            self._offline = frozenset(offline)
            self._set_anchors("anchor-offline", self._offline, now_s, unix_s)
        if watch is not None and watch.state == "watching":
            moved = {
                str(anchor): one.sentence for one in watch.findings if one.kind == "moved" for anchor in one.anchors
            }
            self._displaced = moved
            self._set_anchors("anchor-moved", moved.keys(), now_s, unix_s)

    def _set_anchors(self, kind: str, names: Set[str], now_s: float, unix_s: float) -> None:
        for own in self._of(kind):
            for subject in sorted(own.cases.keys() | {f"anchor-{name}" for name in names}):
                self._set(own, subject, subject.removeprefix("anchor-") in names, now_s, unix_s)

    # Leading, and what people do

    def resume(self, messages: Iterable[AlarmMessage], now_s: float, unix_s: float) -> None:
        """Lead from now on, with the alarms that are kept."""
        self.messages = {(one.rule, one.subject): one for one in messages if not is_over(one)}
        self.leading = True
        for message in tuple(self.messages.values()):
            if message.ended_unix_s is None:
                self._take_over(message, now_s, unix_s)
        if self._resync_s is not None:  # a tag may have left a zone unnoticed
            for own in (*self._of("inside"), *self._of("outside"), *self._of("crowded")):
                for subject, case in own.cases.items():
                    if case.holds and case.deadline_s is None and not self._is_active((own.rule.id, subject)):
                        case.deadline_s = now_s + CONFIRM_S
        else:
            for own in self._rules.values():
                self._refresh(own, now_s, unix_s)
        for own in self._rules.values():
            for case in tuple(own.cases.values()):
                self._advance(case, now_s, unix_s)

    def _take_over(self, message: AlarmMessage, now_s: float, unix_s: float) -> None:
        """An active alarm: of its condition there may have been no sign yet."""
        own = self._rules.get(message.rule)
        if own is None or not own.is_on or (own.rule.kind, own.rule.zone) != (message.kind, message.zone):
            self._end((message.rule, message.subject), unix_s)
        elif message.subject not in own.cases:
            case = own.cases[message.subject] = _Case(own, message.subject)
            case.holds, case.since_s = True, now_s - (unix_s - message.since_unix_s)
            case.deadline_s = now_s + CONFIRM_S if message.kind in _CONFIRMED else math.inf
            if message.kind == "silent":
                self._silent.add(message.subject)

    def rest(self) -> None:
        """Another one leads: raise nothing from now on."""
        self.leading = False

    def acknowledge(self, rule: str, subject: str, occurrence: str, by: str, unix_s: float) -> bool:
        """Somebody has seen an alarm. False where there is no such occurrence, or somebody has seen it before."""
        message = self.messages.get((rule, subject))
        if message is None or message.id != occurrence or message.acknowledged_unix_s is not None:
            return False
        self._keep(replace(message, acknowledged_unix_s=unix_s, acknowledged_by=by), "acknowledged")
        return True

    def tick(self, now_s: float, unix_s: float, *, blind: bool = False) -> list[Change]:
        """Do what is due, several times a second. ``blind``: messages may be missing, so that silence means nothing."""
        self._begin_s = min(self._begin_s, now_s)
        if blind:
            self._blind_s, self._resync_s = now_s, now_s + CONFIRM_S
        elif self._resync_s is not None and now_s >= self._resync_s:
            self._resync_s = None
            self._compare_zones(now_s, unix_s)
        if now_s - self._hours_s >= 1.0:
            self._hours_s = now_s
            self._check_hours(now_s, unix_s)
        if now_s - self._evaluated_s >= EVALUATION_S:
            self._evaluated_s = now_s
            self._evaluate(now_s, unix_s)
        for case in tuple(self._pending):
            self._advance(case, now_s, unix_s)
        changes, self._changes = self._changes, []
        return changes

    # Conditions

    def _of(self, kind: str) -> list[_Rule]:
        return self._by_kind.get(kind, [])

    def _unsettle(self, name: str, tag: _Tag, now_s: float) -> None:
        tag.first_s, tag.fixes, tag.settled = now_s, 0, False
        self._unsettled.add(name)

    def _is_fresh(self, name: str, now_s: float) -> bool:
        tag = self._tags.get(name)
        return tag is not None and not tag.gone and now_s - max(tag.seen_s, self._blind_s) < TAG_TIMEOUT_S

    def _state(  # noqa: PLR0911, PLR0912 - some for each kind
        self, own: _Rule, subject: str, now_s: float
    ) -> bool | None:
        """Whether the condition holds; None where that is not known, so that it stays as it was."""
        rule, tag, case = own.rule, self._tags.get(subject), own.cases.get(subject)
        confirmed = case is None or case.deadline_s is None
        match rule.kind:
            case "near":
                pair = subject.partition("~")
                if own.near is not None and (pair[0], pair[2]) in own.near.distances_m:
                    return True
                return False if self._is_fresh(pair[0], now_s) and self._is_fresh(pair[2], now_s) else None
            case "crowded":
                return self._is_crowded(own, was=case is not None and case.holds) or (False if confirmed else None)
            case "anchor-offline":
                return True if subject.removeprefix("anchor-") in self._offline else None
            case "anchor-moved":
                return True if subject.removeprefix("anchor-") in self._displaced else None
        if subject not in own.concerned or (rule.zone is not None and rule.zone not in self._zones and confirmed):
            return False
        if tag is None:
            return None
        held = case is not None and case.holds
        match rule.kind:
            case "inside":
                return True if rule.zone in tag.zones else False if tag.settled or confirmed else None
            case "outside":
                if rule.zone in tag.zones:
                    return False
                return True if tag.settled and rule.zone in self._zones and self._is_fresh(subject, now_s) else None
            case "silent":
                return False if self._is_fresh(subject, now_s) and subject not in self._silent else None
            case "battery":
                return None if tag.battery is None else tag.battery < _limit(rule, held, 1.0)
            case _:
                level_m = _level_m(tag.fix)
                return None if level_m is None else level_m > _limit(rule, held, -1.0)

    def _is_crowded(self, own: _Rule, *, was: bool) -> bool:
        tags = self._members.get(own.rule.zone or "", ())
        return sum(tag in own.concerned for tag in tags) > _limit(own.rule, was, -1.0)

    def _update(self, own: _Rule, subject: str, now_s: float, unix_s: float) -> None:
        state = self._state(own, subject, now_s)
        if state is not None:
            self._set(own, subject, state, now_s, unix_s)

    def _refresh(self, own: _Rule, now_s: float, unix_s: float) -> None:
        """Look again at all that a rule may concern."""
        if own.near is not None:
            for name, tag in self._tags.items():
                if tag.fix is not None and self._is_fresh(name, now_s):
                    own.near.move(name, tag.fix.position_m)
        subjects: Iterable[str]
        match own.rule.kind:
            case "near":
                subjects = ["~".join(pair) for pair in own.near.distances_m] if own.near is not None else ()
            case "crowded":
                subjects = (f"zone-{own.rule.zone}",)
            case "anchor-offline":
                subjects = [f"anchor-{name}" for name in self._offline]
            case "anchor-moved":
                subjects = [f"anchor-{name}" for name in self._displaced]
            case _:
                subjects = [name for name in self._tags if name in own.concerned]
        for subject in dict.fromkeys((*subjects, *own.cases)):
            self._update(own, subject, now_s, unix_s)
        for case in tuple(own.cases.values()):
            self._advance(case, now_s, unix_s)

    def _evaluate(self, now_s: float, unix_s: float) -> None:
        moved, self._moved = self._moved, []
        near, levels = self._of("near"), self._of("protection-level")
        for name in moved:
            tag = self._tags.get(name)
            if tag is None or tag.fix is None:
                continue
            tag.moved = False
            for own in near:
                if own.near is not None:
                    self._set_pairs(own, *own.near.move(name, tag.fix.position_m), now_s, unix_s)
            for own in levels:
                self._update(own, name, now_s, unix_s)
        for own in near:
            for name in own.near.names if own.near is not None else ():
                if own.near is not None and not self._is_fresh(name, now_s):
                    self._set_pairs(own, [], own.near.remove(name), now_s, unix_s)
        self._settle(now_s, unix_s)
        for own in self._of("silent"):
            if own.is_on:
                self._find_silent(own, now_s, unix_s)
        if now_s - self._forgot_s >= 60.0:
            self._forgot_s = now_s
            self._forget(now_s, unix_s)

    def _settle(self, now_s: float, unix_s: float) -> None:
        """Decide on which side of the zones new tags are."""
        for name in tuple(self._unsettled):
            tag = self._tags[name]
            if tag.fixes >= 2 and now_s - tag.first_s >= SETTLE_S:
                self._unsettled.discard(name)
                tag.settled = True
                for own in (*self._of("inside"), *self._of("outside")):
                    self._update(own, name, now_s, unix_s)

    def _set_pairs(
        self, own: _Rule, began: list[tuple[str, str]], ended: list[tuple[str, str]], now_s: float, unix_s: float
    ) -> None:
        for pairs, holds in ((began, True), (ended, False)):
            for pair in pairs:
                self._set(own, "~".join(pair), holds, now_s, unix_s)

    def _find_silent(self, own: _Rule, now_s: float, unix_s: float) -> None:
        least_s = max(self._begin_s, self._blind_s, own.on_since_s)
        if now_s - least_s < own.rule.after_s:
            return
        for name in own.concerned.named if own.rule.tags else self._tags:
            tag = self._tags.get(name)
            heard_s = least_s if tag is None else max(tag.seen_s, least_s)
            if now_s - heard_s >= own.rule.after_s:
                case = own.cases.get(name)
                if case is None or not case.holds or case.deadline_s is not None:
                    self._silent.add(name)
                    self._set(own, name, True, now_s, unix_s, heard_s)

    def _forget(self, now_s: float, unix_s: float) -> None:
        named = {name for own in self._of("silent") for name in own.concerned.named}
        for name in [n for n, tag in self._tags.items() if now_s - max(tag.seen_s, tag.first_s) > FORGET_S]:
            if name not in named:
                del self._tags[name]
                self._silent.discard(name)
                self._unsettled.discard(name)
                for own in self._rules.values():
                    self._set(own, name, False, now_s, unix_s)

    def _compare_zones(self, now_s: float, unix_s: float) -> None:
        """Take over the monitor's zones of all tags."""
        self._members = {zone: set() for zone in self._zones}
        for name, tag in self._tags.items():
            tag.zones = {zone.id for zone in self._monitor.zones_with(name)}
            for zone in tag.zones:
                self._members.setdefault(zone, set()).add(name)
        for own in (*self._of("inside"), *self._of("outside"), *self._of("crowded")):
            self._refresh(own, now_s, unix_s)

    # Hours

    def _is_within(self, own: _Rule, unix_s: float) -> bool:
        if not own.hours.parts:
            return True
        at = self._local_time(unix_s)
        return own.hours.contain(at.tm_wday, 60 * at.tm_hour + at.tm_min)

    def _check_hours(self, now_s: float, unix_s: float) -> None:
        for own in self._rules.values():
            is_on = self._is_within(own, unix_s)
            if is_on == own.is_on:
                continue
            own.is_on, own.on_since_s = is_on, now_s
            if not is_on:
                self._end_all(own.rule.id, unix_s)
                continue
            for case in tuple(own.cases.values()):
                self._advance(case, now_s, unix_s)

    # From conditions to alarms

    def _set(
        self, own: _Rule, subject: str, holds: bool, now_s: float, unix_s: float, since_s: float | None = None
    ) -> None:
        """The condition holds, or not."""
        case = own.cases.get(subject)
        if case is None:
            if not holds:
                return
            case = own.cases[subject] = _Case(own, subject)
        elif case.deadline_s is None and case.holds == holds:
            return
        case.deadline_s = None
        if case.holds != holds:
            case.holds, case.since_s = holds, now_s if since_s is None else since_s
        self._advance(case, now_s, unix_s)

    def _advance(self, case: _Case, now_s: float, unix_s: float) -> None:
        """Raise or end an alarm whose time has come, or wait for it."""
        own, rule = case.rule, case.rule.rule
        self._pending.pop(case, None)
        if case.deadline_s is not None:
            if now_s < max(case.deadline_s, self._blind_s + CONFIRM_S):
                if case.deadline_s < math.inf:
                    self._pending[case] = None
                return
            case.holds, case.since_s, case.deadline_s = False, now_s, None
        is_active = self._is_active((rule.id, case.subject))
        if case.holds and not is_active and own.is_on:
            due = now_s - max(case.since_s, own.on_since_s) >= rule.after_s
            if self.leading and not (due and self._raise(case, now_s, unix_s)):
                self._pending[case] = None
        elif not case.holds and is_active and now_s - case.since_s < rule.clear_after_s:
            self._pending[case] = None
        elif not case.holds:
            if is_active:
                self._end((rule.id, case.subject), unix_s)
            own.cases.pop(case.subject, None)

    def _is_active(self, key: Key) -> bool:
        return self.leading and key in self.messages and self.messages[key].ended_unix_s is None

    def _raise(self, case: _Case, now_s: float, unix_s: float) -> bool:
        """Whether there was room for it."""
        rule, subject = case.rule.rule, case.subject
        key = rule.id, subject
        if key not in self.messages and not self._make_room():
            self.not_raised += 1
            return False
        tags = self._tags_of(case)
        fix = self._tags[tags[0]].fix if tags and tags[0] in self._tags else None
        message = AlarmMessage(
            id=f"{rule.id}/{subject}/{round(1000.0 * unix_s)}",
            rule=rule.id,
            name=rule.name or rule.id,
            kind=rule.kind,
            severity=rule.severity,
            subject=subject,
            since_unix_s=unix_s - (now_s - case.since_s),
            unix_s=unix_s,
            sentence=self._sentence(case, now_s),
            tags=tags[:_MAX_NAMED],
            zone=rule.zone,
            place=self._place(tags[0], fix) if tags and rule.kind != "crowded" else self._zone_name(rule.zone),
            position_m=None if fix is None or rule.kind == "crowded" else fix.position_m,
        )
        self._keep(message, "raised")
        return True

    def _make_room(self) -> bool:
        if len(self.messages) < MAX_KEPT:
            return True
        ended = [one for one in self.messages.values() if one.ended_unix_s is not None]
        if ended:
            oldest = min(ended, key=lambda one: one.unix_s)
            del self.messages[oldest.rule, oldest.subject]
            self._changes.append(("dropped", oldest))
        return bool(ended)

    def _keep(self, message: AlarmMessage, what: Literal["raised", "ended", "acknowledged"]) -> None:
        key = message.rule, message.subject
        if is_over(message):
            self.messages.pop(key, None)
        else:
            self.messages[key] = message
        self._changes.append((what, message))

    def _end(self, key: Key, unix_s: float) -> None:
        self._keep(replace(self.messages[key], ended_unix_s=unix_s), "ended")

    def _end_all(self, rule: str, unix_s: float) -> None:
        """End all active alarms of a rule."""
        for key, message in tuple(self.messages.items()):
            if self.leading and key[0] == rule and message.ended_unix_s is None:
                self._end(key, unix_s)

    # Words

    def _tags_of(self, case: _Case) -> tuple[str, ...]:
        match case.rule.rule.kind:
            case "near":
                return tuple(case.subject.split("~"))
            case "crowded":
                members = self._members.get(case.rule.rule.zone or "", ())
                return tuple(sorted(tag for tag in members if tag in case.rule.concerned))
            case "anchor-offline" | "anchor-moved":
                return ()
        return (case.subject,)

    def _who(self, tag: str) -> str:
        name = self._assets[tag].name if tag in self._assets else ""
        return f"{name} ({tag})" if name and name != tag else tag

    def _zone_name(self, zone: str | None) -> str:
        return (self._zones[zone].name or zone) if zone in self._zones else zone or ""

    def _place(self, tag: str, fix: FixMessage | None) -> str:
        names = [zone.name or zone.id for zone in self._monitor.zones_with(tag)]
        return ", ".join(names) or ("" if fix is None else "at x {:.1f}, y {:.1f} m".format(*fix.position_m))

    def _sentence(self, case: _Case, now_s: float) -> str:  # noqa: PLR0911 - one for each kind
        rule, subject, limit = case.rule.rule, case.subject, case.rule.rule.limit or 0.0
        tag = self._tags.get(subject)
        zone = self._zone_name(rule.zone)
        lasting = f" for {_span(max(rule.after_s, now_s - case.since_s))}" if rule.after_s >= 1.0 else ""
        anchor = subject.replace("-", " ", 1)
        match rule.kind:
            case "inside":
                return f"{self._who(subject)} {'has been' if lasting else 'is'} in {zone}{lasting}"
            case "outside":
                return f"{self._who(subject)} {'has not been' if lasting else 'is not'} in {zone}{lasting}"
            case "silent":
                return f"{self._who(subject)} has sent no fixes{lasting}"
            case "near":
                one, _, other = subject.partition("~")
                distances_m = case.rule.near.distances_m if case.rule.near is not None else {}
                apart = f"{distances_m.get((one, other), limit):.1f} m apart"
                return f"{self._who(one)} and {self._who(other)} are {apart}; at least {limit:g} m is right"
            case "crowded":
                return f"{len(self._tags_of(case))} tags are in {zone}; at most {limit:g} are allowed"
            case "anchor-offline":
                return f"{anchor} {'has been' if lasting else 'is'} offline{lasting}"
            case "anchor-moved":
                return self._displaced.get(subject.removeprefix("anchor-"), f"{anchor} has moved").rstrip(".")
            case "battery":
                share = 0.0 if tag is None or tag.battery is None else tag.battery
                return f"the battery of {self._who(subject)} is at {share:.0%}; {limit:.0%} is the least"
            case _:
                level_m = _level_m(None if tag is None else tag.fix)
                level = "unknown" if level_m is None or level_m == math.inf else f"{level_m:.2f} m"
                return f"the protection level of {self._who(subject)} is {level}; at most {limit:g} m is allowed"


def is_over(message: AlarmMessage) -> bool:
    """Whether an alarm has ended and somebody has acknowledged it, so that it is not kept any longer."""
    return message.ended_unix_s is not None and message.acknowledged_unix_s is not None


def _limit(rule: AlarmRule, held: bool, outward: float) -> float:
    """The limit, farther by the hysteresis while the condition holds."""
    return (rule.limit or 0.0) + (outward * rule.hysteresis if held else 0.0)


def _level_m(fix: FixMessage | None) -> float | None:
    """The horizontal protection level; infinite where none can be given, None of a method that has none."""
    if fix is None or fix.hpl_m is not None:
        return None if fix is None else fix.hpl_m
    return math.inf if fix.alert in (Alert.UNAVAILABLE, Alert.NOT_EXCLUDED) else None


def _span(seconds: float) -> str:
    if seconds < 120.0:
        return f"{seconds:.0f} s"
    return f"{seconds / 60.0:.0f} min" if seconds < 7200.0 else f"{seconds / 3600.0:.1f} h"
