"""The condition of the live site, in one word and with reasons. No I/O: the time is passed in.

A reason appears with the first evaluation that finds it, and disappears when none has found it for ``HOLD_S``; its
level also falls only after that time. The condition is good only on fresh evidence: the broker is connected, some tag
has a recent fix, and there is no reason against it. If nothing is known it is "waiting".
"""

from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence, Sized
from typing import Final, Literal, TypeVar

from msgspec import Struct
from msgspec.structs import replace

from skyless.core.keys.fault import Fault
from skyless.run.condition.evidence import ALERT_WORDS, ALERTS, Evidence
from skyless.run.mqtt.messages import AnchorHealth, EtherHealth, TagHealth, WatchMessage
from skyless.run.site_table import MAX_NAMES, THRESHOLDS, Node

LATE_S: Final = 0.25
VERY_LATE_S: Final = 1.0
"""Age of positions on arrival."""

KEY_WAIT_S: Final = 0.6
"""A tag with the site's public key may wait this long for keys before it gives a fix."""

MISSED_SHARE: Final = 0.1
"""Share of transmissions missed in a second. A computer with little to do misses 1 to 4 % in most seconds."""

EMULATED_MISSED_SHARE: Final = 0.3
"""The same for an emulated air, where missed transmissions are like lost frames on a real one, and matter little."""

DROPPED_SHARE: Final = 0.02
"""Share of receptions dropped by a tag. On an idle computer it is 0."""

VERY_SLOW_SHARE: Final = 0.5
"""Share of missed or dropped frames that is bad."""

BUSY_SHARE: Final = 0.95
"""Share of processor time in use above which programs wait for each other, and positions may be late."""

LAG_S: Final = 0.25
"""Delay of the page's server itself that counts as too slow."""

MULTIPATH_RATIO: Final = 1.3
"""Multipath above the site file's value by less than this factor is within what a tag can learn."""

START_S: Final = 20.0
"""All anchors may be offline for this long if none has been online yet, as the site is starting."""

OFTEN: Final = 3
OFTEN_S: Final = 60.0
"""Changes of the master within this time that are too many."""

UNREAD_S: Final = 0.5
"""The page's server does not keep up if messages have waited unread for this long."""

_MIN_ANCHORS: Final = 3  # with fewer on the air there is no position
_MIN_DROPPED: Final = 3
_MAX_NAMED: Final = 6

_ADVICE_NO_FIX: Final = {
    "no-beacons": "It receives no anchor: see whether anchors are on the air and its radio is connected.",
    "no-almanac": "It does not have the anchors' positions yet; they are sent every few seconds.",
    "too-few-anchors": "Too few anchors reach it: see which are offline, and what stands in the way.",
    "bad-geometry": "The anchors that reach it lie almost on one line as seen from it: add one on another side.",
    "mirror-ambiguity": "Two positions explain what it receives: give its height, or add an anchor off the plane.",
    "not-converged": "What it receives is contradictory: check the anchors' positions and antenna delays.",
    "residuals-too-large": "What it receives is contradictory: check the anchors' positions and antenna delays.",
    "acquiring": "It still looks for its first position.",
    "no-code": "Anchors send without codes: start them with the site's keys, or the tag with --trust open.",
    "no-certificate": "No certificate of a key chain that holds now has come: see whether the tag has this site's key.",
    "no-key": "No key of the site's key chain has come yet; the anchors send them all the time.",
    "clock-wrong": "Synchronise the clock of its computer with those of the anchors' computers, as by NTP.",
    "no-master": "Its method needs a master, and this site has none: use another method.",
}
CHAIN_ENDS_S: Final = 60 * 86400.0
"""A key chain that ends within this time needs a successor soon."""

_WHY_NO_CODES: Final[Mapping[str, str]] = {
    Fault.NO_TIME: "its program does not know the time yet",
    Fault.NO_CHAIN: "no key chain holds now",
    Fault.CLOCK_WRONG: "its clock differs from those of the other anchors",
}
_ADVICE_NO_CODES: Final[Mapping[str, str]] = {
    Fault.NO_TIME: "See the log of its program.",
    Fault.NO_CHAIN: "See with skyless site keys show when a chain begins, and whether the anchor has its files.",
    Fault.CLOCK_WRONG: "Synchronise the clock of its computer, as by NTP.",
}
_NOT_ACCEPTED: Final[Mapping[str, str]] = {
    Fault.BAD_CODE: "have a wrong code: they are forged, or the anchor has another seed",
    Fault.REPEATED: "come a second time: somebody repeats them",
    Fault.NO_CODE: "have no code: somebody else sends them, or the anchor has no keys",
    Fault.REVOKED_CHAIN: "are of a key chain that was replaced: the anchor, or somebody else, still uses it",
    Fault.LATE: "come too late: somebody delays them, or a clock is wrong",
    Fault.EARLY: "come too early: a clock is wrong, or they are forged",
}
_FORGED: Final[frozenset[str]] = frozenset({Fault.BAD_CODE, Fault.REPEATED, Fault.NO_CODE})
"""Faults of beacons that may affect positions of tags that do not verify them."""

