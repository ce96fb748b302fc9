"""Predictions for a site at any points: its numbers gathered once, then compiled work on all cores."""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, as_completed
from functools import partial
from typing import Final

import numpy as np
from msgspec import Struct
from msgspec.structs import replace

from skyless.core.anchor import filter_pages_of
from skyless.core.any_receiver import superframe_s
from skyless.core.arrays import Matrix, Vector
from skyless.core.estimator.settings import EstimatorSettings
from skyless.core.geometry import anchor_positions
from skyless.core.method_names import DEFAULT_METHOD, FILTERS
from skyless.core.native.records import MAX_ANCHORS_IN_USE
from skyless.core.protocol1.snapshots import SnapshotMethod
from skyless.core.site import Site
from skyless.core.tag.receiver import estimator_settings
from skyless.site.channel import ChannelModel, pack_walls
from skyless.site.planning._snapshot_sigma import fill_snapshot_sigma, rounds_of
from skyless.site.planning.anchor_clocks import AnchorClocks, Relays, anchor_clocks, relays_of, row_of_master
from skyless.site.planning.joint_sigma import fill_joint_sigma, walked_sigma
from skyless.site.planning.links import (
    PLAN_COLUMNS,
    SIGMA,
    AnchorLinks,
    Scene,
    anchor_links,
    fill_dops,
    link_budget,
    weighted_pdop,
)

Fill = Callable[[Matrix, Matrix], None]

MAX_PREDICTED: Final = 60
"""Larger sites of protocol 2 are planned by the beacons that reach tags (``rates``)."""

# Points that a thread computes at a time. The filter takes longer for each.
_SNAPSHOT_CHUNK: Final = 2000
_FILTER_CHUNK: Final = 100


class PlanSettings(Struct, frozen=True):
    """What is assumed beyond the site file."""

    method: str = DEFAULT_METHOD
    noise_ps: float | None = None
    """Noise of every TX and RX stamp; None for the site's own figures."""
    qa: float = 0.3
    """Process noise that the filter assumes: spectral density of the acceleration, m²/s³."""
    channel: ChannelModel = ChannelModel()


class Predictor:
    """The predictions of one site by one method."""

    def __init__(self, site: Site, settings: PlanSettings) -> None:
        self.site = with_noise(site, settings.noise_ps)
        self.settings = settings
        self.dim = 3 if site.tags.height_m is None else 2
        self.anchors_m = anchor_positions(site)
        self.master = row_of_master(site) if site.schedule.needs_master else None
        """Row of the master; None where there is none."""
        self.budget, self.walls = link_budget(settings.channel), pack_walls(site.walls, site.storeys)
        self.links: AnchorLinks = (
            AnchorLinks(np.ones(len(site.anchors)), np.zeros(len(site.anchors)))
            if self.master is None
            else anchor_links(self.anchors_m, self.master, self.budget, self.walls)
        )
        self.clocks = anchor_clocks(self.site, self.links.share)
        self.scene = Scene(self.anchors_m, np.where(self.clocks.sends, self.clocks.kept, 0.0), self.budget, self.walls)
        self.farthest_m = float(np.linalg.norm(np.ptp(self.anchors_m, axis=0)))
        if settings.method in FILTERS:
            self._fill = self._joint()
            self._chunk = _FILTER_CHUNK
        else:
            self._fill = self._snapshots(SnapshotMethod(settings.method))
            self._chunk = _SNAPSHOT_CHUNK

    def _snapshots(self, method: SnapshotMethod) -> Fill:
        if self.master is None:
            raise ValueError(f"{method} needs a master, and site {self.site.name!r} has none")
        master, rounds = self.master, rounds_of(self.site, method)
        weighted = method in {SnapshotMethod.WEIGHTED, SnapshotMethod.BRACKETED}
        return lambda points, table: fill_snapshot_sigma(
            points, self.dim, self.scene, master, self.links, rounds, weighted, self.farthest_m, table
        )

    def walked_sigma(self, points_m: Matrix, *, has_phases: bool) -> Vector:
        """Standard deviations that ``joint`` claims of tags after walks of 1 m, along x and along y, from points.

        Walks go towards the middle of the points, shape (m, 3), at 1 m/s; shape (2·m,). Infinite where there is no fix.
        """
        joint, sides = self._joint_site(), np.where(points_m > points_m.mean(axis=0), -1.0, 1.0)
        walks = ((point, side * axis) for point, side in zip(points_m, sides, strict=True) for axis in np.eye(3)[:2])
        return np.array([walked_sigma(point, way, *joint, has_phases) for point, way in walks])

    def _joint(self) -> Fill:
        settings, scene, clocks, relays, most = self._joint_site()
        return lambda points, table: fill_joint_sigma(
            points, settings, scene, clocks, relays, self.farthest_m, most, table
        )

    def _joint_site(self) -> tuple[EstimatorSettings, Scene, AnchorClocks, Relays, int | None]:
        """What the estimator assumes, the anchors as tags and anchors hear them, and how many a tag uses at most."""
        settings = estimator_settings(
            self.settings.qa, self.site.tags.height_m, *filter_pages_of(self.site), superframe_s(self.site)
        )
        relays = relays_of(self.anchors_m, self.master, self.clocks, self.budget, self.walls)
        return settings, self.scene, self.clocks, relays, MAX_ANCHORS_IN_USE if self.master is None else None

    def at(self, points_m: Matrix, progress: Callable[[float], None] | None = None) -> Matrix:
        """Predictions at points, shape (m, 3): a table (m, len(PLAN_COLUMNS)); ``progress`` gets the points done."""
        return in_threads(self._fill, np.ascontiguousarray(points_m, np.float64), self._chunk, progress)

    def geometry_at(self, points_m: Matrix) -> Matrix:
        """A table with anchors in view and DOPs only. Its column ``sigma_m`` is the weighted PDOP."""
        return in_threads(self._geometry, np.ascontiguousarray(points_m, np.float64), _SNAPSHOT_CHUNK)

    def _geometry(self, points: Matrix, table: Matrix) -> None:
        share, _ = self.scene.heard_at(points)
        fill_dops(self.scene, points, share, self.dim, table)
        table[:, SIGMA] = weighted_pdop(self.scene, points, share, self.dim)


def with_noise(site: Site, noise_ps: float | None) -> Site:
    """The site with another noise of every stamp, unless it is None."""
    if noise_ps is None:
        return site
    return replace(site, noise=replace(site.noise, tx_stamp_ps=noise_ps, rx_stamp_ps=noise_ps))


def in_threads(fill: Fill, points_m: Matrix, chunk: int, progress: Callable[[float], None] | None = None) -> Matrix:
    """Fill a table of predictions for points, in pieces on all cores."""
    table: Matrix = np.zeros((len(points_m), len(PLAN_COLUMNS)))
    starts = range(0, len(points_m), chunk)
    if len(starts) == 1:
        fill(points_m, table)
        return table
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        tasks = [pool.submit(partial(fill, points_m[s : s + chunk], table[s : s + chunk])) for s in starts]
        for done, task in enumerate(as_completed(tasks), start=1):
            task.result()
            if progress is not None:
                progress(min(done * chunk, len(points_m)))
    return table
