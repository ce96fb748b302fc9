"""Announces tags, and says at which rooms and positions they are, to an MQTT link. No I/O; the time is in the messages.

Everything is retained, so that Home Assistant has it all when it starts. Its recorder keeps each change: rooms are sent
when they change, positions and accuracies at most once a second, and only when they have changed by much.
"""

from collections import Counter
from collections.abc import Callable
from math import dist, sqrt
from typing import Final, Protocol

import msgspec
from msgspec import Struct

from skyless.bridges.feed import BridgedSite, floored
from skyless.bridges.home_assistant.discovery import birth_topic, config_topic, document, platforms
from skyless.bridges.target_url import TAG_NAME
from skyless.mqtt.messages import FixMessage, TagPosition, TagZones, Vector
from skyless.mqtt.topics import status_topic, tag_position_topic, tag_zones_topic
from skyless.site.earth import geodetic
from skyless.zones.monitor import ZoneMonitor

NODE_KIND: Final = "homeassistant"
"""Kind of the status on MQTT."""

STALE_S: Final = 5
"""A tag that this bridge had before it was started again must have a fix within this time."""

MOST_ANNOUNCED: Final = 500
"""Further ones are not announced."""

_STD_CHANGE: Final = 1.25
"""An accuracy that has changed by less than this factor counts as the same."""


class MqttLink(Protocol):
    """The part of ``skyless.mqtt.link.Link`` that is used."""

    def publish(self, topic: str, message: Struct | bytes, *, qos: int = 0, retain: bool = False) -> None:
        """Queue a message; returns at once."""

    def subscribe(self, topic_filter: str, handler: Callable[[str, bytes], None], qos: int = 0) -> None:
        """Call ``handler`` with topic and payload of every message."""

    def forget(self, topic: str) -> None:
        """Stop repeating a retained message."""


class _Tag(Struct):
    """What was sent of a tag, and its newest fix."""

    name: str
    document: bytes = b""
    was_kept: bool = False
    """Whether a document of it that the broker had, or another bridge's, has been read."""
    removed: dict[str, str] = {}
    """Platforms of components that it had before, by key."""
    zones: TagZones | None = None
    fix: FixMessage | None = None
    """None while it has no usable one."""
    position: TagPosition | None = None


