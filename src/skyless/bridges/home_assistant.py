"""``homeassistant:``: tags as devices of Home Assistant over MQTT, each with its room.

Discovery documents: https://www.home-assistant.io/integrations/mqtt/#device-discovery-payload, since 2024.11.
Everything is retained, so that Home Assistant has it when it starts. Its recorder keeps each change: rooms are sent
when they change, positions and accuracies at most once a second, and only after considerable changes.
"""

import asyncio
import platform
import re
import time
from collections import Counter
from collections.abc import Mapping
from math import dist, sqrt
from typing import Final

import msgspec
from msgspec import Struct

from skyless.bridges.target import TAG_NAME, BridgeContext, BridgedSite, Target, TargetUrl, floored
from skyless.core.earth import geodetic
from skyless.core.errors import SkylessError
from skyless.core.version import installed_version
from skyless.run.mqtt.address import MqttAddress, mqtt_address
from skyless.run.mqtt.connection import Limits
from skyless.run.mqtt.link import Link
from skyless.run.mqtt.messages import Asset, FixMessage, TagPosition, TagZones, WrongMessageError, Zone, read_message
from skyless.run.mqtt.topics import status_topic, tag_position_topic, tag_zones_topic
from skyless.run.site_table import THRESHOLDS
from skyless.run.zones import ZoneMonitor

OUTSIDE: Final = "outside"
"""The room of a tag that is in no zone."""

_DOCUMENTS: Final = "https://github.com/skyless-uwb/skyless"
_ONLINE: Final = "{{ 'online' if value_json.online else 'offline' }}"
_USABLE: Final = "{{ 'online' if value_json.usable else 'offline' }}"
_ROOM: Final = f"{{{{ value_json.name or '{OUTSIDE}' }}}}"
_ATTRIBUTES: Final = (
    "{{ {'latitude': value_json.latitude_deg, 'longitude': value_json.longitude_deg, "
    "'altitude': value_json.height_m, 'gps_accuracy': value_json.horizontal_std_m} | tojson }}"
)

Component = dict[str, object]


def device_id(site: int, tag: str) -> str:
    """Permanent identifier of a tag; the ids of its entities begin with it."""
    return f"skyless_{site}_{tag}"


def document(site: BridgedSite, tag: str, status_topic: str, removed: Mapping[str, str]) -> bytes:
    """The discovery document of a tag.

    It has the sensor Accuracy; with zones, the sensor Room and a binary sensor for each of them; on a georeferenced
    site, a tracker. A tag with an asset has its name, and the asset's group as identifier of the model: a group is no
    place, so no area is suggested.

    All are unavailable while the bridge is offline or the tag has no usable fix. ``status_topic`` is the bridge's;
    ``removed``: platforms of the components of an earlier document, by key.
    """
    components = _components(site, tag)
    for key, component in components.items():
        component["unique_id"] = f"{device_id(site.id, tag)}_{key}"
    stubs: dict[str, Component] = {key: {"platform": platform} for key, platform in removed.items()}
    asset = site.assets.get(tag, Asset(tag))
    return msgspec.json.encode(
        {
            "device": {
                "identifiers": [device_id(site.id, tag)],
                "name": asset.name or tag,
                "manufacturer": "Skyless",
                "model": f"UWB tag at {site.name}" + (" (simulated)" if site.simulated else ""),
                **({"serial_number": tag} if asset.name else {}),
                **({"model_id": asset.group} if asset.group else {}),
            },
            "origin": {"name": "Skyless", "sw_version": installed_version(), "support_url": _DOCUMENTS},
            "availability_mode": "all",
            "availability": [
                {"topic": status_topic, "value_template": _ONLINE},
                {"topic": tag_zones_topic(site.id, tag), "value_template": _USABLE},
            ],
            "components": stubs | components,
        }
    )


