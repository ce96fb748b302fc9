"""What stands in a recording of a running site: MQTT's topics and payloads (``outputs``), with their schemas."""

from functools import lru_cache
from typing import Final

import msgspec
from msgspec import Struct

from skyless.mqtt import messages
from skyless.mqtt.topics import ROOT

PROFILE: Final = "skyless"
JSON: Final = "json"
JSON_SCHEMA: Final = "jsonschema"

_SITE_WIDE: Final[dict[str, type[Struct]]] = {
    "site": messages.SiteMessage,
    "request": messages.RequestMessage,
    "truth": messages.TruthMessage,
    "zones": messages.ZonesMessage,
    "survey/watch": messages.WatchMessage,
}
_HEALTH: Final[dict[str, type[Struct]]] = {
    "tag": messages.TagHealth,
    "anchor": messages.AnchorHealth,
    "ether": messages.EtherHealth,
}
_OF_A_NODE: Final[dict[str, type[Struct]]] = {
    "fix": messages.FixMessage,
    "receptions": messages.ReceptionsMessage,
    "stamps": messages.StampsMessage,
    "status": messages.StatusMessage,
    "event": messages.ZoneEvent,
}
FLOOR_PLAN: Final = "floor_plan"
"""An image, which has no schema; it is kept as an attachment."""

RETAINED_KINDS: Final = frozenset({"site", "zones", "status", "watch", FLOOR_PLAN})
"""Kinds that are retained: a repetition adds nothing."""


class Channel(Struct, frozen=True):
    """What a topic means."""

    site: str
    kind: str
    """``fix``, ``receptions``, ``stamps``, ``status``, ``health``, ``event``, ``site``, ``zones``, ``watch`` ..."""
    name: str = ""
    """Of the tag, anchor or zone."""
    payload: type[Struct] | None = None


@lru_cache(maxsize=10_000)
def channel_of(topic: str) -> Channel | None:
    """What a topic means; None for one that is not of version 1."""
    if not topic.startswith(f"{ROOT}/"):
        return None
    site, _, rest = topic.removeprefix(f"{ROOT}/").partition("/")
    if rest in _SITE_WIDE:
        return Channel(site, rest.rpartition("/")[2], "", _SITE_WIDE[rest])
    match rest.split("/"):
        case ["floor_plan"]:
            return Channel(site, FLOOR_PLAN)
        case [who, name, "health"] if who in _HEALTH:
            return Channel(site, "health", name, _HEALTH[who])
        case [_, name, kind] if kind in _OF_A_NODE:
            return Channel(site, kind, name, _OF_A_NODE[kind])
    return None


@lru_cache(maxsize=64)
def decoder_of(payload: type[Struct]) -> msgspec.json.Decoder[Struct]:
    """What reads a payload."""
    return msgspec.json.Decoder(payload)
