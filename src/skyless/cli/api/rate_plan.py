"""The plan of a site of protocol 2 as a result: the beacons that reach tags."""

import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from skyless.cli.api._floor_result import FloorResult
from skyless.cli.api._result import data_frame
from skyless.core.arrays import Array
from skyless.core.errors import SkylessError
from skyless.core.site import Site
from skyless.site.channel import ChannelModel
from skyless.site.planning.links import Floor, with_range
from skyless.site.planning.rates import RateMap, described_rates, rate_map, rate_report

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from pandas import DataFrame


class RatePlanResult(FloorResult[RateMap], frozen=True, eq=False):
    """Beacons that reach tags over the floor of a site without a master."""

    @property
    def beacons_per_s(self) -> Array:
        """Shape (heights, ny, nx): at one point of each cell; NaN outside the outline."""
        return self.map.beacons_per_s

    def to_dataframe(self) -> "DataFrame":
        """One row a cell and height: ``x_m``, ``y_m``, ``z_m``, ``beacons_per_s``.

        Raises:
            SkylessError: pandas is not installed.
        """
        z_m, y_m, x_m = np.meshgrid(self.heights_m, self.y_m, self.x_m, indexing="ij")
        within = np.isfinite(self.beacons_per_s)
        columns = {"x_m": x_m, "y_m": y_m, "z_m": z_m, "beacons_per_s": self.beacons_per_s}
        return data_frame({name: values[within] for name, values in columns.items()})

    def plot(self) -> "Figure":
        """The anchors over the beacons per second."""
        from skyless.site.planning.picture import draw_rates

        return draw_rates(self.site, self.floor, self.map, self.file, described_rates(self.summary))

    def title(self) -> str:
        """What was planned."""
        return f"plan of {self.site.name}, {described_rates(self.summary)}"

    def facts(self) -> Iterator[tuple[str, str]]:
        """The figures that matter, each with its name and unit."""
        found, told = self.map.reception, self.summary
        yield "anchors", f"{len(self.site.all_anchors)}"
        yield "range in the open", f"{told['range_m']:.0f} m (path loss exponent {told['exponent']:g})"
        yield "each anchor sends", f"{told['beacons_per_s_of_each_anchor']:.1f} beacons/s"
        yield "median beacons/s at a tag", f"{found.beacons_per_s.median:.0f}"
        yield "beacons/s at the worst 5 %", f"{found.beacons_per_s.worst_5_percent:.0f}"
        yield "anchors received at the worst 5 %", f"{found.anchors_received.worst_5_percent:.0f}"
        for warning in self.summary["warnings"]:
            yield "warning", warning


def plan_rates(
    site: Site,
    file: Path,
    floor: Floor,
    heights_m: tuple[float, ...],
    step_m: float | None,
    range_m: float | None,
    exponent: float,
) -> RatePlanResult:
    """Plan a site of protocol 2. Raises SkylessError."""
    started_s = time.perf_counter()
    channel = ChannelModel() if range_m is None else with_range(ChannelModel(), range_m, exponent)
    try:
        mapped = rate_map(site, floor, heights_m, step_m, channel, exponent)
    except ValueError as error:
        raise SkylessError(f"no map: {error}") from None
    found = rate_report(site, floor, mapped, channel, exponent)
    found["wall_s"] = time.perf_counter() - started_s
    return RatePlanResult(site, file, floor, mapped, found)
