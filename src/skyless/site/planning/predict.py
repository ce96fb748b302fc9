"""Predicted position errors of a site at any points, in compiled code on all cores."""

import math
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor, as_completed
from functools import partial
from typing import Any, Final

import numpy as np
from msgspec import Struct
from msgspec.structs import replace
from numpy.typing import NDArray

from skyless.core.air.site_pages import encode_page
from skyless.core.anchor import filter_pages_of
from skyless.core.any_receiver import superframe_s
from skyless.core.arrays import Integers, Matrix, Vector
from skyless.core.estimator import steady_state
from skyless.core.estimator.compiled import add_anchor
from skyless.core.estimator.settings import EstimatorSettings
from skyless.core.estimator.state import State, at, new_state
from skyless.core.estimator.steady_state import PlannedMessage, PlannedRelay, SteadyState
from skyless.core.geometry import anchor_positions
from skyless.core.native.library import compiled
from skyless.core.native.records import MAX_ANCHORS_IN_USE
from skyless.core.native.views import records, view
from skyless.core.site import Site
from skyless.core.tag.joint import fill_ages, read_accuracy
from skyless.core.ticks import TICK_S
from skyless.site.channel import ChannelModel, barriers_of
from skyless.site.planning.links import (
    BIAS,
    CLAIMED,
    FIX_SHARE,
    PLAN_COLUMNS,
    RMSE,
    SIGMA,
    SIGMA_X,
    SIGMA_Z,
    Scene,
    fill_dops,
    link_budget,
    master_links,
    weighted_pdop,
)
from skyless.site.planning.superframe import Relays, Superframe, relays_of, row_of_master, superframe_of

# Predicted errors of ``joint``, from the estimator's covariance at points of a site: at rest, and after a walk.

_RARELY: Final = 0.1  # an anchor does not help a tag that receives a smaller share of its frames

# The state counts as steady when it equals that of _COMPLETE_OVER_S, or one superframe if longer, before; at the latest
# after _MAX_S and _MAX_SUPERFRAMES.
_COMPLETE_OVER_S: Final = 0.1
_MAX_S: Final = 4.0
_MAX_SUPERFRAMES: Final = 20

_RESTED_S: Final = 2.0  # before a walk; phases count from a second after the start

_START_VARIANCE: Final = 1.0  # of position and velocity, m² and m²/s²; the steady state does not depend on it

_find_steady_state = compiled(steady_state.find_steady_state)
_find_walked = compiled(steady_state.find_walked)


def fill_joint_sigma(
    points: Matrix,
    settings: EstimatorSettings,
    scene: Scene,
    superframe: Superframe,
    relays: Relays,
    farthest_m: float,
    table: Matrix,
) -> None:
    """Fill ``table`` (points, columns) with errors of ``joint`` at points, shape (m, 3).

    There is no fix where the standard deviation would exceed ``farthest_m``.
    """
    shares, delays_m = scene.heard_at(points)
    fill_dops(scene, points, shares, settings.dim, table)
    table[:, SIGMA:], table[:, FIX_SHARE] = math.inf, 0.0
    for row, point, share, delay_m in zip(table, points, shares, delays_m, strict=True):
        rows = anchors_in_use(scene, point, share)
        if len(rows) <= settings.dim:
            continue
        state = _state_at(settings, scene.anchors, rows, point)
        found = _steady_state(state, superframe, relays, share, delay_m, rows)
        claimed_m2 = view(found.variance_m2) / found.fixes
        variance_m2 = np.maximum(claimed_m2 - view(found.motion_m2), 0.0)
        sigma_m = math.sqrt(variance_m2.sum())
        if not sigma_m < farthest_m:
            continue
        row[SIGMA], row[SIGMA_X : SIGMA_Z + 1] = sigma_m, np.sqrt(variance_m2)
        row[BIAS] = math.sqrt(found.square_bias_m2 / found.fixes)
        row[RMSE] = math.hypot(sigma_m, row[BIAS])
        row[FIX_SHARE] = found.fixes / np.isin(superframe.sender, rows).sum()
        row[CLAIMED] = math.sqrt(claimed_m2.sum())