_Statements = dict[str, dict[tuple[str, str], str]]
"""By anchor: the fault of its beacons that each node, by kind and name, states."""

_Severity = Literal["warning", "bad"]
_Health = TypeVar("_Health", TagHealth, AnchorHealth)


class Reason(Struct, frozen=True):
    """One thing that is wrong."""

    kind: str
    """Such as ``late`` or ``anchors``. There is one reason of each kind at a time."""
    level: _Severity
    text: str
    """What is wrong, and why."""
    advice: str
    """What to do next."""
    names: tuple[str, ...] = ()
    """The tags or anchors concerned, as ``tag/t1`` or ``anchor/3``; if many, only the first."""


def _of(what: str, kind: str, level: _Severity, text: str, advice: str, names: Iterable[str]) -> Reason:
    """A reason that concerns these tags or anchors."""
    return Reason(kind, level, text, advice, tuple(f"{what}/{name}" for name in list(names)[:_MAX_NAMED]))


def _reported(evidence: Evidence, kind: str, health: type[_Health], now_s: float) -> dict[str, _Health]:
    nodes = evidence.table.senders(kind)
    return {name: one.health for name, one in nodes if one.reports(now_s) and isinstance(one.health, health)}


def broker_reason(hub_trouble: str | None) -> Reason:
    """Reason for a disconnected broker, or hub, in which case nothing else is known."""
    if hub_trouble is not None:
        return Reason("broker", "bad", f"{hub_trouble}; nothing is updated", "The page connects by itself.")
    advice = "Start the broker again, or see whether its computer is reachable; the page connects by itself."
    return Reason("broker", "bad", "the broker is not connected: nothing is updated", advice)


def refused_reason(topic_filters: Collection[str]) -> Reason | None:
    """The broker refuses subscriptions, so that some messages of the site are missing."""
    if not topic_filters:
        return None
    named = ", ".join(sorted(topic_filters)[:_MAX_NAMED])
    text = f"the broker has refused {len(topic_filters)} subscriptions, so what they bring is missing: {named}"
    advice = "It has no room for more (its log says why), or the user has too few permissions (docs/mqtt.md, Roles)."
    return Reason("refused", "bad", text, advice)


def late_reason(evidence: Evidence, ages: Mapping[str, tuple[float, float]]) -> Reason | None:
    """Positions arrive late. ``ages``: from ``FixAges.least_ages_s``."""
    late = [name for name, (age_s, _) in ages.items() if age_s > LATE_S]
    late = sorted(name for name in late if ages[name][0] > LATE_S + _key_wait_s(evidence, name))
    if not late:
        return None
    worst = max(late, key=lambda name: ages[name][0])
    age_s, made_s = ages[worst]
    whose = "positions" if len(late) == len(ages) else f"positions of {listed('tag', late)}"
    tag = evidence.table.get("tag", worst)
    host = "" if tag is None else tag.host
    if made_s > 0.5 * age_s:
        why = f"{evidence.computer(host)} does not keep up with the receptions"
        advice = "End other programs there, or move tags to another computer."
    else:
        why = "the broker or the network delivers late"
        advice = "See whether the broker's computer or the network is busy."
        if host not in {"", evidence.table.host}:
            advice += f" Measured against the quickest message from {host} in the last minutes, not by its clock."
    text = f"{whose} are {age_s:.1f} s behind: {why}"
    return _of("tag", "late", "bad" if age_s > VERY_LATE_S else "warning", text, advice, late)


def _key_wait_s(evidence: Evidence, tag: str) -> float:
    node = evidence.table.get("tag", tag)
    health = None if node is None else node.health
    return KEY_WAIT_S if isinstance(health, TagHealth) and health.trust is not None else 0.0


def slow_reason(evidence: Evidence, now_s: float, lag_s: float) -> Reason | None:
    """Computers do not keep up: one reason for all signs. ``lag_s``: delay of the page's server."""
    signs = [*_missed(evidence, now_s), *_dropped(evidence, now_s)]
    if lag_s > LAG_S:
        signs.insert(0, (evidence.table.host, 0.0, f"the page's server was delayed by {lag_s:.1f} s"))
    if not signs:
        return None
    computers: dict[str, list[str]] = {}
    for host, _, words in signs:
        computers.setdefault(evidence.computer(host), []).append(words)
    text = "; ".join(f"{computer} is too slow: {', '.join(words)}" for computer, words in computers.items())
    advice = "End other programs there, run fewer tags and anchors, or move some to another computer."
    worst = max(share for _, share, _ in signs)
    return Reason("slow", "bad" if worst > VERY_SLOW_SHARE else "warning", text, advice)


