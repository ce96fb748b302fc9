"""Ranges between anchors of a survey's layout, drawn as noise of their stamps makes them."""

import math
from itertools import combinations

import numpy as np

from skyless.core.ticks import SPEED_OF_LIGHT_MPS, TICK_M
from skyless.research.studies.surveyed_rooms import SLOT_S
from skyless.site.survey.facts import PairRange, PairRanges


def drawn_ranges(layout, duration_s, rng, *, delays_m=None, pair_std_m=0.0):
    """Ranges that stamps of ±100 ps give in a duration (covariance in ``docs/maths.md`` section 9).

    ``pair_std_m``: constant error of each pair.
    """
    anchors, delays_m = layout.anchors, delays_m or {}
    superframes = max(1.0, duration_s / (len(anchors) * SLOT_S))
    stamp_std_m = math.hypot(100e-12 * SPEED_OF_LIGHT_MPS, TICK_M / math.sqrt(12.0))
    range_std_m = stamp_std_m / math.sqrt(2.0 * superframes)
    tx_std_m = stamp_std_m / (2.0 * math.sqrt(superframes))
    late_m = [delays_m.get(anchor, 0.0) for anchor in anchors] + rng.normal(0.0, tx_std_m, len(anchors))
    pairs = []
    for i, j in combinations(range(len(anchors)), 2):
        distance_m = float(np.linalg.norm(layout.position_m[i] - layout.position_m[j]))
        noise_m = rng.normal(0.0, range_std_m) + rng.normal(0.0, pair_std_m)
        measured_m = float(distance_m + late_m[i] + late_m[j] + noise_m)
        pairs.append(PairRange(anchors[i], anchors[j], measured_m, range_std_m, int(superframes)))
    return PairRanges(tuple(pairs), anchors, dict.fromkeys(anchors, tx_std_m), duration_s)