def _components(site: BridgedSite, tag: str) -> dict[str, Component]:
    zones_topic, position_topic = tag_zones_topic(site.id, tag), tag_position_topic(site.id, tag)
    components: dict[str, Component] = {
        "accuracy": {
            "platform": "sensor",
            "name": "Accuracy",
            "device_class": "distance",
            "state_class": "measurement",
            "unit_of_measurement": "m",
            "suggested_display_precision": 2,
            "entity_category": "diagnostic",
            "state_topic": position_topic,
            "value_template": "{{ value_json.std_m }}",
        }
    }
    if site.georeference is not None:
        components["position"] = {
            "platform": "device_tracker",
            "name": "Position",
            "source_type": "gps",
            "json_attributes_topic": position_topic,
            "json_attributes_template": _ATTRIBUTES,
        }
    if site.zones:
        components["room"] = {
            "platform": "sensor",
            "name": "Room",
            "icon": "mdi:floor-plan",
            "state_topic": zones_topic,
            "value_template": _ROOM,
        }
    # By identifiers, so that renaming changes nothing.
    return components | {f"zone_{zone.id}": _occupancy(zone, zones_topic) for zone in site.zones}


def _occupancy(zone: Zone, topic: str) -> Component:
    return {
        "platform": "binary_sensor",
        "name": f"In {zone.name or zone.id}",
        "device_class": "occupancy",
        "state_topic": topic,
        "value_template": f"{{{{ 'ON' if '{zone.id}' in value_json.zones else 'OFF' }}}}",
    }


def platforms(kept: bytes) -> dict[str, str]:
    """Platforms of a document's components by key, without removed ones. Empty for anything else."""
    try:
        components = read_message(kept, _Document).components
    except WrongMessageError:
        return {}
    return {key: component.platform for key, component in components.items() if component.unique_id}


class _Component(msgspec.Struct, frozen=True):
    platform: str
    unique_id: str = ""


class _Document(msgspec.Struct, frozen=True):
    components: dict[str, _Component]


NODE_KIND: Final = "homeassistant"
"""Kind of the status on MQTT."""

MAX_ANNOUNCED: Final = 500
"""Further tags are not announced."""

_STD_CHANGE: Final = 1.25
"""Accuracies that differ by less than this factor count as equal."""


class _Tag(Struct):
    """A tag's published state and newest fix."""

    name: str
    document: bytes = b""
    was_kept: bool = False
    """Whether a retained document of it, or another bridge's, has been read."""
    removed: dict[str, str] = {}
    """Platforms of its former components by key."""
    zones: TagZones | None = None
    fix: FixMessage | None = None
    """None while it has no usable one."""
    position: TagPosition | None = None


