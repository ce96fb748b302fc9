"""Reading messages from MQTT that may be wrong."""

from typing import TypeVar

import msgspec

_T = TypeVar("_T")


class WrongMessageError(ValueError):
    """A message that does not fit its topic."""


def read_message(payload: bytes, kind: type[_T]) -> _T:
    """A message from JSON. Raises WrongMessageError."""
    try:
        return msgspec.json.decode(payload, type=kind)
    except (msgspec.MsgspecError, ValueError, RecursionError) as error:
        raise WrongMessageError(str(error)) from None
