"""How much of this computer's processors is in use, as Linux counts it for all programs together."""

from collections import deque
from pathlib import Path
from typing import Final

USE_WINDOW_S: Final = 2.0
"""Time over which the use is averaged."""

_IDLE, _IO_WAIT = 3, 4
"""Columns of the first line of ``/proc/stat`` that count time in which a processor had nothing to do."""


class ProcessorUse:
    """Samples the counters of the system."""

    def __init__(self, counters: Path = Path("/proc/stat")) -> None:
        self._counters = counters
        self._samples: deque[tuple[float, int, int]] = deque()
        """Time of the sample, and ticks of all processors together: idle ones and all."""

    def share(self, now_s: float) -> float | None:
        """Share of all processors' time that was in use in the last ``USE_WINDOW_S``.

        None at first, and where the system does not say.
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
