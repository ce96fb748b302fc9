"""The condition of a site in one word with its reasons, from what passes a gather. No I/O.

It is coarser than that of the site's page, which reads every health: it is for a list of many sites.
"""

import contextlib
from collections import Counter, deque
from collections.abc import Mapping
from typing import Final, Literal

from skyless.run.fix_batch import Records
from skyless.run.mqtt.messages import SiteMessage, StatusMessage, WrongMessageError, read_message

HEARD_S: Final = 10.0
"""A tag without a fix for so long is not heard."""
_DROPS_S: Final = 60.0
_MAX_WAITING: Final = 5_000
_MAX_NAMED: Final = 3

ConditionWord = Literal["good", "degraded", "bad"]


class SiteCondition:
    """What a gather knows of its site."""

    def __init__(self, now_s: float) -> None:
        self.site: SiteMessage | None = None
        self._begin_s = now_s
        self._programs: dict[tuple[str, str], StatusMessage] = {}
        self._heard_s: dict[int, float] = {}
        self._dropped: deque[tuple[float, int]] = deque()

    def on_message(self, kind: str, name: str, payload: bytes) -> None:
        """Take the site, or a program's status. One that cannot be read changes nothing, or says that it is offline."""
        with contextlib.suppress(WrongMessageError):
            if kind == "site":
                self.site = read_message(payload, SiteMessage)
            else:
                self._programs.pop((kind, name), None)
                self._programs[kind, name] = read_message(payload, StatusMessage)

    def on_batch(self, records: Records, now_s: float) -> None:
        """Take the fixes of a batch of this gather or of another program."""
        self._heard_s.update(dict.fromkeys(records["tag"].tolist(), now_s))

    def online(self) -> dict[str, int]:
        """Programs that are online, by kind."""
        return dict(Counter(kind for (kind, _), status in self._programs.items() if status.online))

    def versions(self) -> dict[str, int]:
        """Programs that are online, by version."""
        return dict(Counter(status.version or "unknown" for status in self._programs.values() if status.online))

    def tags_heard(self, now_s: float) -> int:
        """Tags with a fix in the last ten seconds."""
        self._heard_s = {tag: heard_s for tag, heard_s in self._heard_s.items() if now_s - heard_s < HEARD_S}
        return len(self._heard_s)

    def reasons(self, drops: Mapping[str, int], waiting: int, now_s: float) -> tuple[ConditionWord, list[str]]:
        """The condition, and why it is not good. ``drops`` are the gather's since its start."""
        self._dropped.append((now_s, sum(drops.values())))
        while now_s - self._dropped[0][0] > _DROPS_S:
            self._dropped.popleft()
        bad, degraded = [], []
        if self.site is None:
            bad.append("the site is not published: no anchor or emulated air is running")
        if not self.tags_heard(now_s) and now_s - self._begin_s > HEARD_S:
            bad.append(f"no tag has had a fix for {HEARD_S:g} s")
        if offline := self._offline_anchors():
            named = ", ".join(offline[:_MAX_NAMED]) + (" and others" if len(offline) > _MAX_NAMED else "")
            degraded.append(f"{len(offline)} of the anchors offline: {named}")
        if waiting > _MAX_WAITING:
            degraded.append(f"{waiting} fixes wait for the stream")
        if dropped := self._dropped[-1][1] - self._dropped[0][1]:
            degraded.append(f"{dropped} fixes were dropped in the last minute")
        return "bad" if bad else "degraded" if degraded else "good", bad + degraded

    def _offline_anchors(self) -> list[str]:
        """Anchors of the site that have said that they are offline, or whose broker has said so."""
        names = [] if self.site is None else [str(anchor.id) for anchor in self.site.site.anchors]
        found = ((name, self._programs.get(("anchor", name))) for name in names)
        return [name for name, status in found if status is not None and not status.online]
