"""What a process uses of its machine."""

import os
import resource
import sys
import time
from pathlib import Path


class Usage:
    """Share of a core since the last question, and resident memory."""

    def __init__(self) -> None:
        self._wall_s = time.monotonic()
        self._cpu_s = time.process_time()

    def take(self) -> tuple[float, int]:
        """Share of a core since the last call, and resident memory in bytes."""
        wall_s, cpu_s = time.monotonic(), time.process_time()
        share = (cpu_s - self._cpu_s) / max(wall_s - self._wall_s, 1e-9)
        self._wall_s, self._cpu_s = wall_s, cpu_s
        return share, resident_bytes()


def resident_bytes() -> int:
    """Resident memory of this process, its peak where the system does not tell the present."""
    try:
        pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    except (OSError, IndexError, ValueError):
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        return peak if sys.platform == "darwin" else peak * 1024
    return pages * os.sysconf("SC_PAGE_SIZE")