class Announcer:
    """Publishes the tags of one site to one Home Assistant."""

    def __init__(self, link: Link, site: BridgedSite, name: str, prefix: str, move_m: float) -> None:
        """``name``: the bridge's on MQTT; ``prefix``: Home Assistant's discovery prefix.

        A position is sent again when the tag has moved by ``move_m``.
        """
        self.dropped: Counter[str] = Counter()
        self._link, self._site, self._name, self._prefix, self._move_m = link, site, name, prefix, move_m
        self._tags: dict[str, _Tag] = {}
        self._monitor = ZoneMonitor()
        self._monitor.set_zones(site.zones, 0.0)
        self._kept: dict[str, int] = {}
        """Tags that this bridge had before, from retained messages, and the seconds left to wait for them."""
        link.subscribe(f"{prefix}/status", self._on_birth)  # ``online`` when Home Assistant has started
        link.subscribe(tag_zones_topic(site.id, "+"), self._on_kept_zones, 1)

    def on_site(self, site: BridgedSite) -> None:
        """Announce all tags again, because place or zones have changed."""
        self._site = site
        self._monitor.set_zones(site.zones, 0.0)
        for tag in self._tags.values():
            before = platforms(tag.document)
            self._announce(tag)
            self._remove(tag, before)

    def on_fix(self, fix: FixMessage) -> None:
        """Process a usable fix."""
        tag = self._tags.get(fix.tag) or self._add(fix.tag)
        if tag is None:
            return
        self._monitor.update(fix)
        tag.fix = fix
        self._send_zones(tag, fix.unix_s)
        if tag.position is None:
            self._send_position(tag, fix)

    def on_gone(self, name: str, unix_s: float) -> None:
        """The tag has gone, or is of another site."""
        self._monitor.remove_tag(name, unix_s)
        tag = self._tags.get(name)
        if tag is not None:
            tag.fix = tag.position = None
            self._send_zones(tag, unix_s)

    def on_site_left(self, unix_s: float) -> None:
        """No tag has a fix of this site any more."""
        for name in self._tags:
            self.on_gone(name, unix_s)

    def on_second(self, unix_s: float) -> None:
        """Send considerable changes; once a second."""
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
        if not TAG_NAME.fullmatch(name) or len(self._tags) >= MAX_ANNOUNCED:
            self.dropped["tag-name" if len(self._tags) < MAX_ANNOUNCED else "too-many-tags"] += 1
            return None
        tag = self._tags[name] = _Tag(name)
        # Before it is announced: what the broker has kept comes only as long as nothing has replaced it.
        self._link.subscribe(self._config_topic(name), lambda _, kept: self._on_kept(name, kept))
        self._announce(tag)
        return tag

    def _config_topic(self, name: str) -> str:
        """Topic of a tag's retained document; an empty one removes the tag."""
        return f"{self._prefix}/device/{device_id(self._site.id, name)}/config"

    def _announce(self, tag: _Tag) -> None:
        tag.document = document(self._site, tag.name, status_topic(self._site.id, NODE_KIND, self._name), tag.removed)
        self._publish(self._config_topic(tag.name), tag.document)

    def _remove(self, tag: _Tag, before: dict[str, str]) -> None:
        """Let Home Assistant remove components of an earlier document."""
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
        place = () if origin is None else map(round, geodetic(fix.position_m, origin), (8, 8, 3))
        tag.position = TagPosition(tag.name, fix.unix_s, fix.position_m, std_m, horizontal_std_m, *place)
        self._publish(tag_position_topic(self._site.id, tag.name), tag.position)

    def _publish(self, topic: str, message: Struct | bytes) -> None:
        self._link.publish(topic, message, qos=1, retain=True)

    # What comes from the broker

    def _on_birth(self, _topic: str, payload: bytes) -> None:
        """Home Assistant has started: publish all present tags again."""
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
        """Process a retained document: an empty one removes its tag, an older one may have obsolete components.

        Only one is read: two bridges with different zones would answer each other for ever.
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
        """Process this bridge's statement from before its restart, which must not persist if the tag has gone."""
        try:
            kept = read_message(payload, TagZones)
        except WrongMessageError:
            return
        if kept.usable and kept.by == self._name and TAG_NAME.fullmatch(kept.tag) and len(self._kept) < MAX_ANNOUNCED:
            self._kept[kept.tag] = round(THRESHOLDS.longest_s)


def _are_alike(a: float, b: float) -> bool:
    """Whether two accuracies count as equal."""
    return max(a, b) <= _STD_CHANGE * min(a, b)


def _stds_m(fix: FixMessage) -> tuple[float, float]:
    """Radial standard deviations in space and on the floor."""
    variances = floored(fix.covariance_m2)[::4]
    return round(sqrt(sum(variances)), 3), round(sqrt(sum(variances[:2])), 3)


_PREFIX: Final = re.compile(r"[A-Za-z0-9_-]+(/[A-Za-z0-9_-]+)*")

_LIMITS: Final = Limits(topics=4 * MAX_ANNOUNCED + 1, topic_bytes=64_000_000)
"""Three topics of each tag, one of each former tag, and the status; 100 zones make a document of 50 kB."""

