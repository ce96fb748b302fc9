"""Write a survey's result into a site and its files: positions, TX antenna delays, and their accuracy.

Rules (``docs/survey.md``, "What is written"):

- The TX antenna delay of an anchor grows by 2·h; then h is 0 for tags and anchors alike.
- The accuracy of positions is stated per anchor in protocol 2 (``std_m``), and as one figure for all in protocol 1
  (``accuracy.survey_std_m``). Errors of delays are not added: they partly compensate for errors of the positions, so
  that a tag sees less than either alone.
- ``accuracy.range_std_m`` is raised to the constant error of the ranges between anchors, if that is larger: a tag's
  ranges are not better.
- If delays change, the accuracy changes as well, by 0.1 mm if nothing else: this tells tags to restart, because the
  range errors that they have learned include the old delays, and delays are not sent on the air.
"""

import math
from collections.abc import Callable
from math import dist
from os import PathLike
from pathlib import Path
from typing import Final
from zlib import crc32

import msgspec
from msgspec import Struct
from msgspec.structs import asdict, replace

from skyless.core.errors import ConfigurationError, SkylessError, writing
from skyless.core.site import AccuracySite, AnchorSite, FloorPlanSite, Site, UnplacedAnchor
from skyless.core.ticks import TICK_M
from skyless.files import replace_files
from skyless.site.file.check import SITE_LIMITS, check_site, image_kind, image_size
from skyless.site.file.load import load_site, with_values
from skyless.site.survey.facts import PairRanges, Survey, SurveyedAnchor

_DELAY: Final = SITE_LIMITS["anchors.tx_antenna_delay_ticks"]
_MAX_STATED_M: Final = SITE_LIMITS["anchors.std_m"].high
_RANGE_STD: Final = SITE_LIMITS["accuracy.range_std_m"]
_STD_STEPS_PER_M: Final = 1e4
_KEYS: Final = ("x_m", "y_m", "z_m", "tx_antenna_delay_ticks", "std_m")


def surveyed_site(site: Site, survey: Survey) -> Site:
    """The site updated with the survey's determined anchors; all others are unchanged.

    Anchors that had no position come after those that had one, so the order may differ from that of a file.

    Raises SkylessError: an anchor would need an antenna delay that no radio has.
    """
    found = survey.determined
    known = [_placed(anchor, found.get(anchor.id), site) for anchor in site.all_anchors]
    accuracy = _accuracy(site, found, survey.range_std_m)
    delays = {anchor.id: anchor.tx_antenna_delay_ticks for anchor in site.all_anchors}
    if accuracy == site.accuracy and any(anchor.tx_antenna_delay_ticks != delays[anchor.id] for anchor in known):
        more_m = _up(accuracy.range_std_m, _STD_STEPS_PER_M) + 1.0 / _STD_STEPS_PER_M
        std_m = more_m if _RANGE_STD.contains(more_m) else more_m - 2.0 / _STD_STEPS_PER_M
        accuracy = replace(accuracy, range_std_m=round(std_m, 4))
    return replace(
        site,
        anchors=tuple(anchor for anchor in known if isinstance(anchor, AnchorSite)),
        unplaced=tuple(anchor for anchor in known if isinstance(anchor, UnplacedAnchor)),
        accuracy=accuracy,
    )


def surveyed_text(text: str, survey: Survey, site: Site, path: str | PathLike[str]) -> str:
    """The text of the site's file with the changes of ``surveyed_site``, keeping comments and layout.

    Raises:
        ConfigurationError: the file has a form that cannot be edited, or the result is no valid site, for instance
            because anchors that share a slot are too near.
        SkylessError: an anchor would need an antenna delay that no radio has.
    """
    new = surveyed_site(site, survey)
    check_site(new, Path(path))
    before = {anchor.id: anchor for anchor in site.all_anchors}
    of_anchors = {anchor.id: _changes(before[anchor.id], anchor) for anchor in new.anchors}
    accuracy = {
        key: getattr(new.accuracy, key)
        for key in AccuracySite.__struct_fields__
        if getattr(new.accuracy, key) != getattr(site.accuracy, key)
    }
    return with_values(text, of_anchors, {"accuracy": accuracy} if accuracy else {}, path, "the survey")


