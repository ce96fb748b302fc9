"""How old fixes are when they arrive, by the page server's monotonic clock. No I/O; the time is passed in.

A fix was made ``latency_s`` after its last frame, by one clock, the tag's; that part is exact. How long its message
then travelled follows for tags of this computer, whose clock is the server's, from their health messages. For others
it is measured against the quickest message of the tag in the last one to two minutes, so that clocks which differ, or
are set, raise no alarm; a delay that was the same from the first message on looks like a clock that differs. A fix
whose time is before that of the fix before it shows that the clock was set back: then the minutes begin again. A clock
that is set back by less than the interval of the fixes looks like a delay until they have passed.
"""

from collections import deque
from typing import Final

_WINDOW_S: Final = 60.0
_HEALTH_AGE_S: Final = 2.5
"""The delay of a health message holds for this long."""

_RECENT_S: Final = 10.0
"""Percentiles are of the ages of this time, so that they are steady where tags have a fix a second."""

_MOST_AGES: Final = 4096
"""Of more fixes the newest count."""


class _Tag:
    """Delays of one tag's messages: ``now_s`` of arrival less ``unix_s`` of sending, so with the clocks' difference."""

    __slots__ = ("before_s", "begun_s", "delay_s", "delay_seen_s", "least_age_s", "least_s", "made_s", "unix_s")

    def __init__(self, now_s: float) -> None:
        self.begin(now_s)
        self.unix_s = float("-inf")
        """Of the last fix."""
        self.delay_s, self.delay_seen_s = 0.0, float("-inf")
        """Of the last health message, where this computer sent it, and when it arrived."""
        self.least_age_s: float | None = None
        """Of the fixes since the last ``least_ages_s``."""
        self.made_s = 0.0
        """Its part until the fix was made."""

    def begin(self, now_s: float) -> None:
        """Begin the window; what was before does not count."""
        self.begun_s = now_s
        self.least_s = self.before_s = float("inf")
        """The least in the window that has begun, and in the one before."""


class FixAges:
    """Ages of fixes on arrival: the least of each tag, and all of them together."""

    def __init__(self) -> None:
        self._tags: dict[str, _Tag] = {}
        self._recent: deque[tuple[float, float]] = deque(maxlen=_MOST_AGES)
        """When fixes arrived, and their ages."""

    def add_fix(self, name: str, unix_s: float, latency_s: float, now_s: float) -> float:
        """Add a fix whose last frame ended at ``unix_s`` by the tag's clock, and that arrives now; returns its age."""
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
        if tag.least_age_s is None or age_s < tag.least_age_s:
            tag.least_age_s, tag.made_s = age_s, made_s
        self._recent.append((now_s, age_s))
        return age_s

    def add_health(self, name: str, delay_s: float, now_s: float) -> None:
        """Add how long a health message of a tag of this computer has travelled."""
        if name in self._tags:
            self._tags[name].delay_s, self._tags[name].delay_seen_s = max(delay_s, 0.0), now_s

    def least_ages_s(self) -> dict[str, tuple[float, float]]:
        """By tag: the least age of its fixes since the last call, and the part of it until the fix was made.

        The least, so that a burst of messages that waited for this program for a moment counts as its youngest.
        """
        found = {}
        for name, tag in self._tags.items():
            if tag.least_age_s is not None:
                found[name] = tag.least_age_s, tag.made_s
                tag.least_age_s = None
        return found

    def percentiles_s(self, now_s: float) -> tuple[float | None, float | None]:
        """Median and 99th percentile of all ages of the last ``_RECENT_S``; None without any."""
        while self._recent and now_s - self._recent[0][0] > _RECENT_S:
            self._recent.popleft()
        if not self._recent:
            return None, None
        ages = sorted(age_s for _, age_s in self._recent)
        return ages[(len(ages) - 1) // 2], ages[round(0.99 * (len(ages) - 1))]

    def remove(self, name: str) -> None:
        """Forget a tag."""
        self._tags.pop(name, None)
