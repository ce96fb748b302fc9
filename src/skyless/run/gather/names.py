"""The numbers of a site's tags, as its stream of names has them."""

import contextlib
from collections.abc import Iterable
from typing import TYPE_CHECKING, Final

import msgspec
from msgspec import Struct
from nats.js.errors import APIError, NotFoundError

from skyless.run.gather import subjects
from skyless.run.gather.streams import messages

if TYPE_CHECKING:
    from nats.js import JetStreamContext

MAX_NAMES: Final = 200_000
_TAKEN: Final = 10071  # JetStream's code of an error
NEVER_WRITTEN: Final = {"Nats-Expected-Last-Subject-Sequence": "0"}


class TagName(Struct, frozen=True):
    """The name of a tag's number. A number is given once and never again."""

    name: str
    host: str
    """Where its fixes are packed."""
    since_unix_s: float


async def name_of(stream: "JetStreamContext", site: int, number: int) -> str:
    """The name of a tag's number, empty where it has none. Raises nats.errors.Error."""
    names, subject = subjects.at(subjects.NAMES_STREAM, site), subjects.at(subjects.NAMES, site, number)
    try:
        message = await stream.get_last_msg(names, subject, direct=True)
        return msgspec.json.decode(message.data or b"", type=TagName).name
    except (NotFoundError, msgspec.MsgspecError, ValueError):
        return ""


class Names:
    """Numbers and names of a site's tags. Every program that packs fixes gives numbers in this way."""

    def __init__(self, stream: "JetStreamContext", site: int) -> None:
        self.tags: dict[int, TagName] = {}
        self.numbers: dict[str, int] = {}
        self.issue = 0
        """The largest number that was given. Readers that know fewer read the names again."""
        self._stream, self._site, self._read = stream, site, 0

    async def read(self) -> None:
        """Read what the stream has that is not known here yet. Raises nats.errors.Error."""
        name, of_site = subjects.at(subjects.NAMES_STREAM, self._site), subjects.at(subjects.NAMES, self._site)
        async for message in messages(self._stream, name, self._read, of_site):
            self._read = message.metadata.sequence.stream
            with contextlib.suppress(msgspec.MsgspecError, ValueError):
                number = int(message.subject.rpartition(".")[2])
                self.issue = max(self.issue, number)
                self._add(number, msgspec.json.decode(message.data, type=TagName))

    async def give(self, names: Iterable[str], host: str, now_unix_s: float) -> None:
        """Give numbers to those names that have none; a full table gives none. Raises nats.errors.Error.

        Several programs may do so. The stream takes each number once, and a program gives a number only when it knows
        the names of all smaller ones, so no name has two.
        """
        for name in dict.fromkeys(names):
            while name not in self.numbers and len(self.numbers) < MAX_NAMES:
                number, tag = self.issue + 1, TagName(name, host, now_unix_s)
                subject = subjects.at(subjects.NAMES, self._site, number)
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
