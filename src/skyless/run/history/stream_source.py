"""Fixes of a large site for its history: from the stream that a gather fills, instead of from MQTT."""

import asyncio
import time
from typing import TYPE_CHECKING, Final

import numpy as np
from nats.errors import Error

from skyless.run.fix_batch import BadBatchError, Batch, Records, decode_batch
from skyless.run.gather import subjects
from skyless.run.gather.address import NatsAddress, connect, rarely
from skyless.run.gather.names import Names
from skyless.run.gather.streams import follow
from skyless.run.history.writer import Intake, Writer
from skyless.run.limits import HISTORY as LIMITS
from skyless.run.process import Log

if TYPE_CHECKING:
    from nats.aio.msg import Msg
    from nats.js import JetStreamContext

_PERIOD_S: Final = 0.2
_RETRY_S: Final = 2.0
_MAX_WAITING: Final = 100_000
"""While more rows than this wait for the disk, others stay in the stream."""
_NAMES_S: Final = 60.0
"""How long the names of a batch may come later than itself: at a hub, streams catch up one after the other."""
_MAX_SENDERS: Final = 1000


class BatchTaker:
    """Gives the batches of a stream to a history, each once."""

    def __init__(self, names: Names, writer: Writer, log: Log) -> None:
        self._names, self._writer, self._say = names, writer, rarely(log)
        self._sequences: dict[int, int] = {}
        """The last sequence of each run of a sender."""
        self._given_up = 0
        """Names with numbers up to this did not come in time."""

    async def take(self, message: "Msg") -> None:
        """Take the batch of a message, unless it is known. Waits for the disk, and for the names of its tags."""
        while self._writer.fixes.waiting > _MAX_WAITING:
            await asyncio.sleep(_PERIOD_S)
        place = message.metadata.sequence.stream
        if place <= self._writer.fixes.position:
            return
        try:
            batch = decode_batch(message.data)
        except BadBatchError:
            self._writer.drops["wrong-batch"] += 1
            return
        if not self._is_next(batch):
            return
        await self._read_names(batch.names_issue)
        now_s = time.time()
        self._writer.fixes.add(self._renumbered(batch.records, now_s), now_s, place)

    def _is_next(self, batch: Batch) -> bool:
        """Whether a batch is new. Those before it that the stream does not have any more are counted."""
        before = self._sequences.pop(batch.run, None)
        self._sequences[batch.run] = max(batch.sequence, before or 0)
        if len(self._sequences) > _MAX_SENDERS:
            del self._sequences[next(iter(self._sequences))]
        if before is not None and batch.sequence > before + 1:
            lost = batch.sequence - before - 1
            self._writer.drops["lost-batches"] += lost
            self._say(f"site {self._writer.site}: {lost} batches were dropped before they could be read")
        return before is None or batch.sequence > before

    async def _read_names(self, issue: int) -> None:
        deadline_s = time.monotonic() + _NAMES_S
        while self._names.issue < issue > self._given_up:
            try:
                await self._names.read()
            except Error as error:
                self._say(f"the names of site {self._writer.site} cannot be read: {error or type(error).__name__}")
                deadline_s = time.monotonic() + _NAMES_S
            if self._names.issue < issue:
                if time.monotonic() > deadline_s:
                    self._given_up = issue
                await asyncio.sleep(_PERIOD_S)

    def _renumbered(self, records: Records, now_s: float) -> Records:
        """Records that are kept, with the numbers that this history gives to their tags; the others are counted."""
        writer = self._writer
        given, rows = np.unique(records["tag"], return_inverse=True)
        tags = (self._names.tags.get(int(number)) for number in given)
        own = np.array([(tag and writer.tag_number(tag.name, now_s)) or 0 for tag in tags], np.uint32)[rows]
        in_time = (records["unix_us"] >= 1e6 * LIMITS.first_unix_s) & (records["unix_us"] <= 1e6 * LIMITS.last_unix_s)
        writer.drops["no-name"] += int(np.count_nonzero(own == 0))
        writer.drops["wrong-time"] += int(np.count_nonzero((own != 0) & ~in_time))
        kept: Records = records[(own != 0) & in_time].copy()
        kept["tag"] = own[(own != 0) & in_time]
        return kept


async def first_place(stream: "JetStreamContext", name: str, intake: Intake, say: Log) -> int:
    """The place in a stream up to which an intake has all. Waits for the stream."""
    while True:
        try:
            last = (await stream.stream_info(name)).state.last_seq
            break
        except Error as error:
            say(f"waits for the stream {name}, which a gather or skyless hub apply makes: {error or 'no answer'}")
            await asyncio.sleep(_RETRY_S)
    if intake.position > last:
        say(f"the stream {name} was deleted and made again; it is taken from its beginning")
        intake.position = 0
    return intake.position


async def take_batches(stream: "JetStreamContext", writer: Writer, say: Log) -> None:
    """Give the batches of a site's stream to a history until cancelled, from where it stopped the last time.

    The place in the stream is kept together with the rows, so that each batch is taken once.
    """
    name, own = subjects.at(subjects.FIX_STREAM, writer.site), subjects.at(subjects.FIXES, writer.site)
    taker = BatchTaker(Names(stream, writer.site), writer, say)
    async for message in follow(stream, name, own, say, await first_place(stream, name, writer.fixes, say)):
        await taker.take(message)


async def take_stream(address: NatsAddress, writer: Writer, log: Log) -> None:
    """The same with a connection of its own."""
    say = rarely(log)
    client = await connect(address, "skyless history", say, writer.drops)
    try:
        await take_batches(client.jetstream(), writer, say)
    finally:
        await client.close()
