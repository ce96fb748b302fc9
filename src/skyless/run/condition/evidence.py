"""Evidence of a live site's condition, beside its table of nodes: integrity alerts, ages of fixes, the leader. No I/O.

``now_s`` is always the reader's monotonic clock, ``unix_s`` its wall clock.
"""

from collections import deque
from pathlib import Path
from typing import Final

from msgspec import Struct

from skyless.run.mqtt.messages import AnchorHealth, FixMessage, StatusMessage, TagHealth
from skyless.run.site_table import THRESHOLDS, Health, Node, SiteTable

ALERTS: Final[dict[str | None, int]] = {"detected-excluded": 1, "detected-not-excluded": 2, "alert-limit-exceeded": 2}
"""Grades of reported integrity alerts: 1 if the position is still sound, 2 if it may be wrong."""

ALERT_WORDS: Final = {
    "detected-excluded": "a faulty anchor is excluded",
    "detected-not-excluded": "a fault is not excluded, so that the position may be wrong",
    "alert-limit-exceeded": "the protection level is above the alert limit",
}

_WINDOW_S: Final = 60.0
_RECENT_S: Final = 10.0
"""Period of the ages in the percentiles, long enough for tags with one fix per second."""

_MAX_CHANGES: Final = 100

USE_WINDOW_S: Final = 2.0
"""Time over which processor use is averaged."""

_IDLE, _IO_WAIT = 3, 4
"""Columns of idle time in the first line of ``/proc/stat``."""


class Evidence:
    """A site's table, and what else its condition depends on. Messages are added to the table by these methods."""

    def __init__(self, table: SiteTable) -> None:
        self.table = table
        self.hub_trouble: str | None = None  # at a hub: why it is not connected
        self.alerts: dict[str, str] = {}  # by tag: the worst alert of its fixes since the last evaluation
        self.ages = FixAges()
        self.leader = LeaderTracker()

    def add_status(self, status: StatusMessage, now_s: float) -> bool:
        """Add a status. Returns whether a tag that was there has gone with it."""
        if not status.online:
            self.alerts.pop(status.name, None)
            self.ages.remove(status.name)
        return self.table.add_status(status, now_s)

    def add_health(self, kind: str, name: str, health: Health, now_s: float, unix_s: float) -> None:
        """Add a node's health."""
        self.table.add_health(kind, name, health, now_s)
        if isinstance(health, AnchorHealth):
            self.leader.update(health, now_s)
        elif isinstance(health, TagHealth) and (node := self.table.get("tag", name)) and node.host == self.table.host:
            self.ages.add_health(name, unix_s - health.unix_s, now_s)

    def add_fix(self, fix: FixMessage, now_s: float, unix_s: float, *, batched: bool = False) -> Node | None:
        """Add a fix of a tag; None for one that is not used (``SiteTable.add_fix``)."""
        node = self.table.add_fix(fix, now_s, batched=batched)
        if node is not None:
            self.note_alert(fix.tag, fix.alert)
            node.ended_unix_s = unix_s - self.ages.add_fix(fix.tag, fix.unix_s, fix.latency_s, now_s)
        return node

    def note_alert(self, tag: str, alert: str | None) -> None:
        """Note the integrity alert of a fix, if it is worse than those since the last evaluation."""
        if ALERTS.get(alert, 0) > ALERTS.get(self.alerts.get(tag), 0):
            self.alerts[tag] = str(alert)

    def has_fix(self, tag: Node, now_s: float) -> bool:
        """Whether a tag has a fresh fix, or sleeps, or has just woken."""
        return now_s - tag.asleep_until_s < THRESHOLDS.grace_s or self.table.is_fresh(tag, now_s)

    def missed(self, now_s: float) -> list[str]:
        """Tags known only from batches that have gone, and not for long."""
        table = self.table
        gone = [tag for tag in table.batched.values() if tag.is_gone]
        return [tag.name for tag in gone if now_s - tag.fix_s < table.longest_silence_s(tag)]

    def computer(self, host: str) -> str:
        """Name a computer in words. An unknown one counts as this one."""
        return "this computer" if host in {"", self.table.host} else f"computer {host}"


# Ages of fixes


class _Tag(Struct):
    """Delays of one tag's messages: ``now_s`` of arrival less ``unix_s`` of sending, including the clock difference."""

    begun_s: float
    least_s: float = float("inf")
    before_s: float = float("inf")
    """Least delays in the window that began then, and in the one before."""
    unix_s: float = float("-inf")
    """Of the last fix."""
    delay_s: float = 0.0
    delay_seen_s: float = float("-inf")
    """Delay of the last health message, if this computer sent it, and its time of arrival."""


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
        self._recent: deque[tuple[float, float]] = deque(maxlen=4096)  # arrival times of the newest fixes, and ages

    def add_fix(self, name: str, unix_s: float, latency_s: float, now_s: float) -> float:
        """Add a fix that arrives now and whose last frame ended at ``unix_s`` by the tag's clock. Returns its age."""
        tag = self._tags.get(name)
        if tag is None:
            tag = self._tags[name] = _Tag(now_s)
        if unix_s < tag.unix_s:
            tag.begun_s, tag.least_s, tag.before_s = now_s, float("inf"), float("inf")
        elif now_s - tag.begun_s >= _WINDOW_S:
            tag.begun_s, tag.before_s, tag.least_s = now_s, tag.least_s, float("inf")
        made_s = max(latency_s, 0.0)
        delay_s = now_s - unix_s - made_s
        tag.unix_s, tag.least_s = unix_s, min(tag.least_s, delay_s)
        if now_s - tag.delay_seen_s < THRESHOLDS.fresh_s:
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
        fresh = {a: term for a, (seen_s, term) in self._masters.items() if abs(time_s - seen_s) <= THRESHOLDS.report_s}
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
