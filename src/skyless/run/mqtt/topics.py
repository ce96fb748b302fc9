"""MQTT topics, version 1 (``docs/mqtt.md``); all topics of a site begin with ``skyless/v1/<site>/``."""

from typing import Final

from msgspec import Struct

ROOT: Final = "skyless/v1"
EVERY_SITE: Final = "+"
EVERY_NODE: Final = "+"


class Topic(Struct, frozen=True):
    """The topics of one kind of message."""

    levels: str
    """Levels below the site's, with ``+`` for each name."""

    def __call__(self, site: int | str, *names: int | str) -> str:
        """The topic at a site, or a filter where the site or a name is ``+``. Raises ValueError without all names."""
        first, *others = self.levels.split("+")
        named = (f"{name}{rest}" for name, rest in zip(names, others, strict=True))
        return f"{ROOT}/{site}/{first}{''.join(named)}"

    @property
    def everywhere(self) -> str:
        """The filter for all sites and names."""
        return f"{ROOT}/{EVERY_SITE}/{self.levels}"


site_topic: Final = Topic("site")
"""Retained ``SiteMessage``."""
floor_plan_topic: Final = Topic("floor_plan")
"""Retained image of the floor, the bytes of a PNG or JPEG."""
plan_of_floor_topic: Final = Topic("floor_plan/+")
"""Retained image of one of several floors, by its number."""
fix_topic: Final = Topic("tag/+/fix")
"""``FixMessage``."""
tag_zones_topic: Final = Topic("tag/+/zone")
"""Retained ``TagZones``."""
tag_position_topic: Final = Topic("tag/+/position")
"""Retained ``TagPosition``."""
status_topic: Final = Topic("+/+/status")
"""Retained ``StatusMessage``, and last will, of a ``tag``, ``anchor``, ``ether``, ``recorder`` or another kind."""
health_topic: Final = Topic("+/+/health")
"""``TagHealth``, ``AnchorHealth`` or ``EtherHealth``, once a second."""
receptions_topic: Final = Topic("tag/+/receptions")
"""``ReceptionsMessage``, on request."""
request_topic: Final = Topic("request")
"""``RequestMessage``: which raw receptions are wanted, and by whom."""
truth_topic: Final = Topic("truth")
"""``TruthMessage``; only a simulated site has one."""
zones_topic: Final = Topic("zones")
"""Retained ``ZonesMessage``."""
zone_event_topic: Final = Topic("zone/+/event")
"""``ZoneEvent``."""
stamps_topic: Final = Topic("anchor/+/stamps")
"""``StampsMessage``, on request."""
survey_topic: Final = Topic("survey/state")
"""Retained ``SurveyMessage``: the survey program's state and newest result."""
survey_facts_topic: Final = Topic("survey/facts")
"""``SurveyFactsMessage``: facts from a user, for the survey program."""
survey_save_topic: Final = Topic("survey/save")
"""``SurveySaveMessage``: a request to use a result."""
placement_topic: Final = Topic("survey/placement")
"""Retained ``PlacementMessage``: positions and delays that running anchors adopt."""
watch_topic: Final = Topic("survey/watch")
"""Retained ``WatchMessage``: anchors that have moved, delays that have changed, links that are blocked."""
assets_topic: Final = Topic("assets")
"""Retained ``AssetsMessage``."""
alarm_rules_topic: Final = Topic("alarm_rules")
"""Retained ``AlarmRulesMessage``: the rules made on the page."""
alarm_topic: Final = Topic("alarm/+/+/state")
"""``AlarmMessage``, retained until the alarm has ended and somebody has acknowledged it."""
acknowledge_topic: Final = Topic("alarm/+/+/acknowledge")
"""``AcknowledgeMessage``."""
