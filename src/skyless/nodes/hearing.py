"""What a node that hears nothing of use says: where to look, once, and again when that changes."""

from collections import Counter
from collections.abc import Callable, Mapping
from typing import Final

from msgspec import Struct

from skyless.nodes.process.running import Log

LOOK_S: Final = 5.0
"""So long is a node without anything of use before it says so."""
AGAIN_S: Final = 60.0
"""The same is not said again within this time, however often hearing comes and goes."""

_MEANING: Final = {
    "foreign-site": "those are of another site than asked for",
    "unknown-anchor": "those are of anchors that the site, or the table of anchors, does not know",
    "not-a-beacon": "those are frames of another system",
    "unknown-version": "those anchors run another release",
    "bad-fcs": "those are damaged: too weak, or their end is cut off",
    "too-short": "those are frames of another system, or cut off",
    "stale-master": "those go by a master that is no more",
    "rx-error": "frames that cannot be read: too weak, reflected, or sent with other settings",
    "malformed-line": "lines of another format, or another rate",
    "bytes-of-no-record": "bytes of another format, or another rate",
    "garbled-record": "the line loses bytes",
}


class _Counts(Struct, frozen=True):
    """What had been counted at a moment."""

    now_s: float
    came: int
    used: int
    reasons: Counter[str]


class Hearing:
    """Watches one node's counts. ``advice`` is asked of the radio when nothing at all has come from it."""

    def __init__(self, who: str, say: Log, advice: Callable[[], str]) -> None:
        self._who, self._say, self._advice = who, say, advice
        self._present = False
        self._since: _Counts | None = None
        self._told: tuple[str, str] | None = None
        self._said_s: dict[tuple[str, str], float] = {}

    def begin(self) -> None:
        """The radio is there, and counts may begin anew."""
        self._present, self._since = True, None

    def end(self) -> None:
        """It has gone, which was said."""
        self._present = False

    def look(self, now_s: float, came: int, used: int, reasons: Mapping[str, int]) -> None:
        """Log where to look if for ``LOOK_S`` nothing was of use; to be called every second or so.

        ``came`` and ``used`` count frames, ``reasons`` what could not be used; all since ``begin`` or before.
        """
        if not self._present or (self._since is not None and now_s - self._since.now_s < LOOK_S):
            return
        before, self._since = self._since, _Counts(now_s, came, used, Counter(reasons))
        if before is None:
            return
        if used != before.used:
            self._told = None
            return
        self._tell(now_s, came - before.came, self._since.reasons - before.reasons)

    def _tell(self, now_s: float, came: int, reasons: Counter[str]) -> None:
        reason, times = reasons.most_common(1)[0] if reasons else ("", 0)
        most = f"; most counted: {reason} ({times})" if reason else ""
        means = f", {_MEANING[reason]}" if reason in _MEANING else ""
        subject = "" if came else self._advice()
        key = subject, reason
        if key == self._told:
            return
        self._told = key
        if now_s - self._said_s.get(key, -AGAIN_S) >= AGAIN_S:
            self._said_s[key] = now_s
            what = subject or f"{came} frames have come"
            self._say(f"{self._who}: nothing of use for {LOOK_S:.0f} s; {what}{most}{means}")
