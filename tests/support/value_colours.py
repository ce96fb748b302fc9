"""The colour of a predicted value, computed as ``site/planning/picture.py`` describes it."""

import math

from skyless.site.planning.colours import COLOUR_STOPS


def fraction_of(value, low, high):
    """Position of a value on a scale, from 0 at ``low`` to 1 at ``high``."""
    return min(math.log(value / low) / math.log(high / low), 1.0) if value > low else 0.0


def colour_of(value, low, high):
    """Red, green and blue, 0 to 255, of a value on a scale."""
    return colour_at(fraction_of(value, low, high))


def colour_at(fraction):
    """Red, green and blue, 0 to 255, at a position on a scale from 0 (best) to 1 (worst)."""
    at = fraction * (len(COLOUR_STOPS) - 1)
    index = min(int(at), len(COLOUR_STOPS) - 2)
    first, second = (
        [int(stop[first : first + 2], 16) for first in (1, 3, 5)] for stop in COLOUR_STOPS[index : index + 2]
    )
    return tuple(a + (at - index) * (b - a) for a, b in zip(first, second, strict=True))
