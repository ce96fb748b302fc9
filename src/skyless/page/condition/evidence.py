"""Evidence of a live site's condition: the state of its programs, with times. No I/O.

``now_s`` is always the page server's monotonic clock, ``unix_s`` its wall clock.
"""

from collections import deque
from pathlib import Path
from typing import Final

from skyless.core.site import Site
from skyless.run.mqtt.messages import AnchorHealth, EtherHealth, FixMessage, StatusMessage, TagHealth

Health = TagHealth | AnchorHealth | EtherHealth

FRESH_S: Final = 2.5
"""Fixes and health messages older than this are no evidence."""

GRACE_S: Final = 5.0
"""A tag that has just started may be without a fix for this long, and an anchor without a report."""

ALERTS: Final[dict[str | None, int]] = {"detected-excluded": 1, "detected-not-excluded": 2, "alert-limit-exceeded": 2}
"""Grades of reported integrity alerts: 1 if the position is still sound, 2 if it may be wrong."""

ALERT_WORDS: Final = {
    "detected-excluded": "a faulty anchor is excluded",
    "detected-not-excluded": "a fault is not excluded, so that the position may be wrong",
    "alert-limit-exceeded": "the protection level is above the alert limit",
}

EXPECTED_S: Final = 600.0
"""A tag known only from batches, and so without a status, is expected for this long after its last fix."""

_MESSAGES_S: Final = 3.0
"""Longest delay of a fix in a batch after the message of the same fix."""

MAX_NAMES: Final = {"tag": 200_000, "anchor": 20_000}
"""Most names admitted of each kind."""

MAX_OTHERS: Final = 2_000
"""Most names admitted of all other kinds together."""

_COUNT_S: Final = 10.0
"""Interval at which the count of refused names starts again, so that it falls when they end."""

_WINDOW_S: Final = 60.0
_HEALTH_AGE_S: Final = 2.5  # how long the delay of a health message is valid

_RECENT_S: Final = 10.0
"""Period of the ages in the percentiles, long enough for tags with one fix per second."""

_MAX_AGES: Final = 4096  # of the newest fixes

_LEADER_AGE_S: Final = 3.5  # an anchor whose health is older does not count
_MAX_CHANGES: Final = 100

USE_WINDOW_S: Final = 2.0
"""Time over which processor use is averaged."""

_IDLE, _IO_WAIT = 3, 4
"""Columns of idle time in the first line of ``/proc/stat``."""


class Node:
    """A tag, an anchor or the emulated air."""

    __slots__ = (
        *("batched_s", "codes_s", "fix_s", "health", "health_s", "host", "online", "previous", "since_s", "used_s"),
    )

    def __init__(self) -> None:
        self.online: bool | None = None  # by its status; None without one
        self.host = ""  # name of its computer; empty if unknown
        self.health: Health | None = None
        self.previous: Health | None = None  # the health before
        self.since_s: float | None = None  # time when it came online, or of its first message
        self.health_s = float("-inf")  # time of the last health message
        self.fix_s = float("-inf")  # time of the last fix, as a message or in a batch
        self.batched_s = float("-inf")  # time of the last fix in a batch
        self.used_s = float("-inf")  # time of the last fix that used this anchor
        self.codes_s: float | None = None  # time since when it states that its beacons have codes

    def begin(self, now_s: float) -> None:
        """Mark it present from now, unless it already is."""
        if self.since_s is None:
            self.since_s = now_s

    def reports(self, now_s: float) -> bool:
        """Whether the node is online with a fresh health message."""
        return self.online is not False and now_s - self.health_s < FRESH_S

    def has_fix(self, now_s: float) -> bool:
        """Whether there is a recent fix."""
        return now_s - self.fix_s < FRESH_S

    def codes_for_s(self, now_s: float) -> float:
        """How long its beacons have had codes, as it states; 0 without codes."""
        return 0.0 if self.codes_s is None else now_s - self.codes_s