def delay_changes_ticks(site: Site, survey: Survey) -> dict[int, int]:
    """Changes of the TX antenna delays of the site's determined anchors.

    Raises SkylessError: an anchor would need an antenna delay that no radio has.
    """
    found = survey.determined
    return {
        anchor.id: _delay_ticks(anchor, found[anchor.id]) - anchor.tx_antenna_delay_ticks
        for anchor in site.all_anchors
        if anchor.id in found
    }


def delay_differences_m(recorded: Site, site: Site) -> dict[int, float]:
    """Half the increase of each anchor's antenna delays from a recording of the site to the site.

    To be subtracted with ``PairRanges.without_delays`` from ranges measured with the delays of the recording.
    """
    before = {anchor.id: anchor for anchor in recorded.all_anchors}
    half_m = {}
    for anchor in site.all_anchors:
        if (old := before.get(anchor.id)) is not None:
            more = anchor.tx_antenna_delay_ticks - old.tx_antenna_delay_ticks
            more += anchor.rx_antenna_delay_ticks - old.rx_antenna_delay_ticks
            half_m[anchor.id] = more * TICK_M / 2.0
    return half_m


def _placed(
    anchor: AnchorSite | UnplacedAnchor, found: SurveyedAnchor | None, site: Site
) -> AnchorSite | UnplacedAnchor:
    if found is None or found.x_m is None or found.y_m is None:
        return anchor
    old = anchor if isinstance(anchor, AnchorSite) else AnchorSite(x_m=0.0, y_m=0.0, **asdict(anchor))
    z_m = old.z_m if found.z_m is None else found.z_m
    stated = old.std_m if site.schedule.needs_master or found.std_m is None else _up(found.std_m, 1e3)
    return replace(
        old,
        x_m=_rounded(found.x_m),
        y_m=_rounded(found.y_m),
        z_m=_rounded(z_m),
        tx_antenna_delay_ticks=_delay_ticks(anchor, found),
        std_m=None if stated is None else min(stated, _MAX_STATED_M),
    )


def _delay_ticks(anchor: AnchorSite | UnplacedAnchor, found: SurveyedAnchor) -> int:
    """The anchor's TX antenna delay after the survey. Raises SkylessError if no radio has such a delay."""
    ticks = anchor.tx_antenna_delay_ticks + round(2.0 * (found.delay_m or 0.0) / TICK_M)
    if not _DELAY.contains(ticks):
        raise SkylessError(f"anchor {anchor.id} would need an antenna delay of {ticks}; it should be {_DELAY}")
    return ticks


def _accuracy(site: Site, found: dict[int, SurveyedAnchor], range_std_m: float) -> AccuracySite:
    old = site.accuracy
    if not found:
        return old
    survey_std_m = old.survey_std_m
    if site.schedule.needs_master and site.anchors:
        stds_m = [found[anchor.id].std_m if anchor.id in found else None for anchor in site.anchors]
        each = [old.survey_std_m if one is None else one for one in stds_m]
        survey_std_m = _up(math.sqrt(sum(one**2 for one in each) / len(each)), _STD_STEPS_PER_M)
    return replace(
        old,
        survey_std_m=survey_std_m,
        range_std_m=_up(range_std_m, _STD_STEPS_PER_M) if range_std_m > old.range_std_m else old.range_std_m,
    )


def _changes(before: AnchorSite | UnplacedAnchor, after: AnchorSite) -> dict[str, float]:
    """Values that are new or differ, by key."""
    return {
        key: getattr(after, key)
        for key in _KEYS
        if getattr(after, key) is not None and getattr(before, key, None) != getattr(after, key)
    }


def _rounded(value_m: float) -> float:
    """Round to a tenth of a millimetre, never to minus zero."""
    return round(value_m, 4) + 0.0


def _up(value_m: float, steps_per_m: float) -> float:
    """Round up to whole steps, so that no stated accuracy is too good."""
    return math.ceil(value_m * steps_per_m - 1e-6) / steps_per_m


