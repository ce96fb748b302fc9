"""The covariance of positions located by TDoAs, as the matrices are written."""

import numpy as np


def position_covariance(anchors, places, covariance, *, height_known, weighted):
    """(HᵀΣ⁻¹H)⁻¹ or G·Σ·Gᵀ at every place, shape (m, 3, 3); a known height has zeros."""
    dims, found = 2 if height_known else 3, np.zeros((len(places), 3, 3))
    for place, square in zip(np.asarray(places), found, strict=True):
        towards = (place - anchors) / np.linalg.norm(place - anchors, axis=1)[:, None]
        H = (towards[1:] - towards[0])[:, :dims]
        G = np.linalg.pinv(H)
        dense = np.linalg.inv(H.T @ np.linalg.solve(covariance, H)) if weighted else G @ covariance @ G.T
        square[:dims, :dims] = dense
    return found
