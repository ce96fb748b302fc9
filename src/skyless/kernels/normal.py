"""Inverses of normal matrices, many at once, and which of them are singular."""

from typing import Final

import numpy as np

from skyless.kernels.arrays import Array

MOST_INFLATION: Final = 1e12
"""An unknown whose variance the others inflate by more is not determined: what tells it from them is rounding noise."""

_RIDGE: Final = 1e-14
"""Part of the diagonal that is added to it, so that LAPACK meets no matrix that is exactly singular."""


def inverse_of(normal: Array) -> Array:
    """Inverses of symmetric matrices (..., k, k); all elements are infinite where one is singular or not finite.

    Rows and columns are divided by the roots of the diagonal first, so that units do not count.
    """
    diagonal = np.diagonal(normal, axis1=-2, axis2=-1)
    size = np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0))
    scale = size[..., :, None] * size[..., None, :]
    one = normal / scale
    finite = np.isfinite(one).all(axis=(-2, -1), keepdims=True)
    identity = np.eye(normal.shape[-1])
    inverse = np.linalg.inv(np.where(finite, one + _RIDGE * identity, identity))
    inflation = np.diagonal(inverse, axis1=-2, axis2=-1)
    determined = np.all((inflation > 0.0) & (inflation < MOST_INFLATION), axis=-1, keepdims=True)
    sound = finite & np.expand_dims(determined, -1)
    return np.where(sound, inverse / scale, np.inf)
