"""What stands in a recording of a running site: MQTT's topics and payloads (``outputs``), with their schemas."""

from functools import lru_cache
from typing import Any, Final

import msgspec
from msgspec import Struct

from skyless.outputs import messages
from skyless.outputs.topics import ROOT

PROFILE: Final = "skyless"
JSON: Final = "json"
JSON_SCHEMA: Final = "jsonschema"

_SITE_WIDE: Final[dict[str, type[Struct]]] = {
    "site": messages.SiteMessage,
    "request": messages.RequestMessage,
    "truth": messages.TruthMessage,
    "zones": messages.ZonesMessage,
}
_HEALTH: Final[dict[str, type[Struct]]] = {
    "tag": messages.TagHealth,
    "anchor": messages.AnchorHealth,
    "ether": messages.EtherHealth,
}
_OF_A_NODE: Final[dict[str, type[Struct]]] = {
    "fix": messages.FixMessage,
    "receptions": messages.ReceptionsMessage,
    "status": messages.StatusMessage,
    "event": messages.ZoneEvent,
}
FLOOR_PLAN: Final = "floor_plan"
"""An image, which has no schema; it is kept as an attachment."""

LASTING: Final = frozenset({"site", "zones", "status", FLOOR_PLAN})
"""Kinds that are retained: a repetition says nothing new."""


class Place(Struct, frozen=True):
    """What a topic means."""

    site: str
    kind: str
    """``fix``, ``receptions``, ``status``, ``health``, ``event``, ``site``, ``request``, ``truth``, ``zones``, ..."""
    name: str = ""
    """Of the tag, anchor or zone."""
    payload: type[Struct] | None = None


@lru_cache(maxsize=10_000)
def place_of(topic: str) -> Place | None:
    """What a topic means; None for one that is not of version 1."""
    if not topic.startswith(f"{ROOT}/"):
        return None
    match topic.removeprefix(f"{ROOT}/").split("/"):
        case [site, "floor_plan"]:
            return Place(site, FLOOR_PLAN)
        case [site, kind] if kind in _SITE_WIDE:
            return Place(site, kind, "", _SITE_WIDE[kind])
        case [site, who, name, "health"] if who in _HEALTH:
            return Place(site, "health", name, _HEALTH[who])
        case [site, _, name, kind] if kind in _OF_A_NODE:
            return Place(site, kind, name, _OF_A_NODE[kind])
    return None


@lru_cache(maxsize=64)
def schema_of(payload: type[Struct]) -> tuple[str, bytes]:
    """Name and JSON schema of a payload; the outermost type is an object, as viewers of MCAP want it."""
    name = payload.__name__.removesuffix("Message")
    schema = msgspec.json.schema(payload)
    root: dict[str, Any] = schema["$defs"].pop(payload.__name__)
    return f"skyless.{name}", msgspec.json.encode({**root, "title": f"skyless.{name}", "$defs": schema["$defs"]})


@lru_cache(maxsize=64)
def decoder_of(payload: type[Struct]) -> msgspec.json.Decoder[Struct]:
    """What reads a payload."""
    return msgspec.json.Decoder(payload)
