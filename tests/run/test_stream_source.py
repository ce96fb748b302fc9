"""Batches of a stream into a history: each once, with the names that come later, and what is missing is counted."""

from types import SimpleNamespace

import numpy as np
import pytest
from nats.errors import Error

from skyless.run.fix_batch import RECORD, Batch, encode_batch
from skyless.run.gather.streams import TagName
from skyless.run.history import program
from skyless.run.history.program import BatchTaker
from skyless.run.history.writer import Writer

SITE, BEGIN_S = 7, 1_800_000_000


class LateNames:
    """A table of names of which each reading brings one more."""

    def __init__(self, names):
        self.tags, self.issue, self.readings = {}, 0, 0
        self._coming = dict(enumerate(names, 1))

    async def read(self):
        self.readings += 1
        if self.issue < len(self._coming):
            self.issue += 1
            self.tags[self.issue] = TagName(self._coming[self.issue], "host", 1.0)


def message(place, run, sequence, *tags, issue=0):
    records = np.zeros(len(tags), RECORD)
    records["tag"], records["unix_us"] = tags, 1_000_000 * (BEGIN_S + place)
    data = encode_batch(Batch(run, sequence, 1, issue or max(tags), records))
    return SimpleNamespace(data=data, metadata=SimpleNamespace(sequence=SimpleNamespace(stream=place)))


@pytest.fixture
def writer(tmp_path):
    made = Writer(tmp_path, SITE)
    yield made
    made.close()


@pytest.fixture
def quick(monkeypatch):
    monkeypatch.setattr(program, "_PERIOD_S", 0.0)


async def take(writer, names, *messages):
    taker = BatchTaker(names, writer, lambda _line: None)
    for one in messages:
        await taker.take(one)


async def test_each_batch_is_taken_once_and_gaps_are_counted(writer):
    names = LateNames("a")
    again = message(3, 5, 2, 1)
    await take(writer, names, message(1, 5, 1, 1), message(2, 5, 2, 1), again, message(4, 5, 6, 1), message(9, 6, 3, 1))
    assert writer.fixes.taken == 4
    assert writer.fixes.place.number == 9
    assert writer.drops["lost-batches"] == 3  # of run 5; where run 6 began is not known
    await take(writer, names, message(9, 6, 3, 1), message(10, 6, 4, 1))  # another start goes on after its place
    assert writer.fixes.taken == 5


@pytest.mark.usefixtures("quick")
async def test_a_batch_waits_for_its_names(writer):
    names = LateNames("abc")
    await take(writer, names, message(1, 5, 1, 1, 3), message(2, 5, 2, 2))
    assert (names.readings, sorted(writer.names.rows), writer.drops["no-name"]) == (3, ["a", "b", "c"], 0)


@pytest.mark.usefixtures("quick")
async def test_names_that_never_come_hold_a_history_up_once(writer, monkeypatch):
    monkeypatch.setattr(program, "_NAMES_S", 0.05)
    names = LateNames("a")
    await take(writer, names, message(1, 5, 1, 1, 2, issue=2))
    readings = names.readings
    await take(writer, names, message(2, 5, 2, 1))
    assert (writer.fixes.taken, writer.drops["no-name"], names.readings) == (2, 1, readings)


@pytest.mark.usefixtures("quick")
async def test_a_batch_waits_while_its_names_cannot_be_read(writer, monkeypatch):
    names, lines = LateNames("a"), []
    answers, read = iter([Error("timeout"), Error("timeout")]), names.read

    async def fail_twice():
        if (error := next(answers, None)) is not None:
            raise error
        await read()

    monkeypatch.setattr(names, "read", fail_twice)
    await BatchTaker(names, writer, lines.append).take(message(1, 5, 1, 1))
    assert lines == ["the names of site 7 cannot be read: timeout"]
    assert (writer.fixes.taken, writer.drops["no-name"]) == (1, 0)


async def test_bytes_that_are_no_batch_are_counted(writer):
    broken = message(1, 5, 1, 1)
    broken.data = b"SKB?"
    await take(writer, LateNames(""), broken)
    assert writer.drops["wrong-batch"] == 1
