"""What the demo's own site has besides walking tags: a plan, zones, names, a rule, a georeference, a moved anchor."""

from itertools import combinations
from math import dist
from pathlib import Path
from typing import Final

import msgspec
from msgspec.structs import replace

from skyless.core.site import AlarmRule, FloorPlanSite, GeoreferenceSite, Site
from skyless.run.mqtt.messages import Asset, AssetsMessage, Zone, ZonesMessage
from skyless.run.mqtt.topics import assets_topic, zones_topic
from skyless.site.file.template import rectangle
from skyless.site.survey.facts import PairRange, PairRanges, Survey, SurveyedAnchor, SurveyRecord

_NAME: Final = "Workshop"
_PLAN: Final = Path(__file__).with_name("demo_plan.png")
_CELL: Final = Zone("cell", "Robot cell", ((3.7, 0.4), (5.7, 0.4), (5.7, 2.7), (3.7, 2.7)), "#c2410c")
_GOODS_IN: Final = Zone("goods-in", "Goods in", ((0.3, 5.3), (2.7, 5.3), (2.7, 7.7), (0.3, 7.7)), "#0f766e")
_PEOPLE: Final = "people"
_ASSETS: Final = (
    Asset("tag1", "Trolley", "vehicles", "▲", "#b45309"),
    Asset("tag2", "Forklift", "vehicles", "◆", "#7c3aed"),
    Asset("tag3", "Ada", _PEOPLE, "●", "#0284c7"),
)
_RULE: Final = AlarmRule(
    "robot-cell", "inside", "Person in the robot cell", zone=_CELL.id, tags=(f"group:{_PEOPLE}",), severity="critical"
)
MOVED: Final = "3=0,0.6@60"
"""The anchor that is hung elsewhere after a minute, for ``skyless ether --move``."""


def furnished(lab: Site) -> Site:
    """The lab as a workshop. Where it is on the Earth is made up."""
    return replace(
        lab,
        name=_NAME,
        outline_m=rectangle(6.0, 8.0),
        floor_plan=FloorPlanSite(str(_PLAN), width_m=6.0),
        georeference=GeoreferenceSite(52.5163, 13.3777, height_m=35.0, heading_deg=20.0),
        alarms=(_RULE,),
    )


def survey_record(site: Site) -> SurveyRecord:
    """The survey that has hung its anchors, without errors: with its ranges the watch need not learn what is usual."""
    pairs = tuple(
        PairRange(a.id, b.id, dist((a.x_m, a.y_m, a.z_m), (b.x_m, b.y_m, b.z_m)), std_m=0.005, exchanges=1000)
        for a, b in combinations(site.anchors, 2)
    )
    anchors = tuple(SurveyedAnchor(one.id, True, one.x_m, one.y_m, one.z_m) for one in site.anchors)
    ranges = PairRanges(pairs, tuple(one.id for one in site.anchors))
    survey = Survey(anchors, (), 0.01, len(pairs) - 2 * len(anchors) + 3, None, (), (), (), "", None, ())
    return SurveyRecord(site.name, site.id, 0.0, ranges, survey, {})


def messages_of(site: Site) -> dict[str, bytes]:
    """By topic what the page would make the broker keep: zones, and the tags' names."""
    return {
        zones_topic(site.id): msgspec.json.encode(ZonesMessage((_CELL, _GOODS_IN), site=site.name)),
        assets_topic(site.id): msgspec.json.encode(AssetsMessage(_ASSETS, site=site.name)),
    }