def anchors_in_use(scene: Scene, point: Vector, share: Vector) -> Integers:
    """Rows of the anchors that a tag at a point uses, where these shares of their frames arrive."""
    return scene.strongest(point, np.flatnonzero(share >= _RARELY), MAX_ANCHORS_IN_USE)


def _state_at(
    settings: EstimatorSettings, anchors_m: Matrix, rows: Integers, point: Vector, has_phases: bool = False
) -> State:
    """The estimator's state at a point, with the site's anchors in these rows."""
    s = new_state(settings)
    s.status.walk_scale, s.status.has_phases = 1.0, has_phases
    for axis in range(2 * s.dim):
        s.P[at(axis, axis)] = _START_VARIANCE
    for row in rows.tolist():
        add_anchor(s, row, anchors_m[row], -1.0, False)
    view(s.x)[: s.dim] = point[: s.dim]
    if s.dim == 2:
        s.settings.height_m = point[2]
    return s


def _steady_state(
    s: State, superframe: Superframe, relays: Relays, share: Vector, delay_m: Vector, rows: Integers
) -> SteadyState:
    """The steady state of a tag that receives these shares of the anchors' messages, late by these delays."""
    superframe_s, found = float(superframe.gap_s.sum()), SteadyState()
    most = max(_MAX_SUPERFRAMES, math.ceil(_MAX_S / superframe_s))
    step = max(1, math.ceil(_COMPLETE_OVER_S / superframe_s))
    columns = _planned(superframe, relays, share, delay_m, rows)
    _find_steady_state(s, *columns, len(superframe.sender), most, step, found)
    return found


def _planned(superframe: Superframe, relays: Relays, share: Vector, delay_m: Vector, rows: Integers) -> tuple[Any, Any]:
    """A superframe's messages and their relays, as records."""
    index_of = np.full(len(share), -1)
    index_of[rows] = np.arange(len(rows))
    messages: NDArray[Any] = np.zeros(len(superframe.sender), np.dtype(PlannedMessage))
    sender = superframe.sender
    messages["anchor"], messages["gap_ticks"] = index_of[sender], np.rint(superframe.gap_s / TICK_S)
    messages["share"], messages["late_m"], messages["end"] = share[sender], delay_m[sender], relays.ends
    listeners = np.repeat(sender, np.diff(relays.ends, prepend=0))
    relayed: NDArray[Any] = np.zeros(len(relays.sender), np.dtype(PlannedRelay))
    relayed["sender"], relayed["age_s"], relayed["late_m"] = index_of[relays.sender], relays.age_s, relays.delay_m
    relayed["share"] = share[listeners] * share[relays.sender] * relays.share
    return records(PlannedMessage, messages), records(PlannedRelay, relayed)


MAX_PREDICTED: Final = 60
"""Larger sites of protocol 2 are planned by the beacons that reach tags (``rates``)."""

# Points that a thread computes at a time: fewer for the filter, which is slower.
_GEOMETRY_CHUNK: Final = 2000
_FILTER_CHUNK: Final = 100

_QA_M2PS3: Final = 0.3  # what a receiver assumes of a tag at rest


class PlanSettings(Struct, frozen=True):
    """Assumptions beyond the site file."""

    noise_ps: float | None = None
    """Noise of every TX and RX stamp; None for the site's own figures."""
    channel: ChannelModel = ChannelModel()


