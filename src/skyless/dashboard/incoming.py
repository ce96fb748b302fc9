"""What comes from MQTT, and from where."""

from collections.abc import Callable
from typing import Protocol, TypeVar

import msgspec
from msgspec import Struct

_T = TypeVar("_T")


class Bus(Protocol):
    """What is needed of ``skyless.mqtt.link.Link``."""

    def publish(self, topic: str, message: Struct | bytes, *, qos: int = 0, retain: bool = False) -> None:
        """Hand over a message; returns at once."""

    def subscribe(self, topic_filter: str, handler: Callable[[str, bytes], None], qos: int = 0) -> None:
        """Call ``handler`` with topic and payload of every message."""

    def forget(self, topic: str) -> None:
        """Stop repeating a retained message."""


class WrongMessageError(ValueError):
    """A message that is not what its topic says."""


def read_message(payload: bytes, kind: type[_T]) -> _T:
    """A message from JSON. Raises WrongMessageError."""
    try:
        return msgspec.json.decode(payload, type=kind)
    except (msgspec.MsgspecError, ValueError, RecursionError) as error:
        raise WrongMessageError(str(error)) from None


def expect_name(name: str, topic: str) -> None:
    """See that a message is of whom its topic says. Raises WrongMessageError."""
    if name != topic.rsplit("/", 2)[-2]:
        raise WrongMessageError(f"it is of {name[:40]!r}")
