"""What a site says, as typed values, whatever brings it: a broker, a hub's streams, or a recording.

A reader names the messages it wants and a function for each. A feed decodes and checks a message once, and counts those
that are dropped. Connections are restored by what a feed is attached to (``Link``, ``HubLink``); a feed that says
nothing is silent, and only a ``SiteTable`` can tell what that means.
"""

import logging
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable
from functools import lru_cache
from typing import Any, Final, Generic, Protocol, TypeVar

from msgspec import Struct

from skyless.core.errors import ConfigurationError
from skyless.run.assets import read_assets
from skyless.run.mqtt import messages, topics
from skyless.run.mqtt.link import Handler
from skyless.run.mqtt.messages import WrongMessageError, read_message
from skyless.run.mqtt.topics import ROOT, Topic
from skyless.run.zones import read_zones

_log = logging.getLogger("skyless.run")


KINDS: Final = (
    *(topics.site_topic, topics.floor_plan_topic, topics.plan_of_floor_topic, topics.zones_topic),
    *(topics.assets_topic, topics.alarm_rules_topic, topics.survey_topic, topics.watch_topic),
    *(topics.status_topic, topics.fix_topic),
    Topic("tag/+/health", messages.TagHealth, "health", own_name=lambda one: str(one.tag)),
    Topic("anchor/+/health", messages.AnchorHealth, "health", own_name=lambda one: str(one.anchor)),
    Topic("ether/+/health", messages.EtherHealth, "health"),
    *(topics.truth_topic, topics.request_topic, topics.receptions_topic, topics.stamps_topic),
    *(topics.zone_event_topic, topics.alarm_topic, topics.acknowledge_topic),
)
"""All messages that a site's programs send for its readers (``docs/mqtt.md``)."""

_CHECKED: Final[dict[type, Callable[[bytes], Struct]]] = {
    messages.ZonesMessage: read_zones,
    messages.AssetsMessage: read_assets,
}
"""Messages that people write, which are checked further than their fields' types."""


class Channel(Struct, frozen=True):
    """The meaning of a topic."""

    site: str
    of: Topic
    """One of ``KINDS``."""
    name: str
    """Name of the tag, anchor, zone or floor; rule and subject of an alarm."""
    who: str
    """Kind of the node whose status or health it is."""

    @property
    def kind(self) -> str:
        """What readers call messages of this kind."""
        return self.of.kind


def _place(levels: list[str]) -> tuple[int, str, str]:
    return len(levels), levels[0], levels[-1]


_KIND_AT: Final = {_place(kind.levels.split("/")): kind for kind in KINDS}
"""No two kinds have topics of the same length that begin and end alike."""


@lru_cache(maxsize=10_000)
def channel_of(topic: str) -> Channel | None:
    """Parse a topic; None if it is none of a site's messages."""
    if not topic.startswith(f"{ROOT}/"):
        return None
    site, *levels = topic.removeprefix(f"{ROOT}/").split("/")
    if not levels:
        return None
    length, first, last = _place(levels)
    kind = (
        _KIND_AT.get((length, first, last)) or _KIND_AT.get((length, "+", last)) or _KIND_AT.get((length, first, "+"))
    )
    if kind is None:
        return None
    name = "/".join(levels[1:] if kind.kind == "floor_plan" else levels[1:-1])
    return Channel(site, kind, name, first if kind.kind in ("status", "health") else "")


def message_of(channel: Channel, payload: bytes) -> Struct | None:
    """Decode and check a message; None if a retained one was withdrawn. Raises WrongMessageError."""
    kind, own_name = channel.of.payload, channel.of.own_name
    assert kind is not None
    if not payload and channel.of.retained:
        return None
    read = _CHECKED.get(kind)
    message = read_message(payload, kind) if read is None else read(payload)
    if own_name is not None and own_name(message) != channel.name:
        raise WrongMessageError(f"it is of {own_name(message)[:40]!r}")
    return message


