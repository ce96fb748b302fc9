"""The streams of a site at its NATS server: what they keep, the names in them, and which gather may fill them."""

import asyncio
import os
import platform
from typing import TYPE_CHECKING, Final

import msgspec
from nats.errors import Error
from nats.js.api import ConsumerConfig, DeliverPolicy, KeyValueConfig, StorageType, StreamConfig
from nats.js.errors import APIError, BadRequestError, KeyWrongLastSequenceError, NotFoundError

from skyless.core.errors import SkylessError
from skyless.run.gather import subjects
from skyless.run.gather.packer import TagName
from skyless.run.process import Log

if TYPE_CHECKING:
    from nats.js import JetStreamContext
    from nats.js.kv import KeyValue

KEEP_S: Final = 24 * 3600.0
"""How long the stream keeps fixes."""

_NO_ROOM: Final = 10047  # JetStream's code of an error
_DUPLICATES_S: Final = 120.0
_READ_S: Final = 10.0
_LOCK_S: Final = 5.0
"""A gather that has not renewed its lock for this long has ended."""

_RENEWAL_S: Final = 1.0
_KEY: Final = "running"
_NEVER_WRITTEN: Final = {"Nats-Expected-Last-Subject-Sequence": "0"}


class NumberTakenError(Exception):
    """Another gather has given this number."""


class LostLockError(Exception):
    """Another gather may serve the site from now on, or the server is away."""


async def make_streams(stream: "JetStreamContext", site: int, keep_bytes: int) -> None:
    """Make the streams of a site, or set the limits of those that are there.

    Raises:
        SkylessError: the server has no room for so many bytes.
    """
    fixes = StreamConfig(
        name=subjects.at(subjects.FIX_STREAM, site),
        subjects=[subjects.at(subjects.FIXES, site)],
        storage=StorageType.FILE,
        num_replicas=1,
        max_age=KEEP_S,
        max_bytes=keep_bytes,
        duplicate_window=_DUPLICATES_S,
    )
    names = StreamConfig(
        name=subjects.at(subjects.NAMES_STREAM, site),
        subjects=[subjects.at(subjects.NAMES, site)],
        storage=StorageType.FILE,
        num_replicas=1,
        max_msgs_per_subject=1,
    )
    for config in (fixes, names):
        try:
            found = await _max_bytes(stream, str(config.name))
            if found is None:
                await stream.add_stream(config)
            elif found != (config.max_bytes or -1):
                await stream.update_stream(config)
        except APIError as error:
            if error.err_code != _NO_ROOM:
                raise
            right = f"less than the server's max_file_store leaves: {error.description}"
            raise SkylessError(f"--keep-gb is {keep_bytes / 1e9:g}; it should be {right}") from None


async def _max_bytes(stream: "JetStreamContext", name: str) -> int | None:
    """Most bytes of a stream, -1 without a limit; None where there is no such stream.

    A stream is not added again: the server would reserve its bytes twice.
    """
    try:
        return (await stream.stream_info(name)).config.max_bytes or -1
    except NotFoundError:
        return None


async def read_names(stream: "JetStreamContext", site: int) -> dict[int, TagName]:
    """The names of all numbers that were given at a site."""
    name, found = subjects.at(subjects.NAMES_STREAM, site), dict[int, TagName]()
    if (await stream.stream_info(name)).state.messages == 0:
        return found
    config = ConsumerConfig(deliver_policy=DeliverPolicy.ALL)
    reading = await stream.subscribe(
        subjects.at(subjects.NAMES, site), stream=name, ordered_consumer=True, config=config
    )
    try:
        while True:
            message = await reading.next_msg(_READ_S)
            number = message.subject.rpartition(".")[2]
            if number.isdecimal():
                found[int(number)] = msgspec.json.decode(message.data, type=TagName)
            if message.metadata.num_pending == 0:
                return found
    finally:
        await reading.unsubscribe()


async def store_name(stream: "JetStreamContext", site: int, number: int, tag: TagName) -> None:
    """Store the name of a new number. Raises NumberTakenError."""
    data = msgspec.json.encode(tag)
    try:
        await stream.publish(subjects.at(subjects.NAMES, site, number), data, headers=dict(_NEVER_WRITTEN))
    except BadRequestError as error:
        raise NumberTakenError(f"number {number}: {error.description}") from None


class SiteLock:
    """Lets one gather at a time serve a site. It is a key at the server that lasts for ``_LOCK_S`` unless renewed."""

    def __init__(self, bucket: "KeyValue", revision: int) -> None:
        self._bucket, self._revision = bucket, revision

    async def hold(self) -> None:
        """Renew the lock until cancelled. Raises LostLockError."""
        while True:
            await asyncio.sleep(_RENEWAL_S)
            try:
                self._revision = await self._bucket.update(_KEY, _owner(), self._revision)
            except Error as error:
                raise LostLockError(str(error) or type(error).__name__) from None

    async def release(self) -> None:
        """Let another gather begin at once."""
        await self._bucket.delete(_KEY, self._revision)


async def lock_site(stream: "JetStreamContext", site: int, log: Log) -> SiteLock:
    """Wait until no other gather serves the site."""
    config = KeyValueConfig(subjects.at(subjects.LOCK_BUCKET, site), ttl=_LOCK_S, storage=StorageType.MEMORY)
    waits = False
    while True:
        bucket = await stream.create_key_value(config)
        try:
            return SiteLock(bucket, await bucket.create(_KEY, _owner()))
        except KeyWrongLastSequenceError:
            if not waits:
                log(f"another gather serves site {site}; this one waits until it ends")
            waits = True
            await asyncio.sleep(_RENEWAL_S)


def _owner() -> bytes:
    return f"{platform.node()} {os.getpid()}".encode()
