"""Fixes and names of a site as its streams keep them, for programs that read all of them in order."""

import asyncio
import contextlib
from collections.abc import AsyncGenerator, AsyncIterator

from nats.aio.client import Client
from nats.errors import Error
from nats.errors import TimeoutError as NatsTimeoutError
from nats.js.api import ConsumerConfig, DeliverPolicy

from skyless.run.fix_batch import MAX_RECORDS, BadBatchError, Records, decode_batch
from skyless.run.gather import subjects
from skyless.run.gather.address import NatsAddress, connect
from skyless.run.gather.streams import read_names
from skyless.run.process import Log

_WAIT_S = 5.0
_RETRY_S = 0.5


class StreamSource:
    """Reads the streams of a site. ``async with`` connects it and ends the connection.

    A row's number is the number of its batch in the stream times ``MAX_RECORDS``, plus its place in the batch. So a
    reader that stores whole batches continues after its last row, and the server keeps nothing about it.
    """

    def __init__(self, address: NatsAddress, site: int, log: Log) -> None:
        self.wrong = 0
        """Messages of the stream that are no batches."""
        self._address, self._site, self._log = address, site, log
        self._client: Client

    async def __aenter__(self) -> "StreamSource":
        self._client = await connect(self._address, "skyless history", self._on_error)
        return self

    async def __aexit__(self, *_: object) -> None:
        await self._client.close()

    async def _on_error(self, error: Exception) -> None:
        self._log(f"NATS server {self._address}: {error or type(error).__name__}")

    async def names(self) -> dict[int, str]:
        """The name of each number. Raises nats.errors.Error where the site has no gather, or the server is away."""
        found = await read_names(self._client.jetstream(), self._site)
        return {number: tag.name for number, tag in found.items()}

    async def rows(self, after: int = -1) -> AsyncIterator[tuple[int, Records]]:
        """The first row's number and the records of each batch after a row, for ever, in the order of the stream.

        Batches that the stream has dropped, or keeps no longer, are missing. It waits for a server that is away.
        """
        last = max(after, 0) // MAX_RECORDS
        while True:
            with contextlib.suppress(Error):
                async with contextlib.aclosing(self._messages(last + 1)) as messages:
                    async for last, data in messages:
                        try:
                            records = decode_batch(data).records
                        except BadBatchError:
                            self.wrong += 1
                        else:
                            yield last * MAX_RECORDS, records
            await asyncio.sleep(_RETRY_S)

    async def _messages(self, first: int) -> AsyncGenerator[tuple[int, bytes], None]:
        """Number and bytes of each message from a number on, until the server stops sending."""
        name = subjects.at(subjects.FIX_STREAM, self._site)
        stream = self._client.jetstream()
        config = ConsumerConfig(deliver_policy=DeliverPolicy.BY_START_SEQUENCE, opt_start_seq=first)
        subject = subjects.at(subjects.FIXES, self._site)
        reading = await stream.subscribe(subject, stream=name, ordered_consumer=True, config=config)
        try:
            while True:
                try:
                    message = await reading.next_msg(_WAIT_S)
                except NatsTimeoutError:
                    if (await stream.stream_info(name)).state.last_seq >= first:
                        return  # the server has lost the consumer
                    continue
                first = message.metadata.sequence.stream + 1
                yield first - 1, message.data
        finally:
            with contextlib.suppress(Error):
                await reading.unsubscribe()
