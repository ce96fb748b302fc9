"""JSON lines: one object per line over TCP or per datagram over UDP; SI units, the site's own frame.

``type`` is ``site``, ``fix`` (the fields of a fix on MQTT, ``docs/mqtt.md``) or ``no_fix``.
"""

from collections.abc import Mapping
from typing import Final

import msgspec

from skyless.bridges.target import BridgeContext, BridgedSite, Encoder, TargetUrl
from skyless.run.mqtt.messages import Asset, FixMessage

_encode: Final = msgspec.json.Encoder().encode


class JsonLines(Encoder):
    """Encodes everything as JSON lines."""

    def __init__(self) -> None:
        self._site = b""
        self._assets: Mapping[str, Asset] = {}

    def greeting(self) -> list[bytes]:
        """The site, once known: first for each new reader."""
        return [self._site] if self._site else []

    def on_site(self, site: BridgedSite) -> list[bytes]:
        """The site, after each change."""
        self._assets = site.assets
        named = {"type": "site", "id": site.id, "name": site.name, "simulated": site.simulated}
        self._site = _line({**named, "anchors_m": site.anchors_m, "georeference": site.georeference})
        return [self._site]

    def on_fix(self, fix: FixMessage) -> list[bytes]:
        """The fix, with its type and its asset's name first."""
        return [_encode({"type": "fix", **self._names(fix.tag)})[:-1] + b"," + _line(fix)[1:]]

    def on_no_fix(self, tag: str, unix_s: float, reason: str) -> list[bytes]:
        """That there is no fix: once a second while that lasts."""
        return [_line({"type": "no_fix", "tag": tag, "unix_s": unix_s, "reason": reason, **self._names(tag)})]

    def _names(self, tag: str) -> dict[str, str]:
        """Name and group of the tag's asset, as far as it has them."""
        asset = self._assets.get(tag, Asset(tag))
        return {key: value for key, value in (("name", asset.name), ("group", asset.group)) if value}


def _line(value: object) -> bytes:
    return _encode(value) + b"\n"


def make_encoder(_url: TargetUrl, _context: BridgeContext) -> JsonLines:
    """Create the encoder; lines have no settings."""
    return JsonLines()
