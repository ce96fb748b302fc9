"""MQTT topics, version 1 (``docs/mqtt.md``); all topics of a site begin with ``skyless/v1/<site>/``."""

from typing import Final

ROOT: Final = "skyless/v1"
EVERY_SITE: Final = "+"
EVERY_NODE: Final = "+"


def site_topic(site: int | str) -> str:
    """Retained ``SiteMessage``."""
    return f"{ROOT}/{site}/site"


def floor_plan_topic(site: int | str) -> str:
    """Retained image of the floor, the bytes of a PNG or JPEG."""
    return f"{ROOT}/{site}/floor_plan"


def plan_of_floor_topic(site: int | str, floor: int | str) -> str:
    """Retained image of one of several floors, by its number."""
    return f"{ROOT}/{site}/floor_plan/{floor}"


def fix_topic(site: int | str, tag: str) -> str:
    """``FixMessage``."""
    return f"{ROOT}/{site}/tag/{tag}/fix"


def tag_zones_topic(site: int | str, tag: str) -> str:
    """Retained ``TagZones``."""
    return f"{ROOT}/{site}/tag/{tag}/zone"


def tag_position_topic(site: int | str, tag: str) -> str:
    """Retained ``TagPosition``."""
    return f"{ROOT}/{site}/tag/{tag}/position"


def status_topic(site: int | str, kind: str, name: int | str) -> str:
    """Retained ``StatusMessage``, and last will, of a ``tag``, ``anchor``, ``ether``, ``recorder`` or another kind."""
    return f"{ROOT}/{site}/{kind}/{name}/status"


def health_topic(site: int | str, kind: str, name: int | str) -> str:
    """``TagHealth``, ``AnchorHealth`` or ``EtherHealth``, once a second."""
    return f"{ROOT}/{site}/{kind}/{name}/health"


def receptions_topic(site: int | str, tag: str) -> str:
    """``ReceptionsMessage``, on request."""
    return f"{ROOT}/{site}/tag/{tag}/receptions"


def request_topic(site: int | str) -> str:
    """``RequestMessage``: which raw receptions are wanted, and by whom."""
    return f"{ROOT}/{site}/request"


def truth_topic(site: int | str) -> str:
    """``TruthMessage``; only a simulated site has one."""
    return f"{ROOT}/{site}/truth"


def zones_topic(site: int | str) -> str:
    """Retained ``ZonesMessage``."""
    return f"{ROOT}/{site}/zones"


def zone_event_topic(site: int | str, zone: str) -> str:
    """``ZoneEvent``."""
    return f"{ROOT}/{site}/zone/{zone}/event"


def stamps_topic(site: int | str, anchor: int | str) -> str:
    """``StampsMessage``, on request."""
    return f"{ROOT}/{site}/anchor/{anchor}/stamps"


def survey_topic(site: int | str) -> str:
    """Retained ``SurveyMessage``: the survey program's state and newest result."""
    return f"{ROOT}/{site}/survey/state"


def survey_facts_topic(site: int | str) -> str:
    """``SurveyFactsMessage``: facts from a user, for the survey program."""
    return f"{ROOT}/{site}/survey/facts"


def survey_save_topic(site: int | str) -> str:
    """``SurveySaveMessage``: a request to use a result."""
    return f"{ROOT}/{site}/survey/save"


def placement_topic(site: int | str) -> str:
    """Retained ``PlacementMessage``: positions and delays that running anchors adopt."""
    return f"{ROOT}/{site}/survey/placement"


def watch_topic(site: int | str) -> str:
    """Retained ``WatchMessage``: anchors that have moved, delays that have changed, links that are blocked."""
    return f"{ROOT}/{site}/survey/watch"


def assets_topic(site: int | str) -> str:
    """Retained ``AssetsMessage``."""
    return f"{ROOT}/{site}/assets"


def alarm_rules_topic(site: int | str) -> str:
    """Retained ``AlarmRulesMessage``: the rules made on the page."""
    return f"{ROOT}/{site}/alarm_rules"


def alarm_topic(site: int | str, rule: str, subject: str) -> str:
    """``AlarmMessage``, retained until the alarm has ended and somebody has acknowledged it."""
    return f"{ROOT}/{site}/alarm/{rule}/{subject}/state"


def acknowledge_topic(site: int | str, rule: str, subject: str) -> str:
    """``AcknowledgeMessage``."""
    return f"{ROOT}/{site}/alarm/{rule}/{subject}/acknowledge"
