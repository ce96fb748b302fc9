"""The survey of a site as pages see it: the newest messages of the survey program, and what pages give to it.

The survey program computes; here its messages are forwarded, and what a page sends is checked and published.
"""

from collections.abc import Callable
from typing import Generic, TypeVar

import msgspec
from msgspec.structs import replace

from skyless.dashboard.state import encode
from skyless.mqtt.messages import SurveyFactsMessage, SurveyMessage, SurveySaveMessage, WatchMessage, read_message
from skyless.mqtt.survey_facts import BadFactsError, check_facts
from skyless.mqtt.topics import survey_facts_topic, survey_save_topic, survey_topic, watch_topic

Handler = Callable[[str, bytes], None]
_M = TypeVar("_M", SurveyMessage, WatchMessage)


class NoResultError(Exception):
    """Why there is no result that could be saved."""


class Newest(Generic[_M]):
    """The newest message of a retained topic, and how old it is.

    The first after a connection may be old: the broker kept it, and only its own time says how long. The others are
    new when they arrive, whatever their sender's clock shows.
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
        """Replace the message; an empty payload removes it. Raises WrongMessageError."""
        self.message = read_message(payload, self._kind) if payload else None
        self._made_s = self._clock()
        if self.message is not None and self._first:
            self._made_s -= max(0.0, self._wall_clock() - self.message.unix_s)
        self._first = False

    def age_s(self) -> float | None:
        """Seconds since the message was made; None without one."""
        return None if self.message is None else self._clock() - self._made_s


class SiteSurvey:
    """The newest messages of the survey program; each change is handed to ``broadcast`` for the open pages."""

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

    def handlers(self, site_id: int) -> dict[str, Handler]:
        """What is to be subscribed to, and who handles it."""
        return {survey_topic(site_id): self._on_survey, watch_topic(site_id): self._on_watch}

    @property
    def watch(self) -> WatchMessage | None:
        """What the watch of the anchors has found."""
        return self._watch.message

    @property
    def watch_age_s(self) -> float | None:
        """Seconds since the watch reported; None where it has not."""
        return self._watch.age_s()

    @property
    def survey(self) -> SurveyMessage | None:
        """State of the survey program."""
        return self._survey.message

    def messages(self) -> dict[str, bytes]:
        """The messages that a new page needs, by kind."""
        found = {}
        if self._survey.message is not None:
            found["survey"] = self._encoded_survey()
        if self._watch.message is not None:
            found["watch"] = self._encoded_watch()
        return found

    def expect_kept(self) -> None:
        """The broker is connected again: it sends the messages that it kept."""
        self._survey.expect_kept()
        self._watch.expect_kept()

    def facts_message(self, body: bytes) -> SurveyFactsMessage:
        """What a page's user knows, ready to be published. Raises BadFactsError."""
        try:
            message = msgspec.json.decode(body, type=SurveyFactsMessage)
        except (msgspec.MsgspecError, ValueError, RecursionError) as error:
            raise BadFactsError(f"these are no facts of a survey: {error}") from None
        check_facts(message)
        return replace(message, by=self._name)

    def save_message(self, body: bytes) -> SurveySaveMessage:
        """The request to save a result, ready to be published. Raises BadFactsError and NoResultError."""
        try:
            serial = msgspec.json.decode(body, type=dict[str, int])["serial"]
        except (msgspec.MsgspecError, ValueError, RecursionError, KeyError) as error:
            raise BadFactsError(f'this is no request to save, such as {{"serial": 12}}: {error}') from None
        newest = self._survey.message
        if newest is None or newest.survey is None:
            raise NoResultError("the survey has no result yet")
        if not 0 <= serial <= newest.serial:
            raise NoResultError(f"there is no result {serial}; the newest is {newest.serial}")
        return SurveySaveMessage(self._name, serial)

    def _on_survey(self, _topic: str, payload: bytes) -> None:
        self._survey.read(payload)
        self._broadcast("survey", self._encoded_survey())

    def _on_watch(self, _topic: str, payload: bytes) -> None:
        self._watch.read(payload)
        self._broadcast("watch", self._encoded_watch())

    def _encoded_survey(self) -> bytes:
        return encode("survey", {"survey": self._survey.message, "age_s": self._survey.age_s()})

    def _encoded_watch(self) -> bytes:
        return encode("watch", {"watch": self._watch.message, "age_s": self._watch.age_s()})


def topic_of(message: SurveyFactsMessage | SurveySaveMessage, site_id: int) -> str:
    """Where a message to the survey program goes."""
    return survey_facts_topic(site_id) if isinstance(message, SurveyFactsMessage) else survey_save_topic(site_id)