class Predictor:
    """Predictions of ``joint`` for one site."""

    def __init__(self, site: Site, settings: PlanSettings) -> None:
        self.site = with_noise(site, settings.noise_ps)
        self.settings = settings
        self.dim = 3 if site.tags.height_m is None else 2
        self.anchors_m = anchor_positions(site)
        self.master = row_of_master(site) if site.schedule.needs_master else None
        """Row of the master; None where there is none."""
        self.budget, self.barriers = link_budget(settings.channel), barriers_of(site.walls, site.storeys)
        self.hears_master: Vector = (
            np.ones(len(site.anchors))
            if self.master is None
            else master_links(self.anchors_m, self.master, self.budget, self.barriers)
        )
        """Share of the master's frames that each anchor receives; 1 where there is no master."""
        self.superframe = superframe_of(self.site, self.hears_master)
        self.relays = relays_of(self.anchors_m, self.master, self.superframe, self.budget, self.barriers)
        self.scene = Scene(self.anchors_m, self.superframe.sent, self.budget, self.barriers)
        self.farthest_m = float(np.linalg.norm(np.ptp(self.anchors_m, axis=0)))
        self._estimator = EstimatorSettings(qa=_QA_M2PS3, height_m=site.tags.height_m)
        read_accuracy(self._estimator, *map(encode_page, filter_pages_of(self.site)))
        fill_ages(self._estimator, superframe_s(site))

    def walked_sigma(self, points_m: Matrix, *, has_phases: bool) -> Vector:
        """Standard deviations that ``joint`` claims after walks of 1 m from points, along x and along y, shape (2·m,).

        Walks go towards the middle of the points, shape (m, 3), at 1 m/s. With ``has_phases`` the tag measures carrier
        phases, with the noise and wander that the filter starts with. Infinite where there is no fix.
        """
        sides = np.where(points_m > points_m.mean(axis=0), -1.0, 1.0)
        walks = ((point, side * axis) for point, side in zip(points_m, sides, strict=True) for axis in np.eye(3)[:2])
        return np.array([self._walked_sigma(point, way, has_phases) for point, way in walks])

    def _walked_sigma(self, point: Vector, velocity_mps: Vector, has_phases: bool) -> float:
        """Standard deviation after a rest at a point and a walk of a second."""
        (share,), (delay_m,) = self.scene.heard_at(point[None])
        rows = anchors_in_use(self.scene, point, share)
        if len(rows) <= self.dim:
            return math.inf
        s = _state_at(self._estimator, self.anchors_m, rows, point, has_phases)
        s.tuning.slow_forgetting = 0.0  # nothing is learnt from innovations of zero
        columns, found = _planned(self.superframe, self.relays, share, delay_m, rows), SteadyState()
        length_s = self.superframe.gap_s.sum()
        walked, at_rest = max(1, round(1.0 / length_s)), math.ceil(_RESTED_S / length_s)
        velocity = np.ascontiguousarray(velocity_mps / (walked * length_s))
        _find_walked(s, *columns, len(self.superframe.sender), at_rest, velocity, walked, found)
        return math.sqrt(sum(found.variance_m2) / found.fixes)

    def messages_at(self, points_m: Matrix) -> Integers:
        """Messages in a superframe of the anchors that a tag uses at points, shape (m, 3); shape (m,)."""
        shares, _ = self.scene.heard_at(points_m)
        rows = (anchors_in_use(self.scene, point, share) for point, share in zip(points_m, shares, strict=True))
        return np.array([np.isin(self.superframe.sender, one).sum() for one in rows])

    def at(self, points_m: Matrix, progress: Callable[[float], None] | None = None) -> Matrix:
        """Table of predictions (m, len(PLAN_COLUMNS)) at points, shape (m, 3); ``progress`` gets the points done."""
        return in_threads(self._errors, np.ascontiguousarray(points_m, np.float64), _FILTER_CHUNK, progress)

    def _errors(self, points: Matrix, table: Matrix) -> None:
        fill_joint_sigma(points, self._estimator, self.scene, self.superframe, self.relays, self.farthest_m, table)

    def geometry_at(self, points_m: Matrix) -> Matrix:
        """Table with only anchors in view and DOPs; its column ``sigma_m`` is the weighted PDOP."""
        return in_threads(self._geometry, np.ascontiguousarray(points_m, np.float64), _GEOMETRY_CHUNK)

    def _geometry(self, points: Matrix, table: Matrix) -> None:
        share, _ = self.scene.heard_at(points)
        fill_dops(self.scene, points, share, self.dim, table)
        table[:, SIGMA] = weighted_pdop(self.scene, points, share, self.dim)


def with_noise(site: Site, noise_ps: float | None) -> Site:
    """The site with this noise of every stamp, or unchanged for None."""
    if noise_ps is None:
        return site
    return replace(site, noise=replace(site.noise, tx_stamp_ps=noise_ps, rx_stamp_ps=noise_ps))


def in_threads(
    fill: Callable[[Matrix, Matrix], None],
    points_m: Matrix,
    chunk: int,
    progress: Callable[[float], None] | None = None,
) -> Matrix:
    """Fill a table of predictions for points, in chunks on all cores."""
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
