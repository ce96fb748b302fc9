"""What is predicted for a point: the columns of the planner's tables."""

from typing import Final

import numpy as np

from skyless.kernels.arrays import Array, Integers

PLAN_COLUMNS: Final = (
    "anchors",  # number in view
    "gdop",
    "pdop",
    "hdop",
    "vdop",
    "tdop",
    "sigma_m",  # standard deviation of the position, all axes together
    "sigma_x_m",
    "sigma_y_m",
    "sigma_z_m",
    "bias_m",  # length of the mean error that walls leave
    "rmse_m",  # both together
    "fix_share",  # of the rounds that give a fix
    "claimed_m",  # the standard deviation that the fixes themselves will report
)
"""Names of a prediction's columns, metres; infinite where there is no fix."""

ANCHORS_IN_VIEW, GDOP, PDOP, HDOP, VDOP, TDOP, SIGMA, SIGMA_X, SIGMA_Y, SIGMA_Z, BIAS, RMSE, FIX_SHARE, CLAIMED = range(
    14
)


def fill_errors(
    table: Array,
    rows: Integers,
    variance_m2: Array,
    square_bias_m2: Array,
    claimed_m2: Array,
) -> None:
    """Fill the columns of errors in some rows of a table: variances of three axes, shape (k, 3), the others (k,)."""
    table[rows, SIGMA_X : SIGMA_Z + 1] = np.sqrt(variance_m2)
    table[rows, SIGMA] = np.sqrt(variance_m2.sum(axis=1))
    table[rows, BIAS] = np.sqrt(square_bias_m2)
    table[rows, RMSE] = np.hypot(table[rows, SIGMA], table[rows, BIAS])
    table[rows, CLAIMED] = np.sqrt(claimed_m2)
