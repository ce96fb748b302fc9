"""A site's streams at its NATS server, and the stream with the names of its tags."""

import asyncio
import contextlib
from collections.abc import AsyncGenerator, Iterable
from itertools import count
from typing import TYPE_CHECKING, Any, Final

import msgspec
from msgspec import Struct
from nats.errors import Error
from nats.js.api import ConsumerConfig, DeliverPolicy, StreamConfig
from nats.js.errors import APIError, NotFoundError

from skyless.core.errors import SkylessError
from skyless.run.gather.subjects import (
    EVENT_STREAM,
    EVENTS,
    FIX_STREAM,
    FIXES,
    NAMES,
    NAMES_STREAM,
    STATE,
    STATE_STREAM,
    at,
)
from skyless.run.process import Log

if TYPE_CHECKING:
    from nats.aio.msg import Msg
    from nats.js import JetStreamContext

KEEP_S: Final = 24 * 3600.0
"""How long the stream keeps fixes."""
KEEP_EVENTS_S: Final = 365 * 24 * 3600.0
EVENT_BYTES: Final = 500_000_000
NEWEST_OF_EACH: Final[dict[str, Any]] = {"max_msgs_per_subject": 1, "allow_direct": True}
"""Limits of a stream that keeps the newest message of each subject for direct requests."""

_NO_ROOM: Final = 10047  # JetStream error code
_IDLE_S: Final = 2.0
_ABANDONED_S: Final = 60.0
_RETRY_S: Final = 1.0


async def make_streams(stream: "JetStreamContext", site: int, keep_bytes: int) -> None:
    """Make the streams of a site, or update the limits of existing ones. A hub copies from them.

    Raises SkylessError: the server has no room for these bytes.
    """
    all_fixes = {"max_age": KEEP_S, "max_bytes": keep_bytes, "duplicate_window": 120.0}
    for name, taken, limits in (
        (FIX_STREAM, (FIXES,), all_fixes),
        (NAMES_STREAM, (NAMES,), NEWEST_OF_EACH),
        (STATE_STREAM, STATE, NEWEST_OF_EACH),
        (EVENT_STREAM, EVENTS, {"max_age": KEEP_EVENTS_S, "max_bytes": EVENT_BYTES}),
    ):
        patterns = [at(subject, site) for subject in taken]
        try:
            await make_stream(stream, StreamConfig(name=at(name, site), subjects=patterns, **limits))
        except APIError as error:
            if error.err_code != _NO_ROOM:
                raise
            right = f"less than the server's max_file_store leaves: {error.description}"
            raise SkylessError(f"--keep-gb is {keep_bytes / 1e9:g}; it should be {right}") from None


async def make_stream(stream: "JetStreamContext", config: StreamConfig) -> None:
    """Make a stream, or update an existing one: adding it again would reserve its bytes twice."""
    try:
        await stream.update_stream(config)
    except NotFoundError:
        try:
            await stream.add_stream(config)
        except APIError:
            with contextlib.suppress(NotFoundError):
                await stream.update_stream(config)  # another gather has just made it
                return
            raise


async def messages(
    stream: "JetStreamContext", name: str, after: int = 0, subject: str = ">"
) -> AsyncGenerator["Msg", None]:
    """Yield the messages of a stream after the one with this number, in order, up to the current last one.

    ``subject`` is the pattern of those wanted; ``message.metadata.sequence.stream`` is a message's number. Raises
    nats.errors.Error if the stream does not exist.
    """
    state = (await stream.stream_info(name)).state
    if state.messages == 0 or state.last_seq <= after:
        return
    config = ConsumerConfig(deliver_policy=DeliverPolicy.BY_START_SEQUENCE, opt_start_seq=after + 1)
    reading = await stream.subscribe(subject, stream=name, ordered_consumer=True, config=config)
    try:
        found = await reading.consumer_info()
        is_empty = not found.num_pending and not (found.delivered and found.delivered.consumer_seq)
        while not is_empty:
            message = await reading.next_msg(10.0)
            yield message
            is_empty = message.metadata.num_pending == 0
    finally:
        await reading.unsubscribe()


