"""Positions from pseudoranges, whose common bias is unknown."""

import numpy as np

from skyless.core.tag.position import locate


def located(anchors_m, pseudoranges_m, variances_m2, **options):
    """``locate`` by the differences to the first pseudorange, with its variance in common; this loses nothing."""
    covariance_m2 = np.diag(variances_m2[1:]) + variances_m2[0]
    return locate(anchors_m, pseudoranges_m[1:] - pseudoranges_m[0], covariance_m2, **options)