class Evidence:
    """The newest messages of every node, with their times of arrival."""

    def __init__(self, host: str, now_s: float) -> None:
        """``host``: this computer's name, as nodes state theirs."""
        self.host = host
        self.connected = self.was_connected = False
        self.hub_trouble: str | None = None  # at a hub: why it is not connected
        self.ready_s = now_s  # time since when messages can arrive
        self.site: Site | None = None
        self.nodes: dict[tuple[str, str], Node] = {}  # by kind and name
        self.batched_s: dict[str, float] = {}  # time of the last fix of tags known only from batches
        self.batches_connected = True  # whether batches, if a site has them, can arrive
        self.alerts: dict[str, str] = {}  # by tag: the worst alert of its fixes since the last evaluation
        self.roster = Roster()
        self._sorted: dict[str, list[tuple[str, Node]]] = {}
        self.ages = FixAges()
        self.leader = LeaderTracker()

    def set_connected(self, *, connected: bool, now_s: float) -> None:
        """Update whether the broker is connected."""
        if connected != self.connected:
            self.connected, self.ready_s = connected, now_s
            self.was_connected = True

    def set_site(self, site: Site, now_s: float) -> None:
        """Update the site, and with it the expected anchors."""
        if self.site is None:
            self.ready_s = now_s
        self.site = site
        self.site_anchors()

    @property
    def is_bare(self) -> bool:
        """Whether no anchor of the site has a position yet, so that there can be no fixes."""
        return self.site is not None and not self.site.anchors

    def site_anchors(self) -> list[str]:
        """Names of the site's anchors, as far as admitted."""
        site = self.site
        ids = [] if site is None else [*(a.id for a in site.anchors), *(a.id for a in site.unplaced)]
        return [name for name in map(str, ids) if self.roster.admits("anchor", name)]

    def add_status(self, status: StatusMessage, now_s: float) -> None:
        """Add a status, which says whether a node is online."""
        node = self._node(status.kind, status.name)
        if node is None:
            return
        if status.online and not node.online:
            node.since_s = now_s
        node.online, node.host = status.online, status.host or node.host
        if not status.online:
            node.previous, node.codes_s = None, None
            self.alerts.pop(status.name, None)
            self.ages.remove(status.name)

    def add_health(self, kind: str, name: str, health: Health, now_s: float, unix_s: float) -> None:
        """Add a node's health."""
        node = self._node(kind, name)
        if node is None:
            return
        node.begin(now_s)
        node.previous, node.health, node.health_s = node.health, health, now_s
        if isinstance(health, AnchorHealth):
            if health.chain is None or health.code_fault is not None:
                node.codes_s = None
            elif node.codes_s is None:
                node.codes_s = now_s
            self.leader.update(health, now_s)
        elif isinstance(health, TagHealth) and node.host == self.host:
            self.ages.add_health(name, unix_s - health.unix_s, now_s)

    def add_fix(self, fix: FixMessage, now_s: float) -> float:
        """Add a fix of a tag. Returns its age in s, from ``FixAges``."""
        node = self._node("tag", fix.tag)
        if node is None:
            return 0.0
        node.begin(now_s)
        node.fix_s = now_s
        for anchor in fix.anchors:
            used = self._node("anchor", str(anchor))
            if used is not None:
                used.used_s = now_s
        return self.add_batched(fix, now_s)

    def add_batched(self, fix: FixMessage, now_s: float) -> float:
        """Add a fix from a batch, for a tag also passed to ``hear``. Returns its age in s."""
        if fix.alert is not None and ALERTS.get(fix.alert, 0) > ALERTS.get(self.alerts.get(fix.tag), 0):
            self.alerts[fix.tag] = fix.alert
        return self.ages.add_fix(fix.tag, fix.unix_s, fix.latency_s, now_s)

    def hear(self, tag: str, now_s: float) -> None:
        """Note that a batch has a fix of a tag."""
        node = self.nodes.get(("tag", tag))
        if node is None:
            self.batched_s[tag] = now_s
        elif not self.sends_messages(tag, now_s):
            node.fix_s = node.batched_s = now_s

    def sends_messages(self, tag: str, now_s: float) -> bool:
        """Whether a tag's fixes arrive as messages, so that those in batches are duplicates."""
        node = self.nodes.get(("tag", tag))
        return node is not None and node.fix_s > node.batched_s and now_s - node.fix_s < _MESSAGES_S

    def missed(self, now_s: float) -> list[str]:
        """Tags known only from batches that have no fixes any more."""
        self.batched_s = {tag: fix_s for tag, fix_s in self.batched_s.items() if now_s - fix_s < EXPECTED_S}
        return [tag for tag, fix_s in self.batched_s.items() if now_s - fix_s >= FRESH_S]

    def of(self, kind: str) -> list[tuple[str, Node]]:
        """Names and nodes of a kind, in natural order."""
        if kind not in self._sorted:
            found = [(name, node) for (of_kind, name), node in self.nodes.items() if of_kind == kind]
            found.sort(key=lambda item: (len(item[0]) if item[0].isdecimal() else 1 << 30, item[0]))
            self._sorted[kind] = found
        return self._sorted[kind]

    def in_grace(self, now_s: float, node: Node | None = None) -> bool:
        """Whether the connection, or a node, is too young to be complete."""
        since_s = self.ready_s if node is None or node.since_s is None else max(node.since_s, self.ready_s)
        return now_s - since_s < GRACE_S

    def computer(self, host: str) -> str:
        """Name a computer in words. An unknown one counts as this one."""
        return "this computer" if host in {"", self.host} else f"computer {host}"

    def _node(self, kind: str, name: str) -> Node | None:
        node = self.nodes.get((kind, name))
        if node is None and self.roster.admits(kind, name):
            node = self.nodes[kind, name] = Node()
            if kind == "tag":
                self.batched_s.pop(name, None)
            self._sorted.pop(kind, None)
        return node


