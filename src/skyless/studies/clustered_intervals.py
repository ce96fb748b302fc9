"""How sure a share is of which few were seen, in clusters."""

from typing import Final

import numpy as np
from scipy.stats import chi2

from skyless.kernels.arrays import Array

ALPHA: Final = 0.01
CLUSTER: Final = 25.0
"""Neighbouring fixes share their errors: so many may be misleading together, though such a cluster was not seen."""


def rare_interval(events: Array, count: float) -> tuple[float, float]:
    """Where the true share lies, with 99 %, if ``count`` cases have so many events in each independent run.

    Runs with events are taken as a Poisson process of clusters: Fay and Feuer (Statistics in Medicine 16, 1997,
    791-801), whose interval ends where Garwood's exact one does, below, if all clusters have one event.
    """
    y, v = float(events.sum()), float(np.square(events).sum())
    w = max(float(events.max(initial=0.0)), CLUSTER)
    low = v / (2.0 * y) * float(chi2.ppf(ALPHA / 2.0, 2.0 * y * y / v)) if y > 0.0 else 0.0
    high = (v + w * w) / (2.0 * (y + w)) * float(chi2.ppf(1.0 - ALPHA / 2.0, 2.0 * (y + w) ** 2 / (v + w * w)))
    return low / count, high / count
