"""The survey of a site as pages see it: the newest messages of the survey program, and what pages give to it.

The survey program computes; here its messages are forwarded, and what a page sends is checked and published.
"""

from collections.abc import Callable
from functools import partial
from typing import Generic, TypeVar

from msgspec import Struct
from msgspec.structs import replace
from starlette.exceptions import HTTPException

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


class Newest(Generic[_M]):
    """The newest message of a retained topic, and how old it is.

    The first after a connection may be old: the broker kept it, and only its own time says how long. The others are
    new when they arrive; their sender's clock does not matter.
    """

    def __init__(self, name: str, kind: type[_M], clock: Callable[[], float], wall_clock: Callable[[], float]) -> None:
        self.name = name
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

    def encoded(self) -> bytes:
        """What a page is sent."""
        return encode(self.name, {self.name: self.message, "age_s": self.age_s()})


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
        self.survey = Newest("survey", SurveyMessage, clock, wall_clock)
        """State of the survey program."""
        self.watch = Newest("watch", WatchMessage, clock, wall_clock)
        """What the watch of the anchors has found."""

    def handlers(self, site_id: int) -> dict[str, Handler]:
        """What is to be subscribed to, and who handles it."""
        return {
            survey_topic(site_id): partial(self._on, self.survey),
            watch_topic(site_id): partial(self._on, self.watch),
        }

    def messages(self) -> dict[str, bytes]:
        """The messages that a new page needs, by kind."""
        return {one.name: one.encoded() for one in (self.survey, self.watch) if one.message is not None}

    def expect_kept(self) -> None:
        """The broker is connected again: it sends the messages that it kept."""
        self.survey.expect_kept()
        self.watch.expect_kept()

    def facts_message(self, body: bytes) -> SurveyFactsMessage:
        """What a page's user knows, ready to be published. Raises BadFactsError."""
        try:
            message = read_message(body, SurveyFactsMessage)
        except WrongMessageError as error:
            raise BadFactsError(f"these are no facts of a survey: {error}") from None
        check_facts(message)
        return replace(message, by=self._name)

    def save_message(self, body: bytes) -> SurveySaveMessage:
        """The request to save a result, ready to be published. Raises BadFactsError and HTTPException."""
        try:
            serial = read_message(body, _SaveRequest).serial
        except WrongMessageError as error:
            raise BadFactsError(f'this is no request to save, such as {{"serial": 12}}: {error}') from None
        newest = self.survey.message
        if newest is None or newest.survey is None:
            raise HTTPException(409, "the survey has no result yet")
        if not 0 <= serial <= newest.serial:
            raise HTTPException(409, f"there is no result {serial}; the newest is {newest.serial}")
        return SurveySaveMessage(self._name, serial)

    def _on(self, newest: Newest[_M], _topic: str, payload: bytes) -> None:
        newest.read(payload)
        self._broadcast(newest.name, newest.encoded())


class _SaveRequest(Struct):
    """A page's request to save a result."""

    serial: int
