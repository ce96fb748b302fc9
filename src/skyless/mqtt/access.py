"""Roles at the broker: which topics each may publish and subscribe to (``docs/mqtt.md``, Roles)."""

from enum import StrEnum
from typing import Final

from msgspec import Struct

from skyless.mqtt import topics
from skyless.mqtt.topics import EVERY_NODE, EVERY_SITE


class Role(StrEnum):
    """What a client is for; except for the stranger's, also its user name."""

    ANCHORS = "anchors"
    """Anchors, and the emulated air."""
    TAGS = "tags"
    PAGE = "page"
    """What shows, records and passes on: dashboard, record, bridge; also Home Assistant itself."""
    SURVEY = "survey"
    """What moves anchors: survey, and a dashboard whose users set up the site."""
    OPERATOR = "operator"
    """A person, and programs that are all of a site in one: the demo, tags in a system without Skyless's anchors."""
    STRANGER = "stranger"
    """A client without user and password, where the operator admits it."""


class Access(Struct, frozen=True):
    """Topic filters of a role."""

    publish: tuple[str, ...]
    subscribe: tuple[str, ...]


EVERYTHING: Final = "#"


def _status(*kinds: str) -> tuple[str, ...]:
    return tuple(topics.status_topic(EVERY_SITE, kind, EVERY_NODE) for kind in kinds)


def _health(*kinds: str) -> tuple[str, ...]:
    return tuple(topics.health_topic(EVERY_SITE, kind, EVERY_NODE) for kind in kinds)


_SHOWN: Final = (
    topics.request_topic(EVERY_SITE),
    topics.floor_plan_topic(EVERY_SITE),
    topics.zones_topic(EVERY_SITE),
    topics.zone_event_topic(EVERY_SITE, "+"),
    topics.tag_zones_topic(EVERY_SITE, EVERY_NODE),
    topics.tag_position_topic(EVERY_SITE, EVERY_NODE),
)
"""What the page publishes, whether its users may set up the site or not."""

ACCESS: Final = {
    Role.ANCHORS: Access(
        publish=(
            topics.site_topic(EVERY_SITE),
            topics.floor_plan_topic(EVERY_SITE),
            topics.stamps_topic(EVERY_SITE, EVERY_NODE),
            topics.truth_topic(EVERY_SITE),
            *_status("anchor", "ether"),
            *_health("anchor", "ether"),
        ),
        # A node reads its own status, to correct a late last will.
        subscribe=(topics.request_topic(EVERY_SITE), topics.placement_topic(EVERY_SITE), *_status("anchor", "ether")),
    ),
    Role.TAGS: Access(
        publish=(
            topics.fix_topic(EVERY_SITE, EVERY_NODE),
            topics.receptions_topic(EVERY_SITE, EVERY_NODE),
            *_status("tag"),
            *_health("tag"),
        ),
        subscribe=(topics.request_topic(EVERY_SITE), *_status("tag")),
    ),
    Role.PAGE: Access(
        publish=(
            *_SHOWN,
            *_status("dashboard", "recorder", "bridge", "homeassistant"),
            "homeassistant/device/+/config",
            "homeassistant/status",
        ),
        subscribe=("skyless/#", "homeassistant/#"),
    ),
    Role.SURVEY: Access(
        publish=(
            *_SHOWN,
            topics.survey_topic(EVERY_SITE),
            topics.survey_facts_topic(EVERY_SITE),
            topics.survey_save_topic(EVERY_SITE),
            topics.placement_topic(EVERY_SITE),
            topics.watch_topic(EVERY_SITE),
            *_status("dashboard", "survey"),
        ),
        subscribe=("skyless/#",),
    ),
    Role.OPERATOR: Access(publish=(EVERYTHING,), subscribe=(EVERYTHING,)),
    Role.STRANGER: Access(
        publish=(),
        subscribe=(topics.site_topic(EVERY_SITE), topics.fix_topic(EVERY_SITE, EVERY_NODE)),
    ),
}