def behind_reason(ages: Mapping[str, tuple[float, float]], unread_s: float) -> Reason | None:
    """The page's server does not keep up with messages, which have waited in its queue for ``unread_s``."""
    if unread_s < UNREAD_S:
        return None
    age_s = max((age_s for age_s, _ in ages.values()), default=0.0)
    by = f" by {age_s:.1f} s" if age_s > LATE_S else ""
    advice = "It gets more messages than its computer can process: end other programs there, or lower the tags' rates."
    return Reason("behind", "bad" if age_s > VERY_LATE_S else "warning", f"the page's server is behind{by}", advice)


def left_out_reason(evidence: Evidence, now_s: float) -> Reason | None:
    """Tags or anchors are not shown, as there are too many."""
    counts = {kind: evidence.table.roster.left_out(kind, now_s) for kind in MAX_NAMES}
    words = [f"{count} {kind}{'s' if count > 1 else ''}" for kind, count in counts.items() if count]
    if not words:
        return None
    text = f"{' and '.join(words)} {'is' if sum(counts.values()) == 1 else 'are'} not shown"
    limits = " and ".join(f"{most} {kind}s" for kind, most in MAX_NAMES.items())
    advice = (
        f"This page takes in at most {limits}, and judges no others: divide the site, or end names that are made up."
    )
    return Reason("not-shown", "warning", text, advice)


def busy_reason(evidence: Evidence, used_share: float | None) -> Reason | None:
    """All processors of the page's computer are in use, by any program. An emulated air reports its own misses."""
    if used_share is None or used_share < BUSY_SHARE or _airs(evidence):
        return None
    computer = evidence.computer(evidence.table.host)
    text = f"{computer} is fully busy: {100.0 * used_share:.0f} % of its processors are in use"
    return Reason("busy", "warning", text, "End other programs there, or positions may come late or not at all.")


_Sign = tuple[str, float, str]  # computer, lost share, and words


def _airs(evidence: Evidence) -> list[Node]:
    return [air for _, air in evidence.table.senders("ether") if air.online is not False]


def _missed(evidence: Evidence, now_s: float) -> Iterable[_Sign]:
    """Missed transmissions of the emulated air, and of anchors."""
    airs = _airs(evidence)
    most = EMULATED_MISSED_SHARE if airs else MISSED_SHARE
    for air in airs:
        if air.reports(now_s) and isinstance(air.health, EtherHealth) and air.health.missed_share > most:
            share = air.health.missed_share
            yield air.host, share, f"the emulated air missed {100.0 * share:.0f} % of the transmissions"
    shares: dict[str, dict[str, float]] = {}
    for name, anchor in evidence.table.senders("anchor"):
        share = anchor.health.missed_share if isinstance(anchor.health, AnchorHealth) else 0.0
        if anchor.reports(now_s) and share > most:
            shares.setdefault(anchor.host, {})[name] = share
    for host, late in shares.items():
        worst = max(late.values())
        yield host, worst, f"{counted('anchor', list(late))} missed up to {100.0 * worst:.0f} % of the transmissions"


def _dropped(evidence: Evidence, now_s: float) -> Iterable[_Sign]:
    """Receptions and fixes that tags dropped as too old between their last two health messages."""
    found: dict[str, list[tuple[str, int, float]]] = {}
    for name, tag in evidence.table.senders("tag"):
        now, before = tag.health, tag.previous
        if not (tag.reports(now_s) and isinstance(now, TagHealth) and isinstance(before, TagHealth)):
            continue
        count = now.late - before.late
        share = count / max(now.receptions - before.receptions, count, 1)
        if count >= _MIN_DROPPED and share > DROPPED_SHARE:
            found.setdefault(tag.host, []).append((name, count, share))
    for host, drops in found.items():
        names = [name for name, _, _ in drops]
        count, worst = sum(count for _, count, _ in drops), max(share for _, _, share in drops)
        yield host, worst, f"{counted('tag', names)} dropped {count} receptions or fixes that were too old"


def fix_reasons(evidence: Evidence, now_s: float) -> Iterable[Reason]:
    """Tags are online without a fix, with the cause that they state, or without a report."""
    online = [(name, tag) for name, tag in evidence.table.senders("tag") if tag.online]
    without = [
        (n, tag) for n, tag in online if not evidence.has_fix(tag, now_s) and not evidence.table.in_grace(now_s, tag)
    ]
    missed = evidence.missed(now_s)
    names = [*(name for name, _ in without), *missed]
    if not names:
        return
    silent = [*(name for name, tag in without if not tag.reports(now_s)), *missed]
    healths = {name: tag.health for name, tag in without if tag.reports(now_s)}
    causes = {name: health.reason or "" for name, health in healths.items() if isinstance(health, TagHealth)}
    if len(names) == len(online) + len(evidence.table.batched):
        though = "a tag is online" if len(names) == 1 else f"{len(names)} tags are online"
        why, advice = _causes(causes, len(names))
        if not causes:
            why, advice = ": they do not report", "See whether their programs and computers still run."
        yield _of("tag", "no-fixes", "bad", f"no positions, although {though}{why}", advice, names)
        return
    if causes:
        why, advice = _causes(causes, len(causes))
        text = f"{listed('tag', list(causes))} {verb(causes, 'has', 'have')} no fix{why}"
        yield _of("tag", "no-fix", "warning", text, advice, causes)
    if silent:
        text = f"{listed('tag', silent)} {verb(silent, 'does', 'do')} not report any more"
        advice = "Its program does not respond, or its computer is cut off: see there, and start it again."
        yield _of("tag", "silent", "warning", text, advice, silent)


