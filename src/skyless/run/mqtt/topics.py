"""MQTT topics, version 1 (``docs/mqtt.md``); all topics of a site begin with ``skyless/v1/<site>/``."""

from collections.abc import Callable
from typing import Any, Final

from msgspec import Struct

from skyless.run.mqtt import messages

ROOT: Final = "skyless/v1"
EVERY_SITE: Final = "+"
EVERY_NODE: Final = "+"


class Topic(Struct, frozen=True):
    """The topics of one kind of message."""

    levels: str
    """Levels below the site's, with ``+`` for each name."""
    payload: type[Struct] | None = None
    """What it is; None for an image, and where the names decide."""
    kind: str = ""
    """What a site's readers call it; empty if it is not for them (``site_feed.KINDS``)."""
    retained: bool = False
    """Whether the broker keeps it, so that a reader gets it at once, and perhaps again."""
    once: bool = False
    """Whether it is sent only once, so that readers ask for it with QoS 1."""
    own_name: Callable[[Any], str] | None = None
    """The name that the message itself states, which should be the topic's."""

    def __call__(self, site: int | str, *names: int | str) -> str:
        """The topic at a site, or a filter where the site or a name is ``+``. Raises ValueError without all names."""
        first, *others = self.levels.split("+")
        named = (f"{name}{rest}" for name, rest in zip(names, others, strict=True))
        return f"{ROOT}/{site}/{first}{''.join(named)}"

    @property
    def everywhere(self) -> str:
        """The filter for all sites and names."""
        return f"{ROOT}/{EVERY_SITE}/{self.levels}"


site_topic: Final = Topic("site", messages.SiteMessage, "site", retained=True)
floor_plan_topic: Final = Topic("floor_plan", kind="floor_plan", retained=True)
"""Image of the floor, the bytes of a PNG or JPEG."""
plan_of_floor_topic: Final = Topic("floor_plan/+", kind="floor_plan", retained=True)
"""Image of one of several floors, by its number."""
fix_topic: Final = Topic("tag/+/fix", messages.FixMessage, "fix", own_name=lambda one: str(one.tag))
tag_zones_topic: Final = Topic("tag/+/zone", messages.TagZones, retained=True)
tag_position_topic: Final = Topic("tag/+/position", messages.TagPosition, retained=True)
status_topic: Final = Topic(
    "+/+/status", messages.StatusMessage, "status", retained=True, own_name=lambda one: str(one.name)
)
"""State, and last will, of a ``tag``, ``anchor``, ``ether``, ``recorder`` or another kind."""
health_topic: Final = Topic("+/+/health")
"""``TagHealth``, ``AnchorHealth`` or ``EtherHealth``, once a second."""
receptions_topic: Final = Topic("tag/+/receptions", messages.ReceptionsMessage, "receptions")
request_topic: Final = Topic("request", messages.RequestMessage, "request")
truth_topic: Final = Topic("truth", messages.TruthMessage, "truth")
"""Only a simulated site has one."""
zones_topic: Final = Topic("zones", messages.ZonesMessage, "zones", retained=True, once=True)
zone_event_topic: Final = Topic(
    "zone/+/event", messages.ZoneEvent, "event", once=True, own_name=lambda one: str(one.zone)
)
stamps_topic: Final = Topic("anchor/+/stamps", messages.StampsMessage, "stamps")
survey_topic: Final = Topic("survey/state", messages.SurveyMessage, "survey", retained=True, once=True)
survey_facts_topic: Final = Topic("survey/facts", messages.SurveyFactsMessage)
survey_save_topic: Final = Topic("survey/save", messages.SurveySaveMessage)
placement_topic: Final = Topic("survey/placement", messages.PlacementMessage, retained=True)
watch_topic: Final = Topic("survey/watch", messages.WatchMessage, "watch", retained=True, once=True)
assets_topic: Final = Topic("assets", messages.AssetsMessage, "assets", retained=True, once=True)
alarm_rules_topic: Final = Topic("alarm_rules", messages.AlarmRulesMessage, "alarm_rules", retained=True, once=True)
alarm_topic: Final = Topic(
    "alarm/+/+/state", messages.AlarmMessage, "alarm",
    retained=True, once=True, own_name=lambda one: f"{one.rule}/{one.subject}",
)  # fmt: skip
"""Retained until the alarm has ended and somebody has acknowledged it."""
acknowledge_topic: Final = Topic("alarm/+/+/acknowledge", messages.AcknowledgeMessage, "acknowledge", once=True)
