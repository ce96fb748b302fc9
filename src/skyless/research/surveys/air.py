"""The air of one run: sites with errors that are drawn, and what their anchors receive of one another."""

from typing import Final

import numpy as np
from msgspec import Struct
from msgspec.structs import replace

from skyless.core.arrays import Array
from skyless.core.site import EXACT, AnchorSite, ScheduleSite, Site
from skyless.core.ticks import TICK_M
from skyless.research.surveys._anchor_stamps import stamps_of
from skyless.research.surveys.layouts import SLOT_S, SurveyLayout
from skyless.sim.impairments import DelayError, PairError, lab_impairments
from skyless.site.channel import ChannelModel
from skyless.site.survey.facts import PairRanges

LATE_M: Final = (0.2, 1.0)
"""By how much late pairs are."""
_SENSITIVITY_DBM: Final = -105.0
"""All anchors receive one another."""
_SETTLE_S: Final = 1.0
"""Until anchors of protocol 2 send regularly."""


class AirErrors(Struct, frozen=True):
    """How errors are drawn."""

    delay_std_m: float = 0.0
    pair_std_m: float = 0.0
    """Constant error of each pair."""
    late_share: float = 0.0
    missing_share: float = 0.0
    """Shares of all pairs that are late, and that have no ranges."""


class DrawnErrors(Struct, frozen=True, eq=False):
    """What is wrong with the air of one run."""

    delay_m: Array
    """Shape (n,)."""
    late: frozenset[tuple[int, int]]
    missing: frozenset[tuple[int, int]]
    errors: tuple[PairError, ...]


def free_axes(layout: SurveyLayout) -> Array:
    """Coordinates that are estimated: 1, the others 0."""
    return np.array([1.0, 1.0, 1.0 if layout.dimensions == 3 else 0.0])


def drawn_errors(errors_of: AirErrors, layout: SurveyLayout, draw: np.random.Generator) -> DrawnErrors:
    """Delays, and errors of pairs; each pair is late or missing for itself."""
    anchors = layout.anchors
    delay_m = draw.normal(0.0, errors_of.delay_std_m, len(anchors)) if errors_of.delay_std_m else np.zeros(len(anchors))
    late, missing, errors = [], [], []
    for index, a in enumerate(anchors):
        for b in anchors[index + 1 :]:
            error_m = draw.normal(0.0, errors_of.pair_std_m) if errors_of.pair_std_m else 0.0
            is_late, is_missing, late_m = draw.random() < errors_of.late_share, draw.random(), draw.uniform(*LATE_M)
            if is_missing < errors_of.missing_share:
                missing.append((a, b))
                errors.append(PairError(a, b, blocked=True))
                continue
            if is_late:
                late.append((a, b))
            if is_late or error_m:
                errors.append(PairError(a, b, late_m=error_m + (late_m if is_late else 0.0)))
    return DrawnErrors(delay_m, frozenset(late), frozenset(missing), tuple(errors))


def ranges_in_air(layout: SurveyLayout, drawn: DrawnErrors, seconds: float, noise_ps: float, seed: int) -> PairRanges:
    """What the anchors of a site in such air receive of one another."""
    anchors = tuple(
        AnchorSite(anchor, x_m, y_m, z_m)
        for anchor, (x_m, y_m, z_m) in zip(layout.anchors, layout.position_m.tolist(), strict=True)
    )
    schedule = ScheduleSite(slot_s=SLOT_S)
    if drawn.missing:  # a master would have to reach all
        schedule = ScheduleSite(mode="free")
    site = Site(layout.name, 1, 1, anchors, schedule, accuracy=EXACT)
    delays = tuple(
        DelayError(anchor, float(delay_m / TICK_M), float(delay_m / TICK_M))
        for anchor, delay_m in zip(layout.anchors, drawn.delay_m, strict=True)
    )
    air = replace(
        lab_impairments(noise_ps),
        delay_errors=delays,
        anchor_pair_errors=drawn.errors,
        channel=ChannelModel(sensitivity_dbm=_SENSITIVITY_DBM),
    )
    settle_s = _SETTLE_S if drawn.missing else 0.0
    return stamps_of(site, air, seconds, seed, settle_s=settle_s).ranges()
