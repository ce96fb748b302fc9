"""``McapRecording``: what was recorded of a running site, by kind and time; also while it is being recorded."""

import math
from collections import Counter
from collections.abc import Iterable, Iterator
from os import PathLike
from typing import Final, cast

import msgspec
from msgspec import Struct

from skyless.mqtt.messages import (
    FixMessage,
    ReceptionsMessage,
    SiteMessage,
    StatusMessage,
    TruthMessage,
    ZoneEvent,
    ZonesMessage,
)
from skyless.recordings.mcap.channels import FLOOR_PLAN, Place, decoder_of, place_of
from skyless.recordings.mcap.scan import ChunkPlace, McapScan
from skyless.recordings.source import Drops

NS: Final = 1_000_000_000


class RecordingSummary(Struct, frozen=True):
    """What a recording holds. Times are Unix seconds by the recorder's clock, None while nothing is in it."""

    path: str
    site: int | None
    name: str | None
    simulated: bool | None
    start_s: float | None
    end_s: float | None
    finished: bool
    """False for one that is being written, or was never closed."""
    unread_bytes: int
    """Of a last chunk that is not whole."""
    tags: tuple[str, ...]
    """Tags with fixes or receptions."""
    raw_tags: tuple[str, ...]
    """Tags with raw receptions, which can be replayed."""
    messages: dict[str, int]
    """By kind."""
    drops: dict[str, int]


class Recorded(Struct, frozen=True):
    """One message: when it was recorded, on which topic, and what it says."""

    time_s: float
    place: Place
    topic: str
    message: Struct


