"""From a site's coordinates to longitude, latitude and height."""

import math
from typing import Final

import numpy as np

from skyless.kernels.arrays import Matrix
from skyless.site.model import GeoreferenceSite

EARTH_A_M: Final = 6_378_137.0
EARTH_E2: Final = 6.694379990141e-3
"""WGS 84: semi-major axis, first eccentricity squared."""


def to_wgs84(points_m: Matrix, origin: GeoreferenceSite) -> Matrix:
    """Longitude, latitude (degrees) and height (m) of points of a site, shape (m, 3).

    On the tangent plane at the origin, with the ellipsoid's radii of curvature there: right to millimetres over a
    few hundred metres.
    """
    heading, latitude = math.radians(origin.heading_deg), math.radians(origin.latitude_deg)
    x, y = points_m[:, 0], points_m[:, 1]
    east = x * math.cos(heading) + y * math.sin(heading)
    north = y * math.cos(heading) - x * math.sin(heading)
    squared = 1.0 - EARTH_E2 * math.sin(latitude) ** 2
    prime = EARTH_A_M / math.sqrt(squared) + origin.height_m
    meridian = EARTH_A_M * (1.0 - EARTH_E2) / squared**1.5 + origin.height_m
    longitude = origin.longitude_deg + np.degrees(east / (prime * math.cos(latitude)))
    return np.column_stack(
        [longitude, origin.latitude_deg + np.degrees(north / meridian), origin.height_m + points_m[:, 2]]
    )