SETTLE_S: Final = 3
"""Time that the site has to be known before tags are announced, as its zones come after it: Home Assistant would
lose a user's settings for sensors of missing zones."""


class HomeAssistant(Target):
    """Connects when the first tag has a fix and the site has been known for ``SETTLE_S``.

    The bridge's name on MQTT includes that tag's name, so that bridges on one computer are distinct.
    """

    def __init__(self, url: TargetUrl, context: BridgeContext) -> None:
        """``homeassistant:`` or ``homeassistant://[USER[:PASSWORD]@]HOST[:PORT]``. Raises SkylessError.

        Keys: ``tls=yes|no`` of a broker that the address names; ``prefix`` of discovery; ``move_m``, by which a tag has
        to move for its position to be sent again.
        """
        super().__init__(url.text)
        tls = url.choice("tls", ("no", "yes"), "no") == "yes"
        self._prefix = url.text_option("prefix", "homeassistant")
        if not _PREFIX.fullmatch(self._prefix):
            right = "letters, digits, -, _ and / between them"
            raise SkylessError(f"the target {url.text!r} has prefix={self._prefix}; it should be {right}")
        self._move_m = url.number("move_m", 0.25, 0.0, 100.0)
        self._address, self._log = _broker(url, context, tls=tls), context.log
        self._site: BridgedSite | None = None
        self._announcer: Announcer | None = None
        self._link: Link | None = None
        self._begun = asyncio.Event()
        self._known_s = 0
        """Seconds for which the site has been known."""

    def on_site(self, site: BridgedSite) -> None:
        """Announce what has changed. Raises SkylessError if it is another site."""
        if self._site is not None and site.id != self._site.id:
            if self._announcer is not None:
                self._announcer.on_site_left(time.time())
            raise SkylessError(f"{self.text} serves site {self._site.id}, not site {site.id}; start the bridge again")
        if site.georeference is None and (self._site is None or self._site.georeference is not None):
            self._log(
                f"{self.text} gives rooms, but no position on the map: site {site.id} ({site.name}) does not say where "
                "it is; its site file should have [georeference] with latitude_deg and longitude_deg"
            )
        self._site = site
        if self._announcer is not None:
            self._announcer.on_site(site)

    def on_fix(self, fix: FixMessage) -> None:
        """Publish its rooms and position."""
        if self._announcer is None and self._site is not None and self._known_s >= SETTLE_S:
            self._begin(self._site, fix.tag)
        if self._announcer is not None:
            self._announcer.on_fix(fix)

    def on_gone(self, tag: str, unix_s: float) -> None:
        """Make the tag unavailable."""
        if self._announcer is not None:
            self._announcer.on_gone(tag, unix_s)

    def on_second(self, unix_s: float) -> None:
        """Send changed positions."""
        self._known_s += self._site is not None
        if self._announcer is not None:
            self._announcer.on_second(unix_s)

    async def run(self) -> None:
        """Keep the link from the first fix until cancelled."""
        await self._begun.wait()
        assert self._link is not None
        await self._link.run()

    def _begin(self, site: BridgedSite, tag: str) -> None:
        name = re.sub(r"[^A-Za-z0-9_-]", "-", f"{platform.node()}-{tag}")
        self._link = Link(self._address, name, site=site.id, kind=NODE_KIND, limits=_LIMITS)
        self._announcer = Announcer(self._link, site, name, self._prefix, self._move_m)
        self._announcer.dropped = self.dropped
        self._begun.set()


make_target: Final = HomeAssistant


def _broker(url: TargetUrl, context: BridgeContext, *, tls: bool) -> MqttAddress:
    expected = url.wrong("homeassistant: with --mqtt, or homeassistant://[USER[:PASSWORD]@]HOST[:PORT]")
    netloc = url.netloc()
    if netloc:
        try:
            return mqtt_address(f"mqtt{'s' if tls else ''}://{netloc}")
        except SkylessError:
            raise expected from None
    if context.mqtt is None:
        raise expected
    return context.mqtt