class McapRecording:
    """A recording; ``refresh`` takes what has been written since it was opened."""

    def __init__(self, path: str | PathLike[str]) -> None:
        """Open it and read where its chunks are.

        Raises:
            ConfigurationError: it cannot be opened, or is no MCAP.
        """
        self._scan = McapScan(path)
        self._lasting: dict[str, Struct] = {}
        self._lasting_chunks = 0
        self.drops: Drops = Counter()

    def __enter__(self) -> "McapRecording":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the file."""
        self._scan.close()

    def refresh(self) -> None:
        """Take what has been written since."""
        self._scan.walk()

    @property
    def site(self) -> SiteMessage | None:
        """The site, as last told."""
        return cast("SiteMessage | None", self._last("site"))

    @property
    def zones(self) -> ZonesMessage | None:
        """The site's zones, as last told."""
        return cast("ZonesMessage | None", self._last("zones"))

    @property
    def floor_plan(self) -> bytes | None:
        """The image of the floor."""
        return self._scan.attachment(FLOOR_PLAN)

    def summary(self) -> RecordingSummary:
        """What it holds; quick, as only indexes are read."""
        counts: Counter[str] = Counter()
        tags: set[str] = set()
        raw_tags: set[str] = set()
        site = self.site
        for topic, count in self._counts().items():
            place = place_of(topic)
            if place is None:
                continue
            counts[place.kind] += count
            if place.kind in ("fix", "receptions"):
                tags.add(place.name)
            if place.kind == "receptions":
                raw_tags.add(place.name)
        chunks = self._scan.chunks
        return RecordingSummary(
            path=str(self._scan.path),
            site=None if site is None else site.site.id,
            name=None if site is None else site.site.name,
            simulated=None if site is None else site.simulated,
            start_s=min(chunk.start_ns for chunk in chunks) / NS if chunks else None,
            end_s=max(chunk.end_ns for chunk in chunks) / NS if chunks else None,
            finished=self._scan.finished,
            unread_bytes=self._scan.unread_bytes,
            tags=tuple(sorted(tags)),
            raw_tags=tuple(sorted(raw_tags)),
            messages=dict(sorted(counts.items())),
            drops=dict(self._scan.drops + self.drops),
        )

    def fixes(
        self, from_s: float = -math.inf, to_s: float = math.inf, tags: Iterable[str] | None = None
    ) -> Iterator[FixMessage]:
        """Fixes recorded from ``from_s`` on and before ``to_s`` (Unix time), in the order of recording."""
        wanted = None if tags is None else frozenset(tags)
        for found in self.messages({"fix"}, from_s, to_s):
            if wanted is None or found.place.name in wanted:
                yield cast("FixMessage", found.message)

    def truth(self, from_s: float = -math.inf, to_s: float = math.inf) -> Iterator[TruthMessage]:
        """Where the tags truly were."""
        return (cast("TruthMessage", found.message) for found in self.messages({"truth"}, from_s, to_s))

    def zone_events(self, from_s: float = -math.inf, to_s: float = math.inf) -> Iterator[ZoneEvent]:
        """Who entered and left which zone."""
        return (cast("ZoneEvent", found.message) for found in self.messages({"event"}, from_s, to_s))

    def statuses(self, from_s: float = -math.inf, to_s: float = math.inf) -> Iterator[tuple[float, StatusMessage]]:
        """Which nodes came and went, each with the time of recording."""
        return (
            (found.time_s, cast("StatusMessage", found.message)) for found in self.messages({"status"}, from_s, to_s)
        )

    def health(self, from_s: float = -math.inf, to_s: float = math.inf) -> Iterator[Recorded]:
        """Health of tags, anchors and the ether."""
        return self.messages({"health"}, from_s, to_s)

    def receptions(self, tag: str | None = None) -> Iterator[ReceptionsMessage]:
        """Raw receptions of one tag, or of all."""
        for found in self.messages({"receptions"}):
            if tag is None or found.place.name == tag:
                yield cast("ReceptionsMessage", found.message)

    def messages(self, kinds: set[str], from_s: float = -math.inf, to_s: float = math.inf) -> Iterator[Recorded]:
        """Messages of these kinds by time of recording; chunks without any are not even read."""
        for chunk in list(self._scan.chunks):
            if chunk.end_ns / NS >= from_s and chunk.start_ns / NS < to_s and self._may_hold(chunk, kinds):
                yield from self._of(chunk, kinds, from_s, to_s)

    def _of(self, chunk: ChunkPlace, kinds: set[str], from_s: float, to_s: float) -> Iterator[Recorded]:
        for channel, log_ns, payload in self._scan.messages(chunk):
            topic = self._scan.topics.get(channel, "")
            place = place_of(topic)
            time_s = log_ns / NS
            if place is None or place.payload is None or place.kind not in kinds or not from_s <= time_s < to_s:
                continue
            try:
                message = decoder_of(place.payload).decode(payload)
            except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
                self.drops["malformed-message"] += 1
                continue
            yield Recorded(time_s, place, topic, message)

    def _may_hold(self, chunk: ChunkPlace, kinds: set[str]) -> bool:
        """Whether the index does not rule it out."""
        if not chunk.indexed:
            return True
        places = (place_of(self._scan.topics.get(channel, "")) for channel in chunk.counts)
        return any(place is not None and place.kind in kinds for place in places)

    def _last(self, kind: str) -> Struct | None:
        """The newest message of a kind that lasts."""
        chunks = self._scan.chunks
        kinds = {"site", "zones"}
        for chunk in chunks[self._lasting_chunks :]:
            if self._may_hold(chunk, kinds):
                for found in self._of(chunk, kinds, -math.inf, math.inf):
                    self._lasting[found.place.kind] = found.message
        self._lasting_chunks = len(chunks)
        return self._lasting.get(kind)

    def _counts(self) -> Counter[str]:
        """Messages by topic; a chunk without a whole index is read."""
        counts: Counter[str] = Counter()
        for chunk in self._scan.chunks:
            found = chunk.counts if chunk.indexed else Counter(channel for channel, _, _ in self._scan.messages(chunk))
            counts.update({self._scan.topics.get(channel, ""): count for channel, count in found.items()})
        return counts
