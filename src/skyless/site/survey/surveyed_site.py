"""Write a survey's result into a site: positions, TX antenna delays, and their accuracy.

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
from os import PathLike
from pathlib import Path
from typing import Final

from msgspec import structs

from skyless.core.errors import SkylessError
from skyless.core.site import AccuracySite, AnchorSite, Site, UnplacedAnchor
from skyless.core.ticks import TICK_M
from skyless.site.file.check import SITE_LIMITS, check_site
from skyless.site.file.load import with_values
from skyless.site.survey.facts import Survey, SurveyedAnchor

_DELAY: Final = SITE_LIMITS["anchors.tx_antenna_delay_ticks"]
_MAX_STATED_M: Final = SITE_LIMITS["anchors.std_m"].high
_RANGE_STD: Final = SITE_LIMITS["accuracy.range_std_m"]
_STD_STEPS_PER_M: Final = 1e4
_POSITION_DIGITS: Final = 4
_KEYS: Final = ("x_m", "y_m", "z_m", "tx_antenna_delay_ticks", "std_m")


def surveyed_site(site: Site, survey: Survey) -> Site:
    """The site updated with the survey's determined anchors; all others are unchanged.

    Anchors that had no position come after those that had one, so the order may differ from that of a file.

    Raises:
        SkylessError: an anchor would need an antenna delay that no radio has.
    """
    found = {anchor.id: anchor for anchor in survey.anchors if anchor.determined}
    known = [_placed(anchor, found.get(anchor.id), site) for anchor in site.all_anchors]
    accuracy = _accuracy(site, found, survey.range_std_m)
    delays = {anchor.id: anchor.tx_antenna_delay_ticks for anchor in site.all_anchors}
    if accuracy == site.accuracy and any(anchor.tx_antenna_delay_ticks != delays[anchor.id] for anchor in known):
        accuracy = structs.replace(accuracy, range_std_m=_another_std(accuracy.range_std_m))
    return structs.replace(
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


def unchanged_anchors(site: Site, survey: Survey) -> tuple[int, ...]:
    """Anchors of the site that the survey has not determined."""
    found = {anchor.id for anchor in survey.anchors if anchor.determined}
    return tuple(anchor.id for anchor in site.all_anchors if anchor.id not in found)


def delay_changes_ticks(site: Site, survey: Survey) -> dict[int, int]:
    """Changes of the TX antenna delays of the site's determined anchors.

    Raises:
        SkylessError: an anchor would need an antenna delay that no radio has.
    """
    found = {anchor.id: anchor for anchor in survey.anchors if anchor.determined}
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
    old = anchor if isinstance(anchor, AnchorSite) else AnchorSite(x_m=0.0, y_m=0.0, **structs.asdict(anchor))
    z_m = old.z_m if found.z_m is None else found.z_m
    stated = old.std_m if site.schedule.needs_master or found.std_m is None else _up(found.std_m, 1e3)
    return structs.replace(
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
    if site.schedule.needs_master:
        stds_m = [found[anchor.id].std_m if anchor.id in found else None for anchor in site.anchors]
        each = [old.survey_std_m if one is None else one for one in stds_m]
        survey_std_m = (
            _up(math.sqrt(sum(one**2 for one in each) / len(each)), _STD_STEPS_PER_M) if each else old.survey_std_m
        )
    return structs.replace(
        old,
        survey_std_m=survey_std_m,
        range_std_m=_up(range_std_m, _STD_STEPS_PER_M) if range_std_m > old.range_std_m else old.range_std_m,
    )


def _another_std(std_m: float) -> float:
    """The next larger value that the air format can state, or the next smaller one at the upper limit."""
    more_m = _up(std_m, _STD_STEPS_PER_M) + 1.0 / _STD_STEPS_PER_M
    return round(more_m if _RANGE_STD.contains(more_m) else more_m - 2.0 / _STD_STEPS_PER_M, 4)


def _changes(before: AnchorSite | UnplacedAnchor, after: AnchorSite) -> dict[str, float]:
    """Values that are new or differ, by key."""
    return {
        key: getattr(after, key)
        for key in _KEYS
        if getattr(after, key) is not None and getattr(before, key, None) != getattr(after, key)
    }


def _rounded(value_m: float) -> float:
    """Round to a tenth of a millimetre, never to minus zero."""
    return round(value_m, _POSITION_DIGITS) + 0.0


def _up(value_m: float, steps_per_m: float) -> float:
    """Round up to whole steps, so that no stated accuracy is too good."""
    return math.ceil(value_m * steps_per_m - 1e-6) / steps_per_m
