"""Which findings of the watch are news, as lines for the log."""

from collections.abc import Iterable
from typing import Final

from skyless.mqtt.messages import WatchFinding

_SAME_SIZE: Final = 0.25
"""A finding whose size has changed by a smaller share than this is not news."""


class FindingsLog:
    """The findings that have been logged and are not over."""

    def __init__(self) -> None:
        self._logged: dict[tuple[str, tuple[int, ...]], WatchFinding] = {}

    def update(self, findings: Iterable[WatchFinding]) -> tuple[list[str], bool]:
        """Lines for what is new or over, and whether an anchor has newly moved or changed its delay."""
        lines: list[str] = []
        present = {(str(one.kind), one.anchors): one for one in findings}
        for key, one in present.items():
            logged = self._logged.get(key)
            if logged is not None and abs(one.size_m - logged.size_m) < _SAME_SIZE * abs(logged.size_m):
                present[key] = logged
            elif logged is None or one.sentence != logged.sentence:
                lines.append(one.sentence)
        lines += [f"over: {one.sentence}" for key, one in self._logged.items() if key not in present]
        has_moved = any(kind in ("moved", "delay") for kind, _ in present.keys() - self._logged.keys())
        self._logged = present
        return lines, has_moved