# Record next to the site's file, ``NAME.survey.json``, for the watch


FORMAT: Final = "skyless survey 1"


class SurveyRecord(Struct, frozen=True, tag=FORMAT, tag_field="format"):
    """Record of a survey that was written into a site's file."""

    site: str
    site_id: int
    unix_s: float
    ranges: PairRanges
    """Ranges measured with the antenna delays before the survey."""
    survey: Survey
    delay_changes_ticks: dict[int, int]
    """Changes of the TX antenna delays."""


def record_path(site_file: str | PathLike[str]) -> Path:
    """Path of the survey record of a site's file."""
    return Path(site_file).with_suffix(".survey.json")


def encode_record(record: SurveyRecord) -> bytes:
    """Encode a survey record as JSON."""
    return msgspec.json.format(msgspec.json.encode(record), indent=1) + b"\n"


def read_record(path: str | PathLike[str]) -> SurveyRecord:
    """Read a survey record. Raises ConfigurationError if the file cannot be read, or is not the record of a survey."""
    try:
        return msgspec.json.decode(Path(path).read_bytes(), type=SurveyRecord)
    except OSError as error:
        raise ConfigurationError(path, "", None, f"a file that can be read ({error.strerror})") from None
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise ConfigurationError(path, "", None, f"the record of a survey: {error}") from None


def baseline(record: SurveyRecord) -> PairRanges:
    """The ranges expected with the new antenna delays, as the reference of the watch.

    A range holds half of each anchor's TX delay.
    """
    return record.ranges.without_delays(
        {anchor: ticks * TICK_M / 2.0 for anchor, ticks in record.delay_changes_ticks.items()}
    )


# Files: the site file, the record next to it, and the image of the floor.

_NEAR_M: Final = 1e-3


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
    """Return the site after a survey where there is no file to write. Raises SkylessError if it is not valid."""
    placed = surveyed_site(site, survey)
    check_site(placed, Path("the survey's result"))
    return Saved(placed, _record(site, survey, ranges, unix_s))


def record_of(file: Path | None, site: Site, log: Callable[[str], None]) -> SurveyRecord | None:
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
    file: Path,
    survey: Survey,
    ranges: PairRanges,
    unix_s: float,
    floor: FloorImage | None = None,
    out: Path | None = None,
) -> Saved:
    """Write a result into a site's file, or another one, ``out``, and its record next to it.

    Raises SkylessError: a file cannot be read or written, or the result is not a valid site.
    """
    site, out = load_site(file), out or file
    record, image = _record(site, survey, ranges, unix_s), dict[Path, bytes]()
    with writing(file):
        text = surveyed_text(file.read_bytes().decode("utf-8-sig"), survey, site, file)
        if floor is not None:
            image_name, image = _floor_image(file, site, floor)
            if image_name is not None:
                values = asdict(replace(floor.plan, image=image_name))
                text = with_values(text, {}, {"floor_plan": values}, file, "the floor plan")
    written = write_keeping(out, {out: text.encode(), record_path(out): encode_record(record), **image})
    return Saved(load_site(out), record, written)


def write_keeping(out: Path, files: dict[Path, bytes]) -> tuple[Path, ...]:
    """Write files, and what ``out`` held under another name: all of them or none. Returns all, that copy first.

    Raises SkylessError.
    """
    with writing(out):
        before = {_kept_path(out): out.read_bytes()} if out.exists() else {}
        replace_files(before | dict(reversed(files.items())))
    return (*before, *files)


def _record(site: Site, survey: Survey, ranges: PairRanges, unix_s: float) -> SurveyRecord:
    return SurveyRecord(site.name, site.id, unix_s, ranges, survey, delay_changes_ticks(site, survey))


def _kept_path(file: Path) -> Path:
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
    path = file.with_name(f"{file.stem}.floor{'.png' if image_kind(floor.image) == 'png' else '.jpg'}")
    if path.exists() and path.read_bytes() != floor.image:
        path = path.with_stem(f"{path.stem}-{crc32(floor.image):08x}")
    return path.name, {path: floor.image}
