"""What both kinds of plan have: a site, its floor, and a map over it."""

from pathlib import Path
from typing import Any, Generic, TypeVar

from skyless.cli.api._result import Result
from skyless.core.arrays import Vector
from skyless.core.site import Site
from skyless.site.planning.links import Floor
from skyless.site.planning.maps import PlanMap
from skyless.site.planning.rates import RateMap

FloorMap = TypeVar("FloorMap", PlanMap, RateMap)


class FloorResult(Result, Generic[FloorMap], frozen=True, eq=False):
    """A map over the floor of a site."""

    site: Site
    """As planned: with the anchors that were placed, if that was asked for."""
    file: Path
    floor: Floor
    """Outline and region."""
    map: FloorMap
    """The whole table of values."""
    summary: dict[str, Any]
    """The object that ``skyless plan --json`` writes, in SI units, but for the version."""

    @property
    def x_m(self) -> Vector:
        """Shape (nx,): centres of the map's cells."""
        return self.map.grid.x_m

    @property
    def y_m(self) -> Vector:
        """Shape (ny,)."""
        return self.map.grid.y_m

    @property
    def heights_m(self) -> Vector:
        """Shape (heights,): heights of the tags."""
        return self.map.grid.heights_m
