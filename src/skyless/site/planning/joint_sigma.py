"""Predicted errors of ``joint``, from the estimator's covariance at points of a site: at rest, and after a walk."""

import math
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from skyless.core.arrays import Integers, Matrix, Vector
from skyless.core.estimator.compiled import add_anchor, find_steady_state, find_walked
from skyless.core.estimator.settings import EstimatorSettings
from skyless.core.estimator.state import State, at, new_state
from skyless.core.estimator.steady_state import PlannedMessage, PlannedRelay, SteadyState
from skyless.core.native.records import MAX_ANCHORS, records, view
from skyless.core.ticks import TICK_S
from skyless.site.planning.anchor_clocks import AnchorClocks, Relays
from skyless.site.planning.links import FIX_SHARE, SIGMA, Scene, fill_dops, fill_errors

_RARELY: Final = 0.1  # an anchor of whose frames fewer arrive does not help the tag

# The state is compared with that of so long ago, or of a superframe, if that is longer; at the latest after _MAX_S and
# _MAX_SUPERFRAMES it counts as steady.
_COMPLETE_OVER_S: Final = 0.1
_MAX_S: Final = 4.0
_MAX_SUPERFRAMES: Final = 20

_RESTED_S: Final = 2.0  # before a walk; phases count from a second after the start

_START_VARIANCE: Final = 1.0  # of position and velocity, m² and m²/s²; the steady state does not depend on it


def fill_joint_sigma(
    points: Matrix,
    settings: EstimatorSettings,
    scene: Scene,
    clocks: AnchorClocks,
    relays: Relays,
    farthest: float,
    most: int | None,
    table: Matrix,
) -> None:
    """Fill ``table`` (points, columns) for the points, shape (m, 3).

    ``most``: anchors that a tag uses at most; the share of fixes is then that of these anchors' messages. None for all.
    """
    dim = settings.dim
    shares, delays_m = scene.heard_at(points)
    fill_dops(scene, points, shares, dim, table)
    table[:, SIGMA:], table[:, FIX_SHARE] = math.inf, 0.0
    messages = np.full(len(points), len(clocks.sender))
    variance_m2, claimed_m2 = np.zeros((len(points), 3)), np.zeros((len(points), 3))
    square_bias_m2 = np.zeros(len(points))
    for k, (point, share, delay_m) in enumerate(zip(points, shares, delays_m, strict=True)):
        in_view = scene.strongest(point, np.flatnonzero(share >= _RARELY), most or MAX_ANCHORS)
        if most is not None:
            messages[k] = np.isin(clocks.sender, in_view).sum()
        if len(in_view) <= dim:
            continue
        state = _state_at(settings, scene.anchors, in_view, point)
        found = _steady_state(state, clocks, relays, share, delay_m, in_view)
        table[k, FIX_SHARE] = found.fixes / messages[k]
        claimed_m2[k] = view(found.variance_m2) / found.fixes
        variance_m2[k] = np.maximum(claimed_m2[k] - view(found.motion_m2), 0.0)
        square_bias_m2[k] = found.square_bias_m2 / found.fixes
    known = np.flatnonzero(table[:, FIX_SHARE] > 0.0)
    fill_errors(table, known, variance_m2[known], square_bias_m2[known], claimed_m2[known].sum(axis=1))
    lost = ~(table[:, SIGMA] < farthest)
    table[lost, SIGMA:], table[lost, FIX_SHARE] = math.inf, 0.0


def walked_sigma(
    point: Vector,
    velocity_mps: Vector,
    settings: EstimatorSettings,
    scene: Scene,
    clocks: AnchorClocks,
    relays: Relays,
    most: int | None,
    has_phases: bool,
) -> float:
    """Standard deviation, metres, that the filter claims of a tag that rested at a point and has walked for a second.

    With ``has_phases`` the tag measures the phase of the carrier with the noise and wander that the filter begins with.
    Infinite where there is no fix.
    """
    (share,), (delay_m,) = scene.heard_at(point[None])
    in_view = scene.strongest(point, np.flatnonzero(share >= _RARELY), most or MAX_ANCHORS)
    if len(in_view) <= settings.dim:
        return math.inf
    s = _state_at(settings, scene.anchors, in_view, point, has_phases)
    s.tuning.slow_forgetting = 0.0  # nothing is learnt from innovations of zero
    columns, found, superframe_s = _planned(clocks, relays, share, delay_m, in_view), SteadyState(), clocks.gap_s.sum()
    walked = max(1, round(1.0 / superframe_s))
    velocity = np.ascontiguousarray(velocity_mps / (walked * superframe_s))
    find_walked(s, *columns, len(clocks.sender), math.ceil(_RESTED_S / superframe_s), velocity, walked, found)
    return math.sqrt(sum(found.variance_m2) / found.fixes)


def _state_at(
    settings: EstimatorSettings, anchors_m: Matrix, in_view: Integers, point: Vector, has_phases: bool = False
) -> State:
    """The estimator's state at a point, with the anchors in these rows of the site."""
    s = new_state(settings)
    s.status.walk_scale, s.status.has_phases = 1.0, has_phases
    for axis in range(2 * s.dim):
        s.P[at(axis, axis)] = _START_VARIANCE
    for row in in_view.tolist():
        add_anchor(s, row, anchors_m[row], -1.0, False)
    view(s.x)[: s.dim] = point[: s.dim]
    if s.dim == 2:
        s.settings.height_m = point[2]
    return s


def _steady_state(
    s: State, clocks: AnchorClocks, relays: Relays, share: Vector, delay_m: Vector, in_view: Integers
) -> SteadyState:
    """The steady state of a tag that receives these shares of the anchors' messages, late by these delays."""
    superframe_s, found = float(clocks.gap_s.sum()), SteadyState()
    most = max(_MAX_SUPERFRAMES, math.ceil(_MAX_S / superframe_s))
    step = max(1, math.ceil(_COMPLETE_OVER_S / superframe_s))
    columns = _planned(clocks, relays, share, delay_m, in_view)
    find_steady_state(s, *columns, len(clocks.sender), most, step, found)
    return found


def _planned(
    clocks: AnchorClocks, relays: Relays, share: Vector, delay_m: Vector, in_view: Integers
) -> tuple[Any, Any]:
    """A superframe's messages and what they relay, as records."""
    index_of = np.full(len(share), -1)
    index_of[in_view] = np.arange(len(in_view))
    messages: NDArray[Any] = np.zeros(len(clocks.sender), np.dtype(PlannedMessage))
    messages["anchor"], messages["gap_ticks"] = index_of[clocks.sender], np.rint(clocks.gap_s / TICK_S)
    messages["share"], messages["late_m"], messages["end"] = share[clocks.sender], delay_m[clocks.sender], relays.ends
    listeners = np.repeat(clocks.sender, np.diff(relays.ends, prepend=0))
    relayed: NDArray[Any] = np.zeros(len(relays.sender), np.dtype(PlannedRelay))
    relayed["sender"], relayed["age_s"], relayed["late_m"] = index_of[relays.sender], relays.age_s, relays.delay_m
    relayed["share"] = share[listeners] * share[relays.sender] * relays.share
    return records(PlannedMessage, messages), records(PlannedRelay, relayed)
