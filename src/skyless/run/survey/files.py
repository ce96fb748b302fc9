"""Write a survey to a site's files: the site file, the record next to it, and the image of the floor."""

from collections.abc import Iterator
from math import dist
from pathlib import Path
from typing import Final
from zlib import crc32

import msgspec
from msgspec import Struct
from msgspec.structs import asdict, replace

from skyless.core.air.site_pages import MAX_COORDINATE_M
from skyless.core.errors import SkylessError, writing
from skyless.core.site import FloorPlanSite, Site
from skyless.files import replace_files
from skyless.run.mqtt.messages import SurveyFactsMessage
from skyless.run.process import Log
from skyless.site.file.check import Limits, check_site, image_size
from skyless.site.file.load import load_site, with_values
from skyless.site.survey.facts import PairRanges, Survey, SurveyRecord, encode_record, read_record, record_path
from skyless.site.survey.surveyed_site import delay_changes_ticks, surveyed_site, surveyed_text

_NEAR_M: Final = 1e-3
_ENDINGS: Final = {b"\x89PNG": ".png"}


class FloorImage(Struct, frozen=True):
    """Placement of the floor's image, and its bytes; None means the image of the site file."""

    plan: FloorPlanSite
    image: bytes | None


class Saved(Struct, frozen=True):
    """The site after a survey."""

    site: Site
    record: SurveyRecord
    written: tuple[Path, ...] = ()


def saved_without_file(site: Site, survey: Survey, ranges: PairRanges, unix_s: float) -> Saved:
    """Return the site after a survey where there is no file to write.

    Raises:
        SkylessError: the result is not a valid site.
    """
    placed = surveyed_site(site, survey)
    check_site(placed, Path("the survey's result"))
    return Saved(placed, _record(site, survey, ranges, unix_s))


def record_of(file: Path | None, site: Site, log: Log) -> SurveyRecord | None:
    """Read the record of the survey that made a site file. Without one the watch learns the usual ranges."""
    if file is None or not record_path(file).exists():
        return None
    try:
        record = read_record(record_path(file))
    except SkylessError as error:
        log(f"not used: {error}")
        return None
    if is_record_of(record, site):
        return record
    log(f"not used: {record_path(file)} is of other positions than those in {file}")
    return None


def is_record_of(record: SurveyRecord, site: Site) -> bool:
    """Whether a site still has the positions that a survey gave it."""
    known = {anchor.id for anchor in site.all_anchors}
    placed = {anchor.id: (anchor.x_m, anchor.y_m) for anchor in site.anchors}
    found = {
        one.id: (one.x_m, one.y_m)
        for one in record.survey.anchors
        if one.determined and one.id in known and one.x_m is not None and one.y_m is not None
    }
    return record.site_id == site.id and all(
        anchor in placed and dist(placed[anchor], place_m) < _NEAR_M for anchor, place_m in found.items()
    )


def save_survey(
    file: Path, survey: Survey, ranges: PairRanges, unix_s: float, floor: FloorImage | None = None
) -> Saved:
    """Write a result into a site's file, and its record next to it; keep the previous file under another name.

    Raises:
        SkylessError: a file cannot be read or written, or the result is not a valid site.
    """
    site = load_site(file)
    record, kept = _record(site, survey, ranges, unix_s), kept_path(file)
    image: dict[Path, bytes] = {}
    with writing(file):
        text = surveyed_text(file.read_bytes().decode("utf-8-sig"), survey, site, file)
        if floor is not None:
            image_name, image = _floor_image(file, site, floor)
            if image_name is not None:
                values = asdict(replace(floor.plan, image=image_name))
                text = with_values(text, {}, {"floor_plan": values}, file, "the floor plan")
        files = {kept: file.read_bytes(), record_path(file): encode_record(record), file: text.encode()}
        replace_files(image | files)
    return Saved(load_site(file), record, (file, record_path(file), kept, *image))


def _record(site: Site, survey: Survey, ranges: PairRanges, unix_s: float) -> SurveyRecord:
    return SurveyRecord(site.name, site.id, unix_s, ranges, survey, delay_changes_ticks(site, survey))


def kept_path(file: Path) -> Path:
    """Path under which to keep the previous site file: ``NAME.before-survey-1.toml``, with the first free number."""
    number = 1
    while (kept := file.with_name(f"{file.stem}.before-survey-{number}{file.suffix}")).exists():
        number += 1
    return kept


def _floor_image(file: Path, site: Site, floor: FloorImage) -> tuple[str | None, dict[Path, bytes]]:
    """Name of the image in the site file (None without one), and the file to write if the image is new."""
    present = None if site.floor_plan is None else site.floor_plan.image
    if floor.image is None or image_size(floor.image) is None:
        return present, {}
    if present is not None and (file.parent / present).read_bytes() == floor.image:
        return present, {}
    path = file.with_name(f"{file.stem}.floor{_ENDINGS.get(floor.image[:4], '.jpg')}")
    if path.exists() and path.read_bytes() != floor.image:
        path = path.with_stem(f"{path.stem}-{crc32(floor.image):08x}")
    return path.name, {path: floor.image}


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
    for name in ("heights_m", "tapes", "points", "sketch_m", "delays"):
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
    for index, delay in enumerate(facts.delays):
        yield f"facts.delays[{index}].delay_m", delay.delay_m, _COORDINATE
        yield f"facts.delays[{index}].std_m", delay.std_m, _POSITIVE_STD
    for name in ("height_std_m", "point_std_m", "sketch_std_m"):
        yield f"facts.{name}", getattr(facts, name), _POSITIVE_STD
    for name in ("delay_std_m", "common_delay_std_m", "pair_std_m"):
        yield f"facts.{name}", getattr(facts, name), _STD
    if plan is not None:
        yield "floor_plan.width_m", plan.width_m, _LENGTH
        yield "floor_plan.x_m", plan.x_m, _COORDINATE
        yield "floor_plan.y_m", plan.y_m, _COORDINATE
