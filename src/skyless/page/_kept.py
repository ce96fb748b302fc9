"""A list that pages edit and the broker keeps: zones, rules of alarms, assets."""

from collections.abc import Callable
from typing import TYPE_CHECKING, Generic, TypeAlias, TypeVar

from msgspec import Struct

from skyless.run.mqtt.link import Link
from skyless.run.mqtt.messages import WrongMessageError

if TYPE_CHECKING:
    from skyless.run.hub import HubLink

SiteLink: TypeAlias = "Link | HubLink"
"""A site's connection: to its broker, or to a hub, where nothing can be stored."""

_Message = TypeVar("_Message", bound=Struct)


class Kept(Generic[_Message]):
    """The message of one topic: what the broker keeps there, or what was stored here last."""

    def __init__(self, empty: _Message, read: Callable[[bytes], _Message]) -> None:
        """``empty`` is what a topic without a message means; ``read`` raises ValueError."""
        self.message = empty
        self.fault: str | None = None
        """Why what the broker keeps cannot be read."""
        self._empty, self._read = empty, read
        self._link: SiteLink | None = None
        self._topic = ""
        self._is_on_its_way = False  # the message was stored here and has not come back from the broker

    def attach(self, link: SiteLink, topic: str) -> None:
        """The broker is known; what was stored here before goes to it."""
        self._link, self._topic = link, topic
        if self._is_on_its_way:
            self.store(self.message)

    def receive(self, payload: bytes) -> bool:
        """Take what comes from the broker; whether the message is another one now. Raises WrongMessageError."""
        try:
            message = self._read(payload) if payload else self._empty
        except ValueError as error:
            self.fault = f"what the broker keeps at {self._topic} cannot be read: {error}"
            raise WrongMessageError(str(error)) from None
        self.fault = None
        if message == self.message:
            self._is_on_its_way = False
            return False
        if self._is_on_its_way:
            return False  # older than what was stored here
        if self._link is not None:
            self._link.forget(self._topic)  # what was stored here must not come back after a reconnect
        self.message = message
        return True

    def check_store(self, site: str, shown: str) -> None:
        """Check that a page of a site may replace the list of the one shown. Raises WrongMessageError."""
        if site and site != shown:
            raise WrongMessageError(f"site is {site[:100]!r}; it should be {shown[:100]!r}, which is shown now")
        if self.fault is not None:
            raise WrongMessageError(f"{self.fault}; nothing was overwritten. Clear that topic to begin again")

    def store(self, message: _Message) -> None:
        """Replace the message, also at the broker."""
        self.message, self._is_on_its_way = message, True
        if self._link is not None:
            self._link.publish(self._topic, message, qos=1, retain=True)
