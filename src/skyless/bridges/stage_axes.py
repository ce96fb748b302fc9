"""Axes of stage and game programs: the site's own, or turned so that y is up."""

from typing import Final, Literal

from skyless.mqtt.messages import Vector

Up = Literal["y", "z"]
UPS: Final = ("y", "z")


def turned(vector: Vector, up: Up) -> Vector:
    """A vector of the site, whose z is up, in axes whose ``up`` is; both are right-handed and share x."""
    x, y, z = vector
    return (x, z, -y) if up == "y" else vector