def _causes(causes: Mapping[str, str], tags: int) -> tuple[str, str]:
    """Why ``tags`` tags have no fix, with names unless all share one cause, and advice for most of them."""
    groups = [(cause, names) for cause, names in alike(causes) if cause]
    words = [cause.replace("-", " ") for cause, _ in groups]
    common, most = groups[0] if groups else ("", [])
    advice = _ADVICE_NO_FIX.get(common, "See whether fixes are published, and the log of the tag.")
    if groups and len(most) < tags:
        words = [f"{word} ({listed('tag', names)})" for word, (_, names) in zip(words, groups, strict=True)]
        advice = f"For {listed('tag', most)}: {advice}"
    return f": {'; '.join(words)}" if words else "", advice


def alike(values: Mapping[str, str]) -> list[tuple[str, list[str]]]:
    """Group names by value, the most common value first."""
    return [
        (value, [name for name, of_name in values.items() if of_name == value])
        for value, _ in Counter(values.values()).most_common()
    ]


_ALERT_REASONS: Final[tuple[tuple[str, int, _Severity, str], ...]] = (
    ("limit", 2, "bad", "Do not rely on the position; see which anchors the tag uses and what blocks them."),
    ("alert", 1, "warning", "The position is still sound; see what blocks an anchor, or whether one has moved."),
)
"""Kind of the reason, the alerts' grade in ``ALERTS``, level and advice."""


def alert_reasons(evidence: Evidence) -> Iterable[Reason]:
    """Fixes since the last evaluation have integrity alerts."""
    for kind, grade, level, advice in _ALERT_REASONS:
        alerts = {name: alert for name, alert in evidence.alerts.items() if ALERTS[alert] == grade}
        if alerts:
            text = "; ".join(f"{listed('tag', names)}: {ALERT_WORDS[alert]}" for alert, names in alike(alerts))
            yield _of("tag", kind, level, text, advice, alerts)


def anchor_reasons(evidence: Evidence, now_s: float) -> Iterable[Reason]:
    """Anchors of the site are offline, only cut off from the broker, or not synchronised."""
    if evidence.table.site is None:
        return
    names, spelled = evidence.table.site_anchors, evidence.table.spelled
    offline, cut_off, idle = _anchors(evidence, now_s)
    if offline:
        which = f"all {len(names)} anchors are" if len(offline) == len(names) else ""
        which = which or f"{listed('anchor', spelled(offline))} of {len(names)} {verb(offline, 'is', 'are')}"
        advice = "See whether power and program run there; positions are less accurate without them."
        too_few = len(names) - len(offline) < _MIN_ANCHORS
        yield _of("anchor", "anchors", "bad" if too_few else "warning", f"{which} offline", advice, offline)
    if cut_off:
        text = f"{listed('anchor', spelled(cut_off))} {verb(cut_off, 'does', 'do')} not report, though on the air"
        advice = "The program has lost the broker, or the page lost its messages: see its log."
        yield _of("anchor", "silent-anchors", "warning", text, advice, cut_off)
    if idle:
        text = f"{listed('anchor', idle)} {verb(idle, 'is', 'are')} not synchronised and sends nothing"
        text = text if len(idle) == 1 else text.replace("sends", "send")
        advice = "Too few messages of the others arrive there: see what blocks them."
        yield _of("anchor", "not-synchronised", "warning", text, advice, idle)


def offline_anchors(evidence: Evidence, now_s: float) -> list[str] | None:
    """Anchors of the site that are offline; None while it is too early to tell."""
    return None if evidence.table.site is None or evidence.table.in_grace(now_s) else _anchors(evidence, now_s)[0]


def _anchors(evidence: Evidence, now_s: float) -> tuple[list[str], list[str], list[str]]:
    """Anchors of the site that are offline, those only cut off from the broker, and those not synchronised."""
    names = evidence.table.site_anchors
    offline: list[str] = []
    cut_off: list[str] = []
    idle: list[str] = []
    for name in names:
        node = evidence.table.get("anchor", name)
        if node is not None and node.reports(now_s):
            health = node.health
            if isinstance(health, AnchorHealth) and _is_idle(health):
                idle.append(name)
        elif node is None or node.online is not False:
            on_air = node is not None and now_s < node.used_until_s and node.used_s > node.health_s + THRESHOLDS.fresh_s
            if not evidence.table.in_grace(now_s, node):
                (cut_off if on_air else offline).append(name)
        elif node.since_s is not None or not evidence.table.in_grace(now_s):  # else an old status, kept by the broker
            offline.append(name)
    unseen = len(offline) == len(names) and all(node.since_s is None for _, node in evidence.table.senders("anchor"))
    return [] if unseen and now_s - evidence.table.ready_s < START_S else offline, cut_off, idle


