"""The report of a calibration as one tree of plain values, its notes, and the corrected file."""

from pathlib import Path
from typing import Any, Final

import msgspec

from skyless.recordings.anchor_table import calibrated_table, new_table
from skyless.site.rewrite import with_tx_delays
from skyless.survey.tags.estimate import CalibrationEstimate
from skyless.survey_inputs.run import Calibrated

_MANY_OUTLIERS: Final = 0.05
_UNEXPLAINED_SHARE: Final = 0.5


def calibration_report(done: Calibrated) -> dict[str, Any]:
    """The whole report, SI units."""
    surveyed = () if done.survey is None else done.survey.anchors
    return {
        "format": done.format,
        **msgspec.to_builtins(done.estimate),
        "delays": [{"anchor": one.id, "delay_m": one.delay_m, "std_m": one.delay_std_m} for one in surveyed],
        "tx_antenna_delay_ticks": {str(anchor): new for anchor, (_, new) in done.tx_delays_ticks().items()},
        "drops": done.samples.drops,
        "notes": calibration_notes(done),
    }


def corrected_text(done: Calibrated, anchors: Path | None, site: Path | None) -> str:
    """The site file, or the table of anchors, with the calibration in it; a new table where none is given.

    Raises SkylessError.
    """
    if site is not None and done.site is not None:
        delays_ticks = {anchor: new for anchor, (_, new) in done.tx_delays_ticks().items()}
        return with_tx_delays(site.read_bytes().decode("utf-8-sig"), delays_ticks, site)
    known = done.estimate.calibration()
    return new_table(done.samples.anchors_m, known) if anchors is None else calibrated_table(anchors, known)


def calibration_notes(done: Calibrated) -> list[str]:
    """What the user should know."""
    return _notes(done.estimate) + _survey_notes(done)


def _survey_notes(done: Calibrated) -> list[str]:
    """What the survey says about the delays."""
    found = done.survey
    if found is None:
        return []
    return [*([] if found.unchecked is None else [found.unchecked]), *found.not_determined, *found.notes]


def _notes(found: CalibrationEstimate) -> list[str]:
    """What the user should know."""
    notes = [f"anchor {one.anchor} is not determined: {one.reason}" for one in found.anchors if one.reason]
    if found.rejected > _MANY_OUTLIERS * (found.used + found.rejected):
        part = found.rejected / (found.used + found.rejected)
        notes.append(f"{part:.0%} of the differences are outliers: calibrate where every anchor is in sight")
    if (found.loop_m or 0.0) > _UNEXPLAINED_SHARE * (found.noise_m or 0.0):
        notes.append(
            f"pairs of anchors remain {found.loop_m:.3f} m off, which no constants explain: something may stand "
            "between anchors or in the tag's way"
        )
    return notes
