"""Fixes of one site from JSON to batches. No I/O: the caller passes in the time."""

from collections import Counter, deque
from collections.abc import Mapping
from itertools import count
from typing import Final

import msgspec

from skyless.run.fix_batch import MAX_RECORDS, Batch, records_of
from skyless.run.mqtt.messages import FixMessage

MAX_WAITING: Final = 100_000
"""Fixes that wait for the stream. The oldest are dropped beyond it, and counted."""


class Packer:
    """Takes fixes one by one and gives them in batches. ``run`` is the random number of this start."""

    def __init__(self, run: int) -> None:
        self.fixes, self.simulated = 0, False
        self.drops: Counter[str] = Counter()
        self._run, self._sequences = run, count(1)
        self._waiting: deque[FixMessage] = deque(maxlen=MAX_WAITING)
        self._next: list[FixMessage] = []
        self._decoder = msgspec.json.Decoder(FixMessage)

    @property
    def waiting(self) -> int:
        """Fixes that are in no batch yet."""
        return len(self._waiting) + len(self._next)

    def add(self, name: str, payload: bytes) -> None:
        """Add a ``FixMessage`` in JSON that came under a tag's name. What cannot be used is counted in ``drops``."""
        try:
            fix = self._decoder.decode(payload)
        except (msgspec.MsgspecError, ValueError, RecursionError):
            self.drops["wrong"] += 1
            return
        if fix.tag != name:
            self.drops["wrong"] += 1
            return
        if len(self._waiting) == MAX_WAITING:
            self.drops["late"] += 1
        self.fixes += 1
        self._waiting.append(fix)

    def next_tags(self) -> list[str]:
        """The tag of each fix of the next batch: of the oldest that wait. They need numbers first."""
        if not self._next:
            self._next = [self._waiting.popleft() for _ in range(min(len(self._waiting), MAX_RECORDS))]
        return [fix.tag for fix in self._next]

    def next_batch(self, numbers: Mapping[str, int], issue: int, now_unix_s: float) -> Batch | None:
        """The fixes of ``next_tags``; None where none of these tags has a number."""
        fixes, self._next = self._next, []
        taken = [(numbers[fix.tag], fix) for fix in fixes if fix.tag in numbers]
        if len(taken) < len(fixes):
            self.drops["no-number"] += len(fixes) - len(taken)
        if not taken:
            return None
        records = records_of(taken, simulated=self.simulated)
        return Batch(self._run, next(self._sequences), round(1e6 * now_unix_s), issue, records)