def _is_idle(health: AnchorHealth) -> bool:
    return not health.synchronised and health.role not in {"master", "root"} and health.uptime_s > THRESHOLDS.grace_s


def multipath_reason(evidence: Evidence, now_s: float) -> Reason | None:
    """Ranges change more along a tag's path than the site file states."""
    site = evidence.table.site
    stated_m = 0.0 if site is None else site.accuracy.place_std_m
    healths = _reported(evidence, "tag", TagHealth, now_s).items()
    found = {
        name: (one.multipath_std_m, one.multipath_distance_m or 0.0)
        for name, one in healths
        if one.multipath_std_m is not None
    }
    more = [name for name, (std_m, _) in found.items() if std_m > MULTIPATH_RATIO * stated_m]
    if not more:
        return None
    std_m, distance_m = max(found[name] for name in more)
    text = (
        f"{listed('tag', more)} {verb(more, 'finds', 'find')} that ranges change by {100.0 * std_m:.0f} cm within"
        f" {100.0 * distance_m:.0f} cm of the way, more than the site file states"
    )
    advice = (
        f"Set place_std_m = {std_m:.2f} and place_distance_m = {distance_m:.2f} under [accuracy] of the site file:"
        " tags then start with that instead of learning it."
    )
    return _of("tag", "multipath", "warning", text, advice, more)


def notes_reason(evidence: Evidence, now_s: float) -> Reason | None:
    """What tags state of another system's anchors."""
    found = {name: one.notes for name, one in _reported(evidence, "tag", TagHealth, now_s).items() if one.notes}
    if not found:
        return None
    text = "; ".join(dict.fromkeys(note for notes in found.values() for note in notes))
    advice = "Restart the anchors that are named, and calibrate those that are not calibrated."
    return _of("tag", "notes", "warning", f"{text[0].lower()}{text[1:]}", advice, found)


def master_reason(evidence: Evidence, now_s: float) -> Reason | None:
    """The master changes often (protocol 1)."""
    count = sum(now_s - time_s < OFTEN_S for time_s in evidence.leader.changes_s)
    if count < OFTEN:
        return None
    text = f"the master has changed {count} times within a minute; now it is anchor {evidence.leader.leader}"
    advice = "Anchors lose its messages: a computer is too slow, or something blocks it; move it, or name another."
    return Reason("master", "warning", text, advice)


def watch_reasons(watch: WatchMessage | None, age_s: float | None) -> Iterable[Reason]:
    """The watch of the anchors has findings."""
    ended = (age_s or 0.0) > THRESHOLDS.watch_s
    findings = () if watch is None else watch.findings
    moved = [finding for finding in findings if finding.kind == "moved"]
    other = [finding for finding in findings if finding.kind != "moved"]
    for kind, chosen in (("moved", moved), ("watch", other)):
        if not chosen:
            continue
        text = chosen[0].sentence.rstrip(".") + (f", and {len(chosen) - 1} more" if len(chosen) > 1 else "")
        text += " (the watch does not report any more)" if ended else ""
        advice = "Move it back, or survey again." if kind == "moved" else "See there; survey again where it stays so."
        names = dict.fromkeys(str(anchor) for finding in chosen for anchor in finding.anchors)
        yield _of("anchor", kind, "bad" if kind == "moved" and not ended else "warning", text, advice, names)


# Codes and keys: no reasons at a site without keys, or for tags without its public key


def authentication_reasons(evidence: Evidence, now_s: float) -> Iterable[Reason]:
    """All reasons about codes and keys."""
    healths = _reported(evidence, "tag", TagHealth, now_s)
    tags = {name: health for name, health in healths.items() if health.trust is not None}
    anchors = _reported(evidence, "anchor", AnchorHealth, now_s)
    keyed = {
        name: health
        for name, health in anchors.items()
        if health.chain is not None or health.chain_ends_unix_s is not None or health.code_fault is not None
    }
    yield from _clock(tags)
    yield from _not_verified(evidence, tags, now_s)
    yield from _chains(keyed)
    yield from _codes(evidence, keyed, now_s)
    yield from _keys(evidence, keyed, anchors, now_s)
    yield from _forged(evidence, tags, anchors, now_s)


def _left_s(health: AnchorHealth) -> float:
    """Time until the end of an anchor's last key chain, by its own clock."""
    return float("inf") if health.chain_ends_unix_s is None else health.chain_ends_unix_s - health.unix_s