class Announcer:
    """The tags of one site, as one Home Assistant gets them."""

    def __init__(self, link: MqttLink, site: BridgedSite, name: str, prefix: str, move_m: float) -> None:
        """``name`` is the bridge's on MQTT, ``prefix`` Home Assistant's for discovery.

        A position is sent again when the tag has moved by ``move_m``.
        """
        self.dropped: Counter[str] = Counter()
        self._link, self._site, self._name, self._prefix, self._move_m = link, site, name, prefix, move_m
        self._tags: dict[str, _Tag] = {}
        self._monitor = ZoneMonitor()
        self._monitor.set_zones(site.zones, 0.0)
        self._kept: dict[str, int] = {}
        """Tags that this bridge had before, by what the broker has kept, and for how many seconds to wait for them."""
        link.subscribe(birth_topic(prefix), self._on_birth)
        link.subscribe(tag_zones_topic(site.id, "+"), self._on_kept_zones, 1)

    def on_site(self, site: BridgedSite) -> None:
        """Another place, other zones: announce all tags again."""
        self._site = site
        self._monitor.set_zones(site.zones, 0.0)
        for tag in self._tags.values():
            before = platforms(tag.document)
            self._announce(tag)
            self._remove(tag, before)

    def on_fix(self, fix: FixMessage) -> None:
        """A usable fix."""
        tag = self._tags.get(fix.tag) or self._add(fix.tag)
        if tag is None:
            return
        self._monitor.update(fix, fix.unix_s)
        tag.fix = fix
        self._send_zones(tag, fix.unix_s)
        if tag.position is None:
            self._send_position(tag, fix)

    def on_no_fix(self, name: str, unix_s: float) -> None:
        """A tag has no usable fix any more."""
        self._monitor.remove_tag(name, unix_s)
        tag = self._tags.get(name)
        if tag is not None:
            tag.fix = tag.position = None
            self._send_zones(tag, unix_s)

    def on_site_left(self, unix_s: float) -> None:
        """No tag has a fix of this site any more."""
        for name in self._tags:
            self.on_no_fix(name, unix_s)

    def on_second(self, unix_s: float) -> None:
        """Send what has changed by much; once a second."""
        for tag in self._tags.values():
            if tag.fix is not None and self._has_changed(tag, tag.fix):
                self._send_position(tag, tag.fix)
        for name, left_s in tuple(self._kept.items()):
            self._kept[name] = left_s - 1
            if name in self._tags or left_s == 0:
                del self._kept[name]
            if name not in self._tags and left_s == 0:
                self._publish(tag_zones_topic(self._site.id, name), TagZones(name, unix_s, usable=False, by=self._name))

    def _add(self, name: str) -> _Tag | None:
        if not TAG_NAME.fullmatch(name) or len(self._tags) >= MOST_ANNOUNCED:
            self.dropped["tag-name" if len(self._tags) < MOST_ANNOUNCED else "too-many-tags"] += 1
            return None
        tag = self._tags[name] = _Tag(name)
        # Before it is announced: what the broker has kept comes only as long as nothing has replaced it.
        self._link.subscribe(self._config_topic(name), lambda _, kept: self._on_kept(name, kept))
        self._announce(tag)
        return tag

    def _config_topic(self, name: str) -> str:
        return config_topic(self._prefix, self._site.id, name)

    def _announce(self, tag: _Tag) -> None:
        status = status_topic(self._site.id, NODE_KIND, self._name)
        tag.document = document(self._site, tag.name, status, tag.removed)
        self._publish(self._config_topic(tag.name), tag.document)

    def _remove(self, tag: _Tag, before: dict[str, str]) -> None:
        """Let Home Assistant remove components that an earlier document had."""
        now = platforms(tag.document)
        tag.removed = {key: platform for key, platform in (tag.removed | before).items() if key not in now}
        if not before.keys() <= now.keys():
            self._announce(tag)

    def _send_zones(self, tag: _Tag, unix_s: float) -> None:
        zones = self._monitor.zones_with(tag.name) if tag.fix is not None else []
        first = zones[0] if zones else None
        message = TagZones(
            tag=tag.name,
            unix_s=unix_s,
            usable=tag.fix is not None,
            zone=None if first is None else first.id,
            name=None if first is None else first.name or first.id,
            zones=tuple(zone.id for zone in zones),
            by=self._name,
        )
        if tag.zones is None or msgspec.structs.replace(message, unix_s=tag.zones.unix_s) != tag.zones:
            tag.zones = message
            self._publish(tag_zones_topic(self._site.id, tag.name), message)

    def _has_changed(self, tag: _Tag, fix: FixMessage) -> bool:
        if tag.position is None or dist(fix.position_m, tag.position.position_m) >= self._move_m:
            return True
        return not _are_alike(_stds_m(fix)[0], tag.position.std_m)

    def _send_position(self, tag: _Tag, fix: FixMessage) -> None:
        std_m, horizontal_std_m = _stds_m(fix)
        if tag.position is not None and _are_alike(std_m, tag.position.std_m):
            std_m, horizontal_std_m = tag.position.std_m, tag.position.horizontal_std_m
        origin = self._site.georeference
        latitude_deg, longitude_deg, height_m = (
            (None, None, None) if origin is None else _rounded(geodetic(fix.position_m, origin))
        )
        tag.position = TagPosition(
            tag=tag.name,
            unix_s=fix.unix_s,
            position_m=fix.position_m,
            std_m=std_m,
            horizontal_std_m=horizontal_std_m,
            latitude_deg=latitude_deg,
            longitude_deg=longitude_deg,
            height_m=height_m,
        )
        self._publish(tag_position_topic(self._site.id, tag.name), tag.position)

    def _publish(self, topic: str, message: Struct | bytes) -> None:
        self._link.publish(topic, message, qos=1, retain=True)

    # What comes from the broker

    def _on_birth(self, _topic: str, payload: bytes) -> None:
        """Home Assistant has started: say all of the tags that are there again."""
        if payload != b"online":
            return
        for tag in self._tags.values():
            if tag.fix is not None:
                self._announce(tag)
                for topic, message in (
                    (tag_zones_topic(self._site.id, tag.name), tag.zones),
                    (tag_position_topic(self._site.id, tag.name), tag.position),
                ):
                    if message is not None:
                        self._publish(topic, message)

    def _on_kept(self, name: str, kept: bytes) -> None:
        """A document of a tag: an empty one has removed it; an older one may have components that are no more.

        Only one is read: two bridges that know different zones would answer each other without end.
        """
        tag = self._tags.get(name)
        if tag is None or kept == tag.document:
            return
        if not kept:
            del self._tags[name]
            self._monitor.remove_tag(name, 0.0)
            site = self._site.id
            for topic in (self._config_topic(name), tag_zones_topic(site, name), tag_position_topic(site, name)):
                self._link.forget(topic)
        elif not tag.was_kept:
            tag.was_kept = True
            self._remove(tag, platforms(kept))

    def _on_kept_zones(self, _topic: str, payload: bytes) -> None:
        """What this bridge said before it was started again: it must not stay where the tag has gone meanwhile."""
        try:
            kept = msgspec.json.decode(payload, type=TagZones)
        except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError):
            return
        if kept.usable and kept.by == self._name and TAG_NAME.fullmatch(kept.tag) and len(self._kept) < MOST_ANNOUNCED:
            self._kept[kept.tag] = STALE_S


def _are_alike(a: float, b: float) -> bool:
    """Whether two accuracies count as the same."""
    return max(a, b) <= _STD_CHANGE * min(a, b)


def _stds_m(fix: FixMessage) -> tuple[float, float]:
    """Radial standard deviations in space and on the floor."""
    variances = floored(fix.covariance_m2)[::4]
    return round(sqrt(sum(variances)), 3), round(sqrt(sum(variances[:2])), 3)


def _rounded(position: Vector) -> Vector:
    latitude_deg, longitude_deg, height_m = position
    return round(latitude_deg, 8), round(longitude_deg, 8), round(height_m, 3)
