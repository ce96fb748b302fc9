"""The documents by which Home Assistant learns of a tag: MQTT device discovery, as Home Assistant has it since 2024.11.

Source: https://www.home-assistant.io/integrations/mqtt/#device-discovery-payload. Pure functions.
"""

from collections.abc import Mapping
from typing import Final

import msgspec

import skyless
from skyless.bridges.feed import BridgedSite
from skyless.mqtt.messages import Zone
from skyless.mqtt.topics import tag_position_topic, tag_zones_topic

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
    """What identifies a tag for ever; the ids of its entities begin with it."""
    return f"skyless_{site}_{tag}"


def config_topic(prefix: str, site: int, tag: str) -> str:
    """Retained document of a tag; an empty one removes the tag."""
    return f"{prefix}/device/{device_id(site, tag)}/config"


def birth_topic(prefix: str) -> str:
    """``online`` when Home Assistant has started."""
    return f"{prefix}/status"


def document(site: BridgedSite, tag: str, status_topic: str, removed: Mapping[str, str]) -> bytes:
    """The document of a tag.

    It has the sensor Accuracy; where there are zones, the sensor Room and a binary sensor for each of them; a tracker
    where the site is georeferenced. All are unavailable while the bridge is offline or the tag has no usable fix.
    ``status_topic`` is the bridge's; ``removed`` has the platforms of components that an earlier document had, by key.
    """
    components = _components(site, tag)
    for key, component in components.items():
        component["unique_id"] = f"{device_id(site.id, tag)}_{key}"
    stubs: dict[str, Component] = {key: {"platform": platform} for key, platform in removed.items()}
    return msgspec.json.encode(
        {
            "device": {
                "identifiers": [device_id(site.id, tag)],
                "name": tag,
                "manufacturer": "Skyless",
                "model": f"UWB tag at {site.name}" + (" (simulated)" if site.simulated else ""),
            },
            "origin": {"name": "Skyless", "sw_version": skyless.__version__, "support_url": _DOCUMENTS},
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
        },
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
    return components | {zone_key(zone): _occupancy(zone, zones_topic) for zone in site.zones}


def zone_key(zone: Zone) -> str:
    """Key of a zone's component: of its id, so that another name changes nothing."""
    return f"zone_{zone.id}"


def _occupancy(zone: Zone, topic: str) -> Component:
    return {
        "platform": "binary_sensor",
        "name": f"In {zone.name or zone.id}",
        "device_class": "occupancy",
        "state_topic": topic,
        "value_template": f"{{{{ 'ON' if '{zone.id}' in value_json.zones else 'OFF' }}}}",
    }


def platforms(kept: bytes) -> dict[str, str]:
    """The platforms of a document's components by key, without those that it removes. Empty for anything else."""
    try:
        components = msgspec.json.decode(kept, type=_Document).components
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError):
        return {}
    return {key: component.platform for key, component in components.items() if component.unique_id}


class _Component(msgspec.Struct, frozen=True):
    platform: str
    unique_id: str = ""


class _Document(msgspec.Struct, frozen=True):
    components: dict[str, _Component]