def _clock(tags: Mapping[str, TagHealth]) -> Iterable[Reason]:
    """Clocks of tags differ from the site's by more than the tags' bounds."""
    errors_s = {name: health.clock_error_s for name, health in tags.items() if health.clock_error_s is not None}
    if not errors_s:
        return
    worst_s = max(errors_s.values(), key=abs)
    size = f"{abs(worst_s):.2f} s" if abs(worst_s) < 1.0 else f"{abs(worst_s):.1f} s"
    if len(errors_s) == 1:
        text = f"the clock of tag {next(iter(errors_s))} is {size} {'ahead of' if worst_s > 0 else 'behind'} the site's"
    else:
        text = f"the clocks of {listed('tag', list(errors_s))} differ from the site's by up to {size}"
    advice = "Synchronise the clocks of its computer and of the anchors', as by NTP: they decide what came in time."
    verified = all(tags[name].is_verified for name in errors_s)
    yield _of("tag", "clock", "warning" if verified else "bad", text, advice, errors_s)


def _not_verified(evidence: Evidence, tags: Mapping[str, TagHealth], now_s: float) -> Iterable[Reason]:
    """Tags receive beacons but verify none, apart from tags with a wrong clock, which is another reason."""
    found = {
        name: health
        for name, health in tags.items()
        if not health.is_verified and health.clock_error_s is None and _receives(evidence.table.all("tag")[name], now_s)
    }
    if not found:
        return
    common = Counter(fault for health in found.values() for fault in health.faults.values()).most_common(1)
    text = f"nothing that {listed('tag', list(found))} {verb(found, 'receives', 'receive')} is verified"
    text += f" ({common[0][0].replace('-', ' ')})" if common else ""
    advice = (
        "Its positions may be forged. See whether the anchors send codes, whether its clock is right, and whether "
        "it has this site's public key."
    )
    yield _of("tag", "not-verified", "bad", text, advice, found)


def _receives(tag: Node, now_s: float) -> bool:
    """Whether a tag that has not just started received beacons between its last two health messages."""
    now, before = tag.health, tag.previous
    if not isinstance(now, TagHealth) or not isinstance(before, TagHealth) or tag.since_s is None:
        return False
    return now_s - tag.since_s > THRESHOLDS.grace_s and now.receptions > before.receptions


def _chains(keyed: Mapping[str, AnchorHealth]) -> Iterable[Reason]:
    advice = "Make a successor with skyless site keys rotate, and give the anchors its files."
    ended = [name for name, health in keyed.items() if _left_s(health) <= 0.0]
    if ended:
        text = (
            f"the key chain of {_all_or_some(ended, keyed)} has ended: {verb(ended, 'it sends', 'they send')} no codes"
        )
        yield _of("anchor", "chain-ended", "bad", text, advice, ended)
    soon = {name: _left_s(health) for name, health in keyed.items() if 0.0 < _left_s(health) < CHAIN_ENDS_S}
    if soon:
        least_s = min(soon.values())
        left = f"{least_s // 86400.0:.0f} days" if least_s >= 2 * 86400.0 else f"{least_s // 3600.0:.0f} hours"
        text = f"the key chain of {_all_or_some(list(soon), keyed)} ends in {left}"
        yield _of("anchor", "chain", "warning", text, advice, soon)


def _all_or_some(names: list[str], keyed: Mapping[str, AnchorHealth]) -> str:
    return f"all {len(names)} anchors" if 1 < len(names) == len(keyed) else listed("anchor", names)


def _codes(evidence: Evidence, keyed: Mapping[str, AnchorHealth], now_s: float) -> Iterable[Reason]:
    without = {
        name: health.code_fault
        for name, health in keyed.items()
        if health.code_fault is not None
        and _left_s(health) > 0.0
        and not evidence.table.in_grace(now_s, evidence.table.all("anchor")[name])
    }
    if not without:
        return
    groups = alike(without)
    whys = [(_WHY_NO_CODES.get(fault, fault.replace("-", " ")), names) for fault, names in groups]
    text = f"{listed('anchor', list(without))} {verb(without, 'sends', 'send')} no codes: "
    text += "; ".join(why if len(groups) == 1 else f"{why} ({listed('anchor', names)})" for why, names in whys)
    advice = _ADVICE_NO_CODES.get(groups[0][0], "See the log of its program.")
    yield _of("anchor", "codes", "warning", text, advice, without)


def _keys(
    evidence: Evidence, keyed: Mapping[str, AnchorHealth], anchors: Mapping[str, AnchorHealth], now_s: float
) -> Iterable[Reason]:
    without = [
        name
        for name in anchors
        if name not in keyed and not evidence.table.in_grace(now_s, evidence.table.all("anchor")[name])
    ]
    if keyed and without:
        others = f"{len(keyed)} other{verb(keyed, ' has', 's have')}"
        text = f"{listed('anchor', without)} {verb(without, 'has', 'have')} no keys, though {others} them"
        advice = "Start it with the site's keys (--keys): tags that verify beacons do not use it."
        yield _of("anchor", "keys", "warning", text, advice, without)