async def follow(
    stream: "JetStreamContext", name: str, subject: str, say: Log, after: int = 0, *, newest_of_each: bool = False
) -> AsyncGenerator["Msg", None]:
    """Yield the messages of a stream after the one with this number, in order and each once, until cancelled.

    Waits for a stream that does not exist yet, and reconnects to another server when one is lost. ``subject`` is a
    pattern. With ``newest_of_each``, starts with the newest message of each subject.
    """
    while True:
        first = DeliverPolicy.LAST_PER_SUBJECT if newest_of_each else DeliverPolicy.ALL
        config = ConsumerConfig(deliver_policy=first, inactive_threshold=_ABANDONED_S)
        if after:
            config.deliver_policy, config.opt_start_seq = DeliverPolicy.BY_START_SEQUENCE, after + 1
        try:
            reading = await stream.subscribe(subject, stream=name, ordered_consumer=True, config=config)
            try:
                for place in count(1):
                    message = await _next(reading, place)
                    if message.metadata.sequence.consumer != place:  # some were lost with a connection
                        break
                    after = message.metadata.sequence.stream
                    yield message
            finally:
                with contextlib.suppress(Error):
                    await reading.unsubscribe()
        except Error as error:
            check_cancelled()
            say(f"the stream {name} cannot be read: {error or type(error).__name__}")
            await asyncio.sleep(_RETRY_S)


def check_cancelled() -> None:
    """Raise CancelledError if this task is cancelled: nats-py may raise an error of its own instead."""
    task = asyncio.current_task()
    if task is not None and task.cancelling():
        raise asyncio.CancelledError


async def _next(reading: "JetStreamContext.PushSubscription", place: int) -> "Msg":
    """Return the next message. Raises nats.errors.Error if the connection or the server's consumer is lost."""
    while True:
        try:
            return await reading.next_msg(_IDLE_S)
        except TimeoutError:
            sent = (await reading.consumer_info()).delivered
            if sent is not None and sent.consumer_seq >= place and not reading.pending_msgs:
                raise Error("messages were lost with a connection") from None


# Numbers of a site's tags, in its stream of names.

MAX_NAMES: Final = 200_000
_TAKEN: Final = 10071  # JetStream error code
NEVER_WRITTEN: Final = {"Nats-Expected-Last-Subject-Sequence": "0"}


class TagName(Struct, frozen=True):
    """Name of the tag with a number. A number is never reused."""

    name: str
    host: str
    """Host on which its fixes are packed."""
    since_unix_s: float


async def name_of(stream: "JetStreamContext", site: int, number: int) -> str:
    """Look up the name of the tag with a number; empty if there is none. Raises nats.errors.Error."""
    names, subject = at(NAMES_STREAM, site), at(NAMES, site, number)
    try:
        message = await stream.get_last_msg(names, subject, direct=True)
        return msgspec.json.decode(message.data or b"", type=TagName).name
    except (NotFoundError, msgspec.MsgspecError, ValueError):
        return ""


class Names:
    """Numbers and names of a site's tags. Every program that packs fixes uses it to assign numbers."""

    def __init__(self, stream: "JetStreamContext", site: int) -> None:
        self.tags: dict[int, TagName] = {}
        self.numbers: dict[str, int] = {}
        self.issue = 0
        """Largest number assigned. Readers that know fewer read the names again."""
        self._stream, self._site, self._read = stream, site, 0

    async def read(self) -> None:
        """Read the entries of the stream that are not known here yet. Raises nats.errors.Error."""
        name, of_site = at(NAMES_STREAM, self._site), at(NAMES, self._site)
        async for message in messages(self._stream, name, self._read, of_site):
            self._read = message.metadata.sequence.stream
            with contextlib.suppress(msgspec.MsgspecError, ValueError):
                number = int(message.subject.rpartition(".")[2])
                self.issue = max(self.issue, number)
                self._add(number, msgspec.json.decode(message.data, type=TagName))

    async def give(self, names: Iterable[str], host: str, now_unix_s: float) -> None:
        """Assign numbers to the names without one, until the table is full. Raises nats.errors.Error.

        Several programs may do so at once. The stream takes each number once, and a program assigns a number only when
        it knows the names of all smaller ones, so no name gets two.
        """
        for name in dict.fromkeys(names):
            while name not in self.numbers and len(self.numbers) < MAX_NAMES:
                number, tag = self.issue + 1, TagName(name, host, now_unix_s)
                subject = at(NAMES, self._site, number)
                try:
                    await self._stream.publish(subject, msgspec.json.encode(tag), headers=dict(NEVER_WRITTEN))
                    self._add(number, tag)
                except APIError as error:
                    if error.err_code != _TAKEN:
                        raise
                    await self.read()

    def _add(self, number: int, tag: TagName) -> None:
        self.tags[number], self.numbers[tag.name] = tag, number
        self.issue = max(self.issue, number)
