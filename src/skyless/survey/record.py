"""What is kept of a survey next to the site's file, ``NAME.survey.json``: its ranges and its result, for the watch."""

from os import PathLike
from pathlib import Path
from typing import Final

import msgspec
from msgspec import Struct

from skyless.constants import TICK_M
from skyless.errors import ConfigurationError
from skyless.survey.ranges import PairRanges
from skyless.survey.result import Survey

FORMAT: Final = "skyless survey 1"


class SurveyRecord(Struct, frozen=True, tag=FORMAT, tag_field="format"):
    """A survey that has been written into a site's file."""

    site: str
    site_id: int
    unix_s: float
    ranges: PairRanges
    """As measured with the antenna delays before the survey."""
    survey: Survey
    delay_changes_ticks: dict[int, int]
    """What was added to the TX antenna delays."""


def record_path(site_file: str | PathLike[str]) -> Path:
    """Where the record of a site's file lies."""
    return Path(site_file).with_suffix(".survey.json")


def encode_record(record: SurveyRecord) -> bytes:
    """Its bytes."""
    return msgspec.json.format(msgspec.json.encode(record), indent=1) + b"\n"


def read_record(path: str | PathLike[str]) -> SurveyRecord:
    """The record in a file.

    Raises:
        ConfigurationError: it cannot be read, or is not the record of a survey.
    """
    try:
        return msgspec.json.decode(Path(path).read_bytes(), type=SurveyRecord)
    except OSError as error:
        raise ConfigurationError(path, "", None, f"a file that can be read ({error.strerror})") from None
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise ConfigurationError(path, "", None, f"the record of a survey: {error}") from None


def baseline(record: SurveyRecord) -> PairRanges:
    """The ranges as they are measured with the new antenna delays: what the watch compares with.

    A range holds half of each anchor's TX delay.
    """
    return record.ranges.without_delays(
        {anchor: ticks * TICK_M / 2.0 for anchor, ticks in record.delay_changes_ticks.items()}
    )