def _forged(
    evidence: Evidence, tags: Mapping[str, TagHealth], anchors: Mapping[str, AnchorHealth], now_s: float
) -> Iterable[Reason]:
    """Tags and other anchors do not accept beacons of anchors, or in their name."""
    statements = _that_count(_statements(evidence, tags, anchors, now_s))
    if not statements:
        return
    faults = {name: Counter(by.values()).most_common(1)[0][0] for name, by in statements.items()}
    parts = []
    for fault, names in alike(faults):
        words = _NOT_ACCEPTED.get(fault, f"are not accepted ({fault.replace('-', ' ')})")
        finders = _finders(dict.fromkeys(node for name in names for node in statements[name]))
        parts.append(f"beacons in the name of {listed('anchor', names)} {words} (found by {finders})")
    advice = "Tags that verify beacons do not use these. See that anchor's log and keys, and who else transmits there."
    without_key = [
        name
        for name, node in evidence.table.senders("tag")
        if evidence.has_fix(node, now_s) and isinstance(node.health, TagHealth) and node.health.trust is None
    ]
    level: _Severity = "warning"
    if without_key and not _FORGED.isdisjoint(faults.values()):
        level = "bad"
        advice += (
            f" Do not rely on {listed('tag', without_key)}: {verb(without_key, 'it verifies', 'they verify')} nothing."
        )
    yield _of("anchor", "forged", level, "; ".join(parts), advice, faults)


def _statements(
    evidence: Evidence, tags: Mapping[str, TagHealth], anchors: Mapping[str, AnchorHealth], now_s: float
) -> _Statements:
    """Faults of anchors that nodes state, except those that other reasons explain: a wrong clock or missing codes."""
    found: _Statements = {}

    def add(node: tuple[str, str], faults: Mapping[str, str], *, is_clock_wrong: bool) -> None:
        for anchor, fault in faults.items():
            is_explained = fault in {Fault.LATE, Fault.EARLY} and is_clock_wrong
            is_explained |= fault == Fault.NO_CODE and _may_be_without_codes(evidence, anchor, now_s)
            if not is_explained:
                found.setdefault(anchor, {})[node] = fault

    for name, tag in tags.items():
        add(("tag", name), tag.faults, is_clock_wrong=tag.clock_error_s is not None or not tag.is_verified)
    for name, anchor in anchors.items():
        add(("anchor", name), anchor.faults, is_clock_wrong=anchor.code_fault == Fault.CLOCK_WRONG)
    return found


def _may_be_without_codes(evidence: Evidence, anchor: str, now_s: float) -> bool:
    """Whether an anchor has recently stated that it sends without codes, or has just started."""
    node = evidence.table.get("anchor", anchor)
    if node is None:
        return False
    is_recent = now_s - node.health_s < THRESHOLDS.grace_s
    return evidence.table.in_grace(now_s, node) or (is_recent and node.codes_for_s(now_s) < THRESHOLDS.grace_s)


def _that_count(statements: _Statements) -> _Statements:
    """Drop statements by an anchor that more nodes fault: one with a wrong seed finds faults everywhere."""

    def count(node: tuple[str, str]) -> int:
        return len(statements.get(node[1], ())) if node[0] == "anchor" else 0

    chosen = {
        name: {node: fault for node, fault in by.items() if count(node) <= len(by)} for name, by in statements.items()
    }
    return {name: by for name, by in chosen.items() if by}


def _finders(nodes: Iterable[tuple[str, str]]) -> str:
    """Name nodes as in ``2 tags and anchor 3``."""
    by_kind: dict[str, list[str]] = {}
    for kind, name in nodes:
        by_kind.setdefault(kind, []).append(name)
    return " and ".join(counted(kind, names) for kind, names in by_kind.items())


# Words, and the order of reasons

_ORDER: Final = (
    *("broker", "refused", "behind", "slow", "busy", "late", "not-shown", "forged", "clock", "chain-ended", "codes"),
    *("not-verified", "no-fixes", "limit"),
    *("moved", "anchors", "master", "no-fix", "alert", "keys", "not-synchronised", "silent-anchors", "silent", "watch"),
    *("notes", "multipath", "chain"),
)
"""Kinds of reasons, causes before their effects."""


def rank(reason: Reason) -> tuple[bool, int]:
    """Sort key of reasons, the worst first."""
    return reason.level != "bad", _ORDER.index(reason.kind) if reason.kind in _ORDER else len(_ORDER)


def listed(kind: str, names: Sequence[str]) -> str:
    """List names as in ``anchors 3, 5 and 8``; only the first of many."""
    if len(names) == 1:
        return f"{kind} {names[0]}"
    if len(names) > _MAX_NAMED:
        return f"{kind}s {', '.join(names[:_MAX_NAMED])} and {len(names) - _MAX_NAMED} more"
    return f"{kind}s {', '.join(names[:-1])} and {names[-1]}"


def counted(kind: str, names: Sequence[str]) -> str:
    """Name one item or count several: ``anchor 3``, ``5 anchors``."""
    return f"{kind} {names[0]}" if len(names) == 1 else f"{len(names)} {kind}s"


def verb(items: Sized, one: str, many: str) -> str:
    """The verb's form for one item or for many."""
    return one if len(items) == 1 else many


