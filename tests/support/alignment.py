"""Errors of positions apart from the site's place and direction."""

import numpy as np


def aligned_errors_m(found_m, true_m):
    """Errors of positions, shape (n, d), after the best rigid motion or reflection."""
    found_m, true_m = np.asarray(found_m, float), np.asarray(true_m, float)
    found_m, true_m = found_m - found_m.mean(axis=0), true_m - true_m.mean(axis=0)
    u, _, vt = np.linalg.svd(found_m.T @ true_m)
    return found_m @ (u @ vt) - true_m


def aligned_rms_m(found_m, true_m):
    """Root mean square of the distances of positions from the true ones after that."""
    return float(np.sqrt((aligned_errors_m(found_m, true_m) ** 2).sum(axis=1).mean()))
