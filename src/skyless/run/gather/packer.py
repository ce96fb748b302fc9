"""Fixes of one site from JSON to batches, and the numbers of its tags. No I/O: the caller passes in the time."""

from collections import Counter, deque
from itertools import count, islice
from typing import Final

import msgspec
from msgspec import Struct

from skyless.run.fix_batch import MAX_RECORDS, Batch, PackedFix, encode_batch, records_of

MAX_NAMES: Final = 200_000
MAX_WAITING: Final = 100_000
"""Fixes that wait for the stream. The oldest are dropped beyond it, and counted."""


class TagName(Struct, frozen=True):
    """The name of a tag's number. A number is given once and never again."""

    name: str
    host: str
    """Where its fixes are packed."""
    since_unix_s: float


class NamesTable:
    """The numbers of tags. A number belongs to its name for good, also after a restart."""

    def __init__(self, known: dict[int, TagName]) -> None:
        self.numbers = {tag.name: number for number, tag in known.items()}
        self.issue = max(known, default=0)
        """The largest number that was given. Readers that know fewer read the names again."""
        self.unsaved: dict[int, TagName] = {}
        """Names that are not in the stream yet."""

    def add(self, name: str, host: str, now_unix_s: float) -> None:
        """Give a new name a number. A full table gives none."""
        if name not in self.numbers and len(self.numbers) < MAX_NAMES:
            self.numbers[name] = self.issue = self.issue + 1
            self.unsaved[self.issue] = TagName(name, host, now_unix_s)


class ReadyBatch(Struct, frozen=True):
    """A batch to publish."""

    id: str
    """Streams drop a second message with the same id."""
    data: bytes
    fixes: int


class Packer:
    """Takes fixes one by one and gives them in batches. ``run`` is the random number of this start."""

    def __init__(self, run: int, host: str) -> None:
        self.fixes, self.simulated = 0, False
        self.drops: Counter[str] = Counter()
        self._run, self._host = run, host
        self._sequences = count(1)
        self._waiting: deque[PackedFix] = deque(maxlen=MAX_WAITING)
        self._decoder = msgspec.json.Decoder(PackedFix)

    @property
    def waiting(self) -> int:
        """Fixes that are in no batch yet."""
        return len(self._waiting)

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

    def give_numbers(self, names: NamesTable, now_unix_s: float) -> bool:
        """Give the fixes of the next batch their numbers. Whether names are to be saved before it is sent."""
        for fix in islice(self._waiting, MAX_RECORDS):
            names.add(fix.tag, self._host, now_unix_s)
        return bool(names.unsaved)

    def next_batch(self, names: NamesTable, now_unix_s: float) -> ReadyBatch | None:
        """The oldest fixes that wait, at most ``MAX_RECORDS``; None without any that has a number."""
        fixes = [self._waiting.popleft() for _ in range(min(len(self._waiting), MAX_RECORDS))]
        taken = [(names.numbers[fix.tag], fix) for fix in fixes if fix.tag in names.numbers]
        if len(taken) < len(fixes):
            self.drops["no-number"] += len(fixes) - len(taken)
        if not taken:
            return None
        sequence = next(self._sequences)
        records = records_of(taken, simulated=self.simulated)
        batch = Batch(self._run, sequence, round(1e6 * now_unix_s), names.issue, records)
        return ReadyBatch(f"{self._run}-{sequence}", encode_batch(batch), len(taken))
