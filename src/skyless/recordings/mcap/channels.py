"""What stands in a recording of a running site: MQTT's topics and payloads (``outputs``), with their schemas."""

from functools import lru_cache
from typing import Any, Final

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
Schema = dict[str, Any]

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
def schema_of(payload: type[Struct]) -> tuple[str, bytes]:
    """Name and JSON schema of a payload, as far as viewers of MCAP understand one.

    Foxglove accepts objects, plain types and arrays of those, without references, alternatives or free keys; anything
    else is left out, and a type that may be null is given without the null.
    """
    name = f"skyless.{payload.__name__.removesuffix('Message')}"
    schema = msgspec.json.schema(payload)
    root = _viewable(schema["$defs"][payload.__name__], schema["$defs"])
    return name, msgspec.json.encode({**(root or {}), "title": name})


def _viewable(schema: Schema, definitions: Schema) -> Schema | None:
    """A schema without what viewers do not accept; None if nothing is left."""
    schema = _resolved(schema, definitions)
    match schema.get("type"):
        case "boolean" | "integer" | "number" as kind:
            return {"type": kind}
        case "string":
            return {key: schema[key] for key in ("type", "contentEncoding") if key in schema}
        case "object" if "properties" in schema:
            parts = {name: _viewable(part, definitions) for name, part in schema["properties"].items()}
            return {"type": "object", "properties": {name: part for name, part in parts.items() if part is not None}}
        case "array":
            items = [_viewable(part, definitions) for part in schema.get("prefixItems") or [schema["items"]]]
            plain = items[0] is not None and items[0]["type"] != "array" and "contentEncoding" not in items[0]
            return {"type": "array", "items": items[0]} if plain and all(one == items[0] for one in items) else None
    return {"type": "string"} if "enum" in schema else None


def _resolved(schema: Schema, definitions: Schema) -> Schema:
    """What a reference means, and what may be null otherwise is; empty if that is more than one thing."""
    if "$ref" in schema:
        return _resolved(definitions[schema["$ref"].rpartition("/")[2]], definitions)
    if "anyOf" in schema:
        kinds = [kind for kind in schema["anyOf"] if kind.get("type") != "null"]
        return _resolved(kinds[0], definitions) if len(kinds) == 1 else {}
    return schema


@lru_cache(maxsize=64)
def decoder_of(payload: type[Struct]) -> msgspec.json.Decoder[Struct]:
    """What reads a payload."""
    return msgspec.json.Decoder(payload)
