"""Foxglove's WebSocket protocol, version 1: what a server sends, and what its clients ask for.

Source: https://github.com/foxglove/ws-protocol/blob/main/docs/spec.md
"""

from collections.abc import Sequence
from struct import Struct as Format
from typing import Annotated, Any, Final

import msgspec
from msgspec import Meta, Struct

SUBPROTOCOLS: Final = ("foxglove.sdk.v1", "foxglove.websocket.v1")
"""Names of the protocol, the newer first; what they share is all that is used here."""

WARNING: Final = 1
"""Level of a status."""

_MESSAGE_DATA: Final = Format("<BIQ")
"""Operation 1, subscription, time in ns; the payload follows."""

_LAST_NS: Final = 2**64 - 1

_MOST_IDS: Final = 1000
"""Of one request."""

Identifier = Annotated[int, Meta(ge=0, le=0xFFFFFFFF)]


class Channel(Struct, frozen=True, rename="camel"):
    """A topic that clients can subscribe."""

    id: int
    topic: str
    schema_name: str
    schema: str
    encoding: str = "json"
    schema_encoding: str = "jsonschema"


class Subscription(Struct, frozen=True, rename="camel"):
    """A client's own number for a channel that it wants."""

    id: Identifier
    channel_id: Identifier


class Subscribe(Struct, frozen=True, tag_field="op", tag="subscribe"):
    """The client wants these channels."""

    subscriptions: Annotated[tuple[Subscription, ...], Meta(max_length=_MOST_IDS)]


class Unsubscribe(Struct, frozen=True, tag_field="op", tag="unsubscribe", rename="camel"):
    """The client does not want these any more."""

    subscription_ids: Annotated[tuple[Identifier, ...], Meta(max_length=_MOST_IDS)]


Request = Subscribe | Unsubscribe

_decoder: Final[msgspec.json.Decoder[Subscribe | Unsubscribe]] = msgspec.json.Decoder(Request)


def decode_request(data: str | bytes) -> Request | None:
    """What a client asks for; None for anything that this server does not offer or understand."""
    if isinstance(data, bytes):  # published data and calls of services
        return None
    try:
        return _decoder.decode(data)
    except (msgspec.MsgspecError, UnicodeError, RecursionError):
        return None


def server_info(name: str, session: str) -> str:
    """The first message to a client; with another ``session`` it forgets what it had from this server."""
    return _text(
        {
            "op": "serverInfo",
            "name": name,
            "capabilities": [],
            "supportedEncodings": [],
            "metadata": {},
            "sessionId": session,
        }
    )


def advertise(channels: Sequence[Channel]) -> str:
    """These channels are there."""
    return _text({"op": "advertise", "channels": channels})


def status(level: int, message: str) -> str:
    """A line for the person who uses the client."""
    return _text({"op": "status", "level": level, "message": message})


def message_data(subscription: int, unix_s: float, payload: bytes) -> bytes:
    """A message of a subscribed channel. Raises ValueError or OverflowError: the time cannot be stated."""
    time_ns = round(unix_s * 1e9)
    if not 0 <= time_ns <= _LAST_NS:
        raise OverflowError("the time is before 1970, or after what 64 bits can state")
    return _MESSAGE_DATA.pack(1, subscription, time_ns) + payload


def _text(value: dict[str, Any]) -> str:
    return msgspec.json.encode(value).decode()
