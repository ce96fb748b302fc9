"""From a site's coordinates to longitude, latitude and height, for many points."""

import numpy as np

from skyless.kernels.arrays import Matrix
from skyless.site.earth import geodetic
from skyless.site.model import GeoreferenceSite


def to_wgs84(points_m: Matrix, origin: GeoreferenceSite) -> Matrix:
    """Longitude, latitude (degrees) and height (m) of points of a site, shape (m, 3), as ``earth.geodetic``."""
    found = np.array([geodetic((x, y, z), origin) for x, y, z in points_m.tolist()]).reshape(-1, 3)
    return found[:, [1, 0, 2]]
