"""The streams of a site at its NATS server: what they keep, and how they are read."""

import contextlib
from collections.abc import AsyncGenerator
from typing import TYPE_CHECKING, Final

from nats.js.api import ConsumerConfig, DeliverPolicy, RePublish, StorageType, StreamConfig
from nats.js.errors import APIError, NotFoundError

from skyless.core.errors import SkylessError
from skyless.run.gather import subjects

if TYPE_CHECKING:
    from nats.aio.msg import Msg
    from nats.js import JetStreamContext

KEEP_S: Final = 24 * 3600.0
"""How long the stream keeps fixes."""

_NO_ROOM: Final = 10047  # JetStream's code of an error
_DUPLICATES_S: Final = 120.0
_READ_S: Final = 10.0


async def make_streams(stream: "JetStreamContext", site: int, keep_bytes: int) -> None:
    """Make the streams of a site, or set the limits of those that are there.

    Raises:
        SkylessError: the server has no room for these bytes.
    """
    fixes = StreamConfig(
        name=subjects.at(subjects.FIX_STREAM, site),
        subjects=[subjects.at(subjects.FIXES, site)],
        storage=StorageType.FILE,
        num_replicas=1,
        max_age=KEEP_S,
        max_bytes=keep_bytes,
        duplicate_window=_DUPLICATES_S,
        republish=RePublish(subjects.at(subjects.FIXES, site), subjects.at(subjects.LIVE, site)),
    )
    names = StreamConfig(
        name=subjects.at(subjects.NAMES_STREAM, site),
        subjects=[subjects.at(subjects.NAMES, site)],
        storage=StorageType.FILE,
        num_replicas=1,
        max_msgs_per_subject=1,
        allow_direct=True,
    )
    for config in (fixes, names):
        try:
            await _make(stream, config)
        except APIError as error:
            if error.err_code != _NO_ROOM:
                raise
            right = f"less than the server's max_file_store leaves: {error.description}"
            raise SkylessError(f"--keep-gb is {keep_bytes / 1e9:g}; it should be {right}") from None


async def _make(stream: "JetStreamContext", config: StreamConfig) -> None:
    """Make a stream, or change the one that is there: to add it again would reserve its bytes twice."""
    try:
        await stream.update_stream(config)
    except NotFoundError:
        try:
            await stream.add_stream(config)
        except APIError:
            with contextlib.suppress(NotFoundError):
                await stream.update_stream(config)  # another gather has made it at this moment
                return
            raise


async def messages(stream: "JetStreamContext", name: str, after: int = 0) -> AsyncGenerator["Msg", None]:
    """The messages of a stream after the one with this number, in order, until the last one that it has now.

    ``message.metadata.sequence.stream`` is a message's number. Raises nats.errors.Error where the stream is not there.
    """
    state = (await stream.stream_info(name)).state
    if state.messages == 0 or state.last_seq <= after:
        return
    config = ConsumerConfig(deliver_policy=DeliverPolicy.BY_START_SEQUENCE, opt_start_seq=after + 1)
    reading = await stream.subscribe(">", stream=name, ordered_consumer=True, config=config)
    try:
        while True:
            message = await reading.next_msg(_READ_S)
            yield message
            if message.metadata.num_pending == 0:
                return
    finally:
        await reading.unsubscribe()