EVALUATION_S: Final = 0.5
"""Interval of the evaluations."""

HOLD_S: Final = 3.0
"""How long a reason stays after it was last found, so that the page does not flicker."""


class Condition(Struct, frozen=True):
    """How the site is, and why."""

    level: Literal["waiting", "good", "warning", "bad"]
    text: str
    """Text of the first reason, or what is being waited for. Empty if all is well."""
    reasons: tuple[Reason, ...]
    """The worst first."""
    latency_p50_s: float | None
    latency_p99_s: float | None
    """From a frame's end to the arrival of its fix at the page's server, over all tags in the last ten seconds."""
    tags: int = 0
    """Number of known tags."""
    tags_with_fix: int = 0
    anchors: int = 0
    """Anchors of the site, and others that report."""


class ConditionMonitor:
    """Evaluates evidence, and holds the reasons found for a while."""

    def __init__(self, evidence: Evidence) -> None:
        self.evidence = evidence
        self._held: dict[str, tuple[float, Reason]] = {}  # by kind: the reason, and the time when it was last found
        self._bad_s: dict[str, float] = {}  # by kind: time when it was last bad
        self._blind_until_s = float("-inf")

    def evaluate(
        self,
        now_s: float,
        lag_s: float = 0.0,
        watch: WatchMessage | None = None,
        watch_age_s: float | None = None,
        used_share: float | None = None,
        unread_s: float = 0.0,
        refused: Collection[str] = (),
    ) -> Condition:
        """Evaluate the condition.

        ``lag_s``: delay of the server's own work since the last evaluation. ``used_share``: share of its computer's
        processors in use, None if unknown. ``unread_s``: how long messages have waited in its own queue. ``refused``:
        subscriptions that the broker has refused.
        """
        evidence = self.evidence
        ages = evidence.ages.least_ages_s()
        latencies = evidence.ages.percentiles_s(now_s)
        if not evidence.table.connected:
            self._held.clear()
            if not evidence.table.was_connected and now_s - evidence.table.ready_s < THRESHOLDS.fresh_s:
                awaited = "the broker" if evidence.hub_trouble is None else "the site at its hub"
                return Condition("waiting", f"waiting for {awaited}", (), None, None)
            reason = broker_reason(evidence.hub_trouble)
            return Condition(reason.level, reason.text, (reason,), None, None)
        behind = behind_reason(ages, unread_s)
        found = [
            refused_reason(refused),
            behind,
            slow_reason(evidence, now_s, lag_s),
            None if evidence.table.is_empty else busy_reason(evidence, used_share),
            late_reason(evidence, ages) if behind is None else None,
            left_out_reason(evidence, now_s),
            master_reason(evidence, now_s),
            multipath_reason(evidence, now_s),
            notes_reason(evidence, now_s),
            *alert_reasons(evidence),
            *authentication_reasons(evidence, now_s),
            *watch_reasons(watch, watch_age_s),
        ]
        if lag_s > LAG_S or behind is not None:
            self._blind_until_s = now_s + 2 * EVALUATION_S  # until messages that arrived meanwhile have been read
        if not self.is_blind(now_s) and not evidence.table.is_bare:
            found += [*fix_reasons(evidence, now_s), *anchor_reasons(evidence, now_s)]
        for reason in filter(None, found):
            self._hold(reason, now_s)
        self._held = {kind: held for kind, held in self._held.items() if now_s - held[0] < HOLD_S}
        evidence.alerts.clear()
        reasons = tuple(sorted((reason for _, reason in self._held.values()), key=rank))
        tags, batched = evidence.table.senders("tag"), evidence.table.batched
        with_fix = sum(evidence.has_fix(tag, now_s) for _, tag in tags)
        with_fix += sum(not tag.is_gone for tag in batched.values())
        figures = *latencies, len(tags) + len(batched), with_fix, evidence.table.roster.size("anchor")
        if reasons:
            return Condition(reasons[0].level, reasons[0].text, reasons, *figures)
        if with_fix:
            return Condition("good", "", (), *figures)
        return Condition("waiting", self._awaited(), (), *figures)

    def is_blind(self, now_s: float) -> bool:
        """Whether messages may be missing: the broker is not connected, or the server itself was delayed."""
        return not self.evidence.table.hears or now_s < self._blind_until_s

    def _hold(self, reason: Reason, now_s: float) -> None:
        if reason.level == "bad":
            self._bad_s[reason.kind] = now_s
        elif now_s - self._bad_s.get(reason.kind, float("-inf")) < HOLD_S:
            reason = replace(reason, level="bad")
        self._held[reason.kind] = now_s, reason

    def _awaited(self) -> str:
        if self.evidence.table.site is None:
            return "waiting for the site's anchors"
        if self.evidence.table.is_bare:
            return "not set up yet: tab Set up"
        if not self.evidence.table.batched and not any(tag.online for _, tag in self.evidence.table.senders("tag")):
            return "no tag is online"
        return "waiting for the first position"
