"""What a node logs about its radio: that it is ready or gone, and where to look when it receives nothing usable."""

from collections import Counter
from collections.abc import Callable, Mapping
from typing import Final

from msgspec import Struct

from skyless.radio.interface import Gone, Hint, Restarted
from skyless.run.process import Log

UNUSABLE_S: Final = 5.0
"""A node that has received nothing usable for this time logs it."""
REPEAT_S: Final = 60.0
"""The same line is not logged again within this time, however often reception comes and goes."""

_MEANING: Final = {
    "foreign-site": "those are of another site than asked for",
    "unknown-anchor": "those are of anchors that the site, or the table of anchors, does not know",
    "not-a-beacon": "those are frames of another system",
    "unknown-version": "those anchors run another release",
    "bad-fcs": "those are damaged: too weak, or their end is cut off",
    "too-short": "those are frames of another system, or cut off",
    "stale-master": "those follow a master that has been replaced",
    "rx-error": "frames that cannot be read: too weak, reflected, or sent with other settings",
    "malformed-line": "lines of another format, or another rate",
    "bytes-of-no-record": "bytes of another format, or another rate",
    "garbled-record": "the line loses bytes",
    "late-reception": "those were too old at their turn: this computer is too slow",
}


class _Counts(Struct, frozen=True):
    """What had been counted at a moment."""

    now_s: float
    received: int
    used: int
    drops: Counter[str]


class RadioMonitor:
    """Watches the radio of one node. ``advice`` is asked of the radio when nothing at all has come from it."""

    def __init__(self, name: str, ready: str, log: Log, advice: Callable[[], str]) -> None:
        """``ready`` says in words what the node does once its radio has started."""
        self.restarts = 0
        self._name, self._ready, self._log, self._advice = name, ready, log, advice
        self._present = False
        self._since: _Counts | None = None
        self._reported: tuple[str, str] | None = None
        self._logged_s: dict[tuple[str, str], float] = {}

    def on_event(self, event: Restarted | Gone | Hint) -> None:
        """Log a change of the radio's state; after ``Restarted`` counts may begin again at 0."""
        if isinstance(event, Restarted):
            self.restarts += 1
            self._present, self._since = True, None
            self._log(f"{self._name}: {self._ready}" + (" again" if self.restarts > 1 else ""))
        elif isinstance(event, Gone):
            self._present = False
            self._log(f"{self._name}: {event.reason}; still looking for it")
        else:
            self._log(f"{self._name}: {event.text}")

    def check(self, now_s: float, received: int, used: int, drops: Mapping[str, int]) -> None:
        """Log where to look if for ``UNUSABLE_S`` nothing was usable; to be called every second or so.

        ``now_s`` is the host's monotonic clock; ``received`` and ``used`` count frames, ``drops`` what could not be
        used, by reason; all since ``Restarted`` or before.
        """
        if not self._present or (self._since is not None and now_s - self._since.now_s < UNUSABLE_S):
            return
        before, self._since = self._since, _Counts(now_s, received, used, Counter(drops))
        if before is None:
            return
        if used != before.used:
            self._reported = None
            return
        self._report(now_s, received - before.received, self._since.drops - before.drops)

    def _report(self, now_s: float, received: int, drops: Counter[str]) -> None:
        reason, count = drops.most_common(1)[0] if drops else ("", 0)
        most = f"; most counted: {reason} ({count})" if reason else ""
        meaning = f", {_MEANING[reason]}" if reason in _MEANING else ""
        subject = "" if received else self._advice()
        key = subject, reason
        if key == self._reported:
            return
        self._reported = key
        if now_s - self._logged_s.get(key, -REPEAT_S) >= REPEAT_S:
            self._logged_s[key] = now_s
            what = subject or f"{received} frames have come"
            self._log(f"{self._name}: nothing usable for {UNUSABLE_S:.0f} s; {what}{most}{meaning}")
