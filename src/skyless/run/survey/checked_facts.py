"""Check the facts that a user sends for a survey."""

from collections.abc import Iterator
from typing import Final

import msgspec

from skyless.core.air.site_pages import MAX_COORDINATE_M
from skyless.run.mqtt.messages import SurveyFactsMessage
from skyless.site.file.check import Limits

MAX_FACTS: Final = 10_000
"""Limit for each of heights, tapes, points and so on."""

_COORDINATE: Final = Limits(-MAX_COORDINATE_M, MAX_COORDINATE_M, "metres")
_LENGTH: Final = Limits(0, MAX_COORDINATE_M, "metres", above=True)
_STD: Final = Limits(0, 100, "metres")
_POSITIVE_STD: Final = Limits(0, 100, "metres", above=True)


class BadFactsError(ValueError):
    """The facts sent, or a request to save, are wrong."""


def check_facts(message: SurveyFactsMessage) -> None:
    """Check that facts can be used. Raises BadFactsError, which names field, value and what would be right."""
    facts = message.facts
    if facts.tags:
        raise BadFactsError(f"facts.tags has {len(facts.tags)} entries; what tags received comes from recordings only")
    for name in ("heights_m", "tapes", "points", "sketch_m"):
        count = len(getattr(facts, name))
        if count > MAX_FACTS:
            raise BadFactsError(f"facts.{name} has {count} entries; at most {MAX_FACTS} are allowed")
    for path, value, limits in _limited(message):
        if not limits.contains(value):
            raise BadFactsError(f"{path} is {value:g}; it should be {limits}")
    for index, tape in enumerate(facts.tapes):
        if tape.a == tape.b:
            raise BadFactsError(f"facts.tapes[{index}] is from anchor {tape.a} to itself; it should be between two")
    if facts.gauge is not None:
        named = [anchor for anchor in msgspec.structs.astuple(facts.gauge) if anchor is not None]
        if len(set(named)) < len(named):
            listed = ", ".join(map(str, named))
            raise BadFactsError(f"facts.gauge names anchors {listed}; origin, x axis and left should be different ones")


def _limited(message: SurveyFactsMessage) -> Iterator[tuple[str, float, Limits]]:
    """Yield each number in metres: path, value and limits."""
    facts, plan = message.facts, message.floor_plan
    for anchor, height_m in facts.heights_m.items():
        yield f"facts.heights_m of anchor {anchor}", height_m, _COORDINATE
    for index, tape in enumerate(facts.tapes):
        yield f"facts.tapes[{index}].distance_m", tape.distance_m, _LENGTH
        yield f"facts.tapes[{index}].std_m", tape.std_m, _POSITIVE_STD
    for name in ("points", "sketch_m"):
        for anchor, point in getattr(facts, name).items():
            for axis, value in zip("xyz", point, strict=True):
                if value is not None:
                    yield f"facts.{name} of anchor {anchor}, {axis}", value, _COORDINATE
    for name in ("height_std_m", "point_std_m", "sketch_std_m"):
        yield f"facts.{name}", getattr(facts, name), _POSITIVE_STD
    for name in ("delay_std_m", "common_delay_std_m", "pair_std_m"):
        yield f"facts.{name}", getattr(facts, name), _STD
    if plan is not None:
        yield "floor_plan.width_m", plan.width_m, _LENGTH
        yield "floor_plan.x_m", plan.x_m, _COORDINATE
        yield "floor_plan.y_m", plan.y_m, _COORDINATE
