"""Which anchor leads the site's time, the master or the root of the slot time, and how often that changes. No I/O."""

from collections import deque
from typing import Final

from skyless.mqtt.messages import AnchorHealth

_MAX_AGE_S: Final = 3.5
"""An anchor whose health is older does not count."""
_MOST_CHANGES: Final = 100


class LeaderTracker:
    """Watches the anchors' health; of several that claim to lead, the newest term counts."""

    def __init__(self) -> None:
        self.leader: int | None = None
        self.changes_s: deque[float] = deque(maxlen=_MOST_CHANGES)
        """Times of the changes, the newest last."""
        self._claims: dict[int, tuple[float, int]] = {}
        """By anchor that leads: when it last said so, and its term."""

    def update(self, health: AnchorHealth, time_s: float) -> int | None:
        """Process a health message; the new leader if another one leads from now on."""
        if health.role in {"master", "root"}:
            self._claims[health.anchor] = time_s, health.term or 0
        else:
            self._claims.pop(health.anchor, None)
        fresh = {a: term for a, (seen_s, term) in self._claims.items() if abs(time_s - seen_s) <= _MAX_AGE_S}
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