# Admission of names


class Roster:
    """The admitted names of one site, in bounded memory."""

    def __init__(self) -> None:
        self._names: dict[str, set[str]] = {}
        self._left_out: dict[str, set[int]] = {}  # hashes of names refused since the last count
        self._counted: dict[str, int] = {}
        self._counted_s = float("-inf")

    def admits(self, kind: str, name: str) -> bool:
        """Whether a name is admitted: the first ones are, permanently."""
        group, entry, most = kind, name, MAX_NAMES.get(kind)
        if most is None:
            group, entry, most = "", f"{kind}/{name}", MAX_OTHERS
        names = self._names.setdefault(group, set())
        if entry in names:
            return True
        if len(names) < most:
            names.add(entry)
            return True
        left_out = self._left_out.setdefault(group, set())
        if len(left_out) < most:
            left_out.add(hash(entry))
        return False

    def size(self, kind: str) -> int:
        """Number of admitted names of a kind."""
        return len(self._names.get(kind, ()))

    def left_out(self, kind: str, now_s: float) -> int:
        """Number of refused names of a kind, tag or anchor, counted at most up to the limit of admitted ones."""
        if now_s - self._counted_s >= _COUNT_S:
            self._counted = {group: len(names) for group, names in self._left_out.items()}
            self._left_out, self._counted_s = {}, now_s
        return max(self._counted.get(kind, 0), len(self._left_out.get(kind, ())))


# Ages of fixes


class _Tag:
    """Delays of one tag's messages: ``now_s`` of arrival less ``unix_s`` of sending, including the clock difference."""

    __slots__ = ("before_s", "begun_s", "delay_s", "delay_seen_s", "least_s", "unix_s")

    def __init__(self, now_s: float) -> None:
        self.begin(now_s)
        self.unix_s = float("-inf")  # of the last fix
        self.delay_s, self.delay_seen_s = 0.0, float("-inf")
        """Delay of the last health message, if this computer sent it, and its time of arrival."""

    def begin(self, now_s: float) -> None:
        """Begin a window, and forget the one before."""
        self.begun_s = now_s
        self.least_s = self.before_s = float("inf")  # least delays in the current window, and in the one before


