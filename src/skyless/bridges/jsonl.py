"""JSON lines: one object per line over TCP, or per datagram over UDP; SI units, in the site's frame.

``type`` is ``site``, ``fix`` (with the fields of a fix on MQTT, ``docs/mqtt.md``) or ``no_fix``.
"""

from collections.abc import Mapping
from typing import Final

import msgspec
from msgspec import UNSET, Struct, UnsetType

from skyless.bridges.target import BridgeContext, BridgedSite, Encoder, TargetUrl
from skyless.core.site import GeoreferenceSite
from skyless.run.mqtt.messages import Asset, FixMessage, Vector

_encode: Final = msgspec.json.Encoder().encode


class SiteLine(Struct, frozen=True, tag="site"):
    """The site, sent first to each new reader, and whenever it changes."""

    id: int
    name: str
    simulated: bool
    anchors_m: dict[int, Vector]
    georeference: GeoreferenceSite | None


class NoFixLine(Struct, frozen=True, tag="no_fix"):
    """A tag that runs, or ran, has no usable fix; sent once a second meanwhile."""

    tag: str
    unix_s: float
    reason: str
    name: str | UnsetType = UNSET
    group: str | UnsetType = UNSET
    """Name and group of the tag's asset, if it has one."""


class JsonLines(Encoder):
    """Encodes a site and the fixes of all tags."""

    def __init__(self) -> None:
        self._site = b""
        self._assets: Mapping[str, Asset] = {}

    def greeting(self) -> list[bytes]:
        """Return the site, once it is known."""
        return [self._site] if self._site else []

    def on_site(self, site: BridgedSite) -> list[bytes]:
        """Encode the site."""
        self._assets = site.assets
        self._site = _line(SiteLine(site.id, site.name, site.simulated, site.anchors_m, site.georeference))
        return [self._site]

    def on_fix(self, fix: FixMessage) -> list[bytes]:
        """Encode a fix, with its type and its asset's name first."""
        return [_encode({"type": "fix", **self._names(fix.tag)})[:-1] + b"," + _line(fix)[1:]]

    def on_no_fix(self, tag: str, unix_s: float, reason: str) -> list[bytes]:
        """Encode the statement that a tag has no fix."""
        return [_line(NoFixLine(tag, unix_s, reason, **self._names(tag)))]

    def _names(self, tag: str) -> dict[str, str]:
        asset = self._assets.get(tag, Asset(tag))
        return {key: value for key, value in (("name", asset.name), ("group", asset.group)) if value}


def _line(value: Struct) -> bytes:
    return _encode(value) + b"\n"


def make_encoder(_url: TargetUrl, _context: BridgeContext) -> JsonLines:
    """Create the encoder, which has no settings."""
    return JsonLines()
