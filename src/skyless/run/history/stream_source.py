"""Fixes of a large site for its history: from the stream that a gather fills, instead of from MQTT."""

import asyncio
import time
from typing import TYPE_CHECKING, Final

import numpy as np
from nats.errors import Error
from nats.js.errors import NotFoundError

from skyless.run.fix_batch import BadBatchError, Records, decode_batch
from skyless.run.gather import subjects
from skyless.run.gather.address import NatsAddress, connect, rarely
from skyless.run.gather.names import Names
from skyless.run.gather.streams import messages
from skyless.run.history.writer import MAX_UNIX_S, Writer
from skyless.run.process import Log

if TYPE_CHECKING:
    from nats.js import JetStreamContext

_PERIOD_S: Final = 0.2
_MAX_WAITING: Final = 100_000
"""While more rows than this wait for the disk, others stay in the stream."""


async def take_stream(address: NatsAddress, writer: Writer, log: Log) -> None:
    """Give the batches of a site's stream to a history until cancelled, from where it stopped the last time.

    The place in the stream is kept together with the rows, so that each batch is taken once.
    """
    say = rarely(log)
    client = await connect(address, "skyless history", say, writer.drops)
    try:
        stream = client.jetstream()
        names = Names(stream, writer.site)
        while True:
            try:
                await _take_waiting(stream, names, writer)
            except NotFoundError:
                say(f"no gather has gathered site {writer.site} at {address} yet")
            except Error as error:
                say(f"the stream of site {writer.site} cannot be read: {error or type(error).__name__}")
            await asyncio.sleep(_PERIOD_S)
    finally:
        await client.close()


async def _take_waiting(stream: "JetStreamContext", names: Names, writer: Writer) -> None:
    """Take what the stream has now, as long as the disk takes it."""
    found = messages(stream, subjects.at(subjects.FIX_STREAM, writer.site), writer.fixes.position)
    async for message in found:
        place = message.metadata.sequence.stream
        try:
            batch = decode_batch(message.data)
        except BadBatchError:
            writer.drops["wrong-batch"] += 1
            continue
        if batch.names_issue > names.issue:
            await names.read()
        now_s = time.time()
        writer.fixes.add(_renumbered(batch.records, names, writer, now_s), now_s, place)
        if writer.fixes.waiting > _MAX_WAITING:
            await found.aclose()
            return


def _renumbered(records: Records, names: Names, writer: Writer, now_s: float) -> Records:
    """Records that are kept, with the numbers that this history gives to their tags; the others are counted."""
    given, rows = np.unique(records["tag"], return_inverse=True)
    tags = (names.tags.get(int(number)) for number in given)
    own = np.array([(tag and writer.tag_number(tag.name, now_s)) or 0 for tag in tags], np.uint32)[rows]
    in_time = records["unix_us"] <= 1e6 * MAX_UNIX_S
    writer.drops["no-name"] += int(np.count_nonzero(own == 0))
    writer.drops["wrong-time"] += int(np.count_nonzero((own != 0) & ~in_time))
    kept: Records = records[(own != 0) & in_time].copy()
    kept["tag"] = own[(own != 0) & in_time]
    return kept