class Source(Protocol):
    """What a feed can be attached to: a ``Link``, or a ``HubLink``."""

    def subscribe(self, topic_filter: str, handler: Handler, qos: int = 0) -> None:
        """Call ``handler`` with topic and payload of every message that matches a filter."""


class Recorded(Struct, frozen=True):
    """One recorded message, with its time of recording and its topic."""

    time_s: float
    channel: Channel
    topic: str
    message: Struct


Act = Callable[[Any, Channel], object]
"""Gets a message, or None where a retained one was withdrawn, and its channel. It may raise WrongMessageError."""


class SiteFeed:
    """What one site says to one reader."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self.drops: Counter[str] = Counter()
        """Messages that could not be used, by kind."""
        self._clock = clock
        self._at_s: float | None = None
        self._typed: defaultdict[type | None, list[Act]] = defaultdict(list)
        self._raw: dict[str, Act] = {}
        self._link: tuple[Source, int] | None = None

    @property
    def now_s(self) -> float:
        """The reader's time; while a recording is played, the time of the message."""
        return self._clock() if self._at_s is None else self._at_s

    def on(self, payload: type[Struct], act: Act) -> None:
        """Call ``act`` with all messages of a type, after what was set for it before."""
        self._typed[payload].append(act)
        self._subscribe(kind for kind in KINDS if kind.payload is payload)

    def on_bytes(self, name: str, act: Act) -> None:
        """Call ``act`` with the undecoded messages of a kind: images, and lists whose reader keeps what is wrong."""
        self._raw[name] = act
        self._subscribe(kind for kind in KINDS if kind.kind == name)

    def attach(self, link: Source, site: int) -> None:
        """Get the messages of a site from a broker or a hub."""
        self._link = link, site
        self._subscribe(kind for kind in KINDS if kind.payload in self._typed or kind.kind in self._raw)

    def _subscribe(self, kinds: Iterable[Topic]) -> None:
        if self._link is not None:
            link, site = self._link
            for kind in kinds:
                link.subscribe(f"{ROOT}/{site}/{kind.levels}", self.receive, int(kind.once))

    def receive(self, topic: str, payload: bytes) -> None:
        """Process a message of MQTT."""
        channel = channel_of(topic)
        if channel is None:
            return
        try:
            if (raw := self._raw.get(channel.kind)) is not None:
                raw(payload, channel)
            elif channel.of.payload in self._typed:
                message = message_of(channel, payload)
                for act in self._typed[channel.of.payload]:
                    act(message, channel)
        except (WrongMessageError, ConfigurationError) as error:
            self.drops[channel.kind] += 1
            if self.drops[channel.kind] == 1:
                _log.warning("dropped a wrong message of %s: %s; there may be more", topic, error)

    def play(self, recorded: Iterable[Recorded]) -> None:
        """Process messages of a recording, in its order and by its times."""
        for one in recorded:
            self._at_s = one.time_s
            for act in self._typed.get(type(one.message), ()):
                act(one.message, one.channel)
        self._at_s = None


M = TypeVar("M", messages.SurveyMessage, messages.WatchMessage)


class Newest(Generic[M]):
    """The newest message of a retained kind, and its age.

    The first one after connecting may be old, and only its own time tells its age. Later ones are new on arrival,
    whatever their sender's clock.
    """

    def __init__(self, clock: Callable[[], float], wall_clock: Callable[[], float]) -> None:
        self.message: M | None = None
        self._clock, self._wall_clock = clock, wall_clock
        self._first = True
        self._made_s = 0.0

    def expect_kept(self) -> None:
        """Expect that the next message may be a retained one."""
        self._first = True

    def replace(self, message: M | None) -> None:
        """Replace the message; None removes it."""
        self.message = message
        self._made_s = self._clock()
        if message is not None and self._first:
            self._made_s -= max(0.0, self._wall_clock() - message.unix_s)
        self._first = False

    def age_s(self) -> float | None:
        """Seconds since the message was made, or None without one."""
        return None if self.message is None else self._clock() - self._made_s