class FixAges:
    """Ages of fixes on arrival, by the page server's monotonic clock: the least of each tag, and percentiles of all.

    A fix was made ``latency_s`` after its last frame by the tag's clock alone, so this part is exact. The travel time
    of its message follows, for tags of this computer, from their health messages. For others it is relative to the
    tag's quickest message in the last one to two minutes, so that clocks that differ, or are set, raise no alarm; a
    constant delay therefore looks like a different clock. A fix with an earlier time than the previous one shows that
    the clock was set back: then the minutes start again.
    """

    def __init__(self) -> None:
        self._tags: dict[str, _Tag] = {}
        self._least: dict[str, tuple[float, float]] = {}  # next result of ``least_ages_s``
        self._recent: deque[tuple[float, float]] = deque(maxlen=_MAX_AGES)  # arrival times of fixes, and their ages

    def add_fix(self, name: str, unix_s: float, latency_s: float, now_s: float) -> float:
        """Add a fix that arrives now and whose last frame ended at ``unix_s`` by the tag's clock. Returns its age."""
        tag = self._tags.get(name)
        if tag is None:
            tag = self._tags[name] = _Tag(now_s)
        if unix_s < tag.unix_s:
            tag.begin(now_s)
        elif now_s - tag.begun_s >= _WINDOW_S:
            tag.begun_s, tag.before_s, tag.least_s = now_s, tag.least_s, float("inf")
        made_s = max(latency_s, 0.0)
        delay_s = now_s - unix_s - made_s
        tag.unix_s, tag.least_s = unix_s, min(tag.least_s, delay_s)
        if now_s - tag.delay_seen_s < _HEALTH_AGE_S:
            travelled_s = tag.delay_s
        else:
            travelled_s = delay_s - min(tag.least_s, tag.before_s)
        age_s = made_s + travelled_s
        if name not in self._least or age_s < self._least[name][0]:
            self._least[name] = age_s, made_s
        self._recent.append((now_s, age_s))
        return age_s

    def add_health(self, name: str, delay_s: float, now_s: float) -> None:
        """Add the travel time of a health message from a tag of this computer."""
        if name in self._tags:
            self._tags[name].delay_s, self._tags[name].delay_seen_s = max(delay_s, 0.0), now_s

    def least_ages_s(self) -> dict[str, tuple[float, float]]:
        """By tag: the least age of its fixes since the last call, and the part of it until the fix was made.

        Using the least, a burst of messages that briefly waited for this program counts as the youngest of them.
        """
        found, self._least = self._least, {}
        return found

    def percentiles_s(self, now_s: float) -> tuple[float | None, float | None]:
        """Median and 99th percentile of the ages in the last ``_RECENT_S``; None without any."""
        while self._recent and now_s - self._recent[0][0] > _RECENT_S:
            self._recent.popleft()
        if not self._recent:
            return None, None
        ages = sorted(age_s for _, age_s in self._recent)
        return ages[(len(ages) - 1) // 2], ages[round(0.99 * (len(ages) - 1))]

    def remove(self, name: str) -> None:
        """Forget a tag."""
        self._tags.pop(name, None)


# The leader of the site's time, and the processors


class LeaderTracker:
    """Tracks which anchor is the master from health messages. If several claim to be, the newest term counts."""

    def __init__(self) -> None:
        self.leader: int | None = None
        self.changes_s: deque[float] = deque(maxlen=_MAX_CHANGES)  # times of the changes, the newest last
        self._masters: dict[int, tuple[float, int]] = {}  # by anchor: time of its last claim, and its term

    def update(self, health: AnchorHealth, time_s: float) -> int | None:
        """Process a health message. Returns the new leader if the leader has changed."""
        if health.role == "master":
            self._masters[health.anchor] = time_s, health.term or 0
        else:
            self._masters.pop(health.anchor, None)
        fresh = {a: term for a, (seen_s, term) in self._masters.items() if abs(time_s - seen_s) <= _LEADER_AGE_S}
        if not fresh:
            return None
        newest = max(fresh, key=lambda anchor: (fresh[anchor], anchor == self.leader, -anchor))
        if newest == self.leader:
            return None
        first = self.leader is None
        self.leader = newest
        if first:
            return None
        self.changes_s.append(time_s)
        return newest


class ProcessorUse:
    """Measures processor use from the system's counters."""

    def __init__(self, counters: Path = Path("/proc/stat")) -> None:
        self._counters = counters
        self._samples: deque[tuple[float, int, int]] = deque()
        """Time of the sample, idle ticks and all ticks, of all processors together."""

    def share(self, now_s: float) -> float | None:
        """Share of all processors' time in use in the last ``USE_WINDOW_S``.

        None at first, and if the system does not tell.
        """
        try:
            with self._counters.open(encoding="ascii") as counters:
                ticks = [int(word) for word in counters.readline().split()[1:9]]
            self._samples.append((now_s, ticks[_IDLE] + ticks[_IO_WAIT], sum(ticks)))
        except (OSError, ValueError, IndexError):
            self._samples.clear()
            return None
        while len(self._samples) > 1 and now_s - self._samples[1][0] >= USE_WINDOW_S:
            self._samples.popleft()
        then_s, idle_then, all_then = self._samples[0]
        _, idle, all_ = self._samples[-1]
        if now_s - then_s < USE_WINDOW_S or all_ <= all_then:
            return None
        return min(max(1.0 - (idle - idle_then) / (all_ - all_then), 0.0), 1.0)
