"""The survey of a site as pages see it: the newest messages of the survey program, and what pages give to it.

The survey program computes; here its messages are forwarded, and what a page sends is checked and published.
"""

from collections.abc import Callable
from functools import partial
from typing import Generic, TypeVar

from msgspec import Struct
from msgspec.structs import replace

from skyless.page._state import encode
from skyless.run.mqtt.messages import (
    SurveyFactsMessage,
    SurveyMessage,
    SurveySaveMessage,
    WatchMessage,
    WrongMessageError,
    read_message,
)
from skyless.run.mqtt.survey_facts import BadFactsError, check_facts
from skyless.run.mqtt.topics import survey_topic, watch_topic

Handler = Callable[[str, bytes], None]
_M = TypeVar("_M", SurveyMessage, WatchMessage)


class NoResultError(Exception):
    """Why there is no result that could be saved."""


class Newest(Generic[_M]):
    """The newest message of a retained topic, and how old it is.

    The first after a connection may be old: the broker kept it, and only its own time says how long. The others are
    new when they arrive; their sender's clock does not matter.
    """

    def __init__(self, kind: type[_M], clock: Callable[[], float], wall_clock: Callable[[], float]) -> None:
        self.message: _M | None = None
        self._kind: type[_M] = kind
        self._clock, self._wall_clock = clock, wall_clock
        self._first = True
        self._made_s = 0.0

    def expect_kept(self) -> None:
        """The next message may be one that the broker kept."""
        self._first = True

    def read(self, payload: bytes) -> None:
        """Replace the message. An empty payload removes it. Raises WrongMessageError."""
        self.message = read_message(payload, self._kind) if payload else None
        self._made_s = self._clock()
        if self.message is not None and self._first:
            self._made_s -= max(0.0, self._wall_clock() - self.message.unix_s)
        self._first = False

    def age_s(self) -> float | None:
        """Seconds since the message was made, or None without one."""
        return None if self.message is None else self._clock() - self._made_s


class SiteSurvey:
    """The newest messages of the survey program. Each change is handed to ``broadcast`` for the open pages."""

    def __init__(
        self,
        name: str,
        broadcast: Callable[[str, bytes], None],
        clock: Callable[[], float],
        wall_clock: Callable[[], float],
    ) -> None:
        """``name`` is the dashboard's on MQTT."""
        self._name, self._broadcast = name, broadcast
        self._survey = Newest(SurveyMessage, clock, wall_clock)
        self._watch = Newest(WatchMessage, clock, wall_clock)
        self._newest: dict[str, Newest[SurveyMessage] | Newest[WatchMessage]] = {
            "survey": self._survey,
            "watch": self._watch,
        }

    def handlers(self, site_id: int) -> dict[str, Handler]:
        """What is to be subscribed to, and who handles it."""
        return {survey_topic(site_id): partial(self._on, "survey"), watch_topic(site_id): partial(self._on, "watch")}

    @property
    def watch(self) -> WatchMessage | None:
        """What the watch of the anchors has found."""
        return self._watch.message

    @property
    def watch_age_s(self) -> float | None:
        """Seconds since the watch reported, or None where it has not."""
        return self._watch.age_s()

    @property
    def survey(self) -> SurveyMessage | None:
        """State of the survey program."""
        return self._survey.message

    def messages(self) -> dict[str, bytes]:
        """The messages that a new page needs, by kind."""
        return {kind: self._encoded(kind) for kind, newest in self._newest.items() if newest.message is not None}

    def expect_kept(self) -> None:
        """The broker is connected again: it sends the messages that it kept."""
        for newest in self._newest.values():
            newest.expect_kept()

    def facts_message(self, body: bytes) -> SurveyFactsMessage:
        """What a page's user knows, ready to be published. Raises BadFactsError."""
        try:
            message = read_message(body, SurveyFactsMessage)
        except WrongMessageError as error:
            raise BadFactsError(f"these are no facts of a survey: {error}") from None
        check_facts(message)
        return replace(message, by=self._name)

    def save_message(self, body: bytes) -> SurveySaveMessage:
        """The request to save a result, ready to be published. Raises BadFactsError and NoResultError."""
        try:
            serial = read_message(body, _SaveRequest).serial
        except WrongMessageError as error:
            raise BadFactsError(f'this is no request to save, such as {{"serial": 12}}: {error}') from None
        newest = self._survey.message
        if newest is None or newest.survey is None:
            raise NoResultError("the survey has no result yet")
        if not 0 <= serial <= newest.serial:
            raise NoResultError(f"there is no result {serial}; the newest is {newest.serial}")
        return SurveySaveMessage(self._name, serial)

    def _on(self, kind: str, _topic: str, payload: bytes) -> None:
        self._newest[kind].read(payload)
        self._broadcast(kind, self._encoded(kind))

    def _encoded(self, kind: str) -> bytes:
        newest = self._newest[kind]
        return encode(kind, {kind: newest.message, "age_s": newest.age_s()})


class _SaveRequest(Struct):
    """A page's request to save a result."""

    serial: int
