"""What is predicted for a point: the columns of the planner's tables."""

from typing import Final

COLUMNS: Final = (
    "anchors",  # how many are in view
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
    "claimed_m",  # what the fixes themselves will say of their standard deviation
)
"""Names of a prediction's columns, metres; infinite where there is no fix."""

ANCHORS, GDOP, PDOP, HDOP, VDOP, TDOP, SIGMA, SIGMA_X, SIGMA_Y, SIGMA_Z, BIAS, RMSE, FIX_SHARE, CLAIMED = range(14)
