"""Predicted position errors of a site at any points, in compiled code on all cores."""

import math
import os
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor, as_completed
from functools import partial
from itertools import product
from typing import Any, Final

import numpy as np
from msgspec import Struct
from msgspec.structs import replace
from numpy.typing import NDArray

from skyless.core.anchor import filter_pages_of
from skyless.core.any_receiver import superframe_s
from skyless.core.arrays import Array, Integers, Mask, Matrix, Vector
from skyless.core.clock_filter import ClockNoise, clock_noise
from skyless.core.estimator import steady_state
from skyless.core.estimator.compiled import add_anchor
from skyless.core.estimator.settings import EstimatorSettings
from skyless.core.estimator.state import State, at, new_state
from skyless.core.estimator.steady_state import PlannedMessage, PlannedRelay, SteadyState
from skyless.core.geometry import anchor_positions, inverses
from skyless.core.method_names import DEFAULT_METHOD, FILTERS
from skyless.core.native.library import compiled
from skyless.core.native.records import MAX_ANCHORS, MAX_ANCHORS_IN_USE
from skyless.core.native.views import records, view
from skyless.core.protocol1.beacon import first_slots, schedule_of
from skyless.core.protocol1.snapshots import SnapshotMethod, bracketed_covariance, literal_covariance
from skyless.core.site import Site
from skyless.core.tag.receiver import estimator_settings
from skyless.core.ticks import TICK_S
from skyless.site.channel import ChannelModel, barriers_of
from skyless.site.planning.anchor_clocks import (
    AnchorClocks,
    Relays,
    anchor_clocks,
    relays_of,
    row_of_master,
    stamp_variances,
)
from skyless.site.planning.links import (
    FIX_SHARE,
    PLAN_COLUMNS,
    SIGMA,
    AnchorLinks,
    Scene,
    anchor_links,
    fill_dops,
    fill_errors,
    link_budget,
    weighted_pdop,
)

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
    clocks: AnchorClocks,
    relays: Relays,
    farthest: float,
    most: int | None,
    table: Matrix,
) -> None:
    """Fill ``table`` (points, columns) with errors of ``joint`` at points, shape (m, 3).

    ``most``: most anchors that a tag uses; the share of fixes then refers to these anchors' messages. None for all.
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
    """Standard deviation, metres, that the filter claims for a tag that rested at a point and then walked for a second.

    With ``has_phases`` the tag measures carrier phases, with the noise and wander that the filter starts with.
    Infinite if there is no fix.
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
    _find_walked(s, *columns, len(clocks.sender), math.ceil(_RESTED_S / superframe_s), velocity, walked, found)
    return math.sqrt(sum(found.variance_m2) / found.fixes)


def _state_at(
    settings: EstimatorSettings, anchors_m: Matrix, in_view: Integers, point: Vector, has_phases: bool = False
) -> State:
    """The estimator's state at a point, with the site's anchors in these rows."""
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
    _find_steady_state(s, *columns, len(clocks.sender), most, step, found)
    return found


def _planned(
    clocks: AnchorClocks, relays: Relays, share: Vector, delay_m: Vector, in_view: Integers
) -> tuple[Any, Any]:
    """A superframe's messages and their relays, as records."""
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


# Predicted errors of the snapshot methods at points: the TDoAs' covariance through the geometry, G·Σ·Gᵀ.
#
# If frames are lost, fixes come from changing sets of anchors: all sets of the most uncertain anchors are enumerated,
# each with its probability; any other anchor counts as present if it mostly takes part.
#
# The crystals' noise between the stamps, which matters in long superframes, is added to the stamps' noise of
# ``uncertainty/tdoa.py``: a TDoA with its pair at κ and κ + 1 rounds contains (1 + κ)·x(κ) − κ·x(κ + 1) − x(0) of a
# clock's phase x, and the anchor's own clock enters with the same weights. For the delayed messages and the bracketed
# form, which refer to the second message, it is (1 − κ)·x(κ + 1) + κ·x(κ) − x(1).

_MAX_UNCERTAIN: Final = 4  # anchors whose presence and absence are both considered
_UNCERTAIN: Final = 0.01  # an anchor whose part is within this of 0 or 1 counts as certain
_MIN_EIGENVALUE: Final = 1e-3  # common errors below this share of the largest eigenvalue are left out


class Rounds(Struct, frozen=True):
    """Errors of the TDoAs of a site's anchors, in the order of its file (the master's row is not used)."""

    usable: Mask
    """Whether the anchor sends after the master within a round, as the snapshot methods need; shape (n,)."""
    assumed_own: Vector
    """Variance of each TDoA as the method assumes, without the common part; m², shape (n,)."""
    assumed_common: float
    true_own: Vector
    """``assumed_own`` plus the variance from the crystals' noise."""
    common: Matrix
    """Factor of the errors that several TDoAs share, with covariance common·commonᵀ; shape (n, k), metres."""


def rounds_of(site: Site, method: SnapshotMethod) -> Rounds:
    """Errors of a snapshot method's TDoAs, from the site's noise figures."""
    noise = site.noise
    tx_var, rx_var = stamp_variances(site)
    kappa, round_s = delays(site)
    first = method in {SnapshotMethod.LITERAL, SnapshotMethod.WEIGHTED}
    covariance_of = literal_covariance if first else bracketed_covariance
    covariance = covariance_of(kappa, tx_var, rx_var)
    own = covariance.diagonal() - rx_var
    clock = phase_covariance(
        np.maximum(kappa, 0.0), round_s, clock_noise(noise.white_fm, noise.random_walk_fm, clocks=1), first=first
    )
    return Rounds(
        usable=kappa > 0.0,
        assumed_own=own,
        assumed_common=rx_var,
        true_own=own + clock.diagonal(),
        common=_factors(clock + rx_var),
    )


def delays(site: Site) -> tuple[Vector, float]:
    """κ of each anchor, shape (n,), negative if it sends before the master, and the round's length in s."""
    schedule = schedule_of(site)
    first = first_slots(site)
    spacing = schedule.slots // schedule.frames_per_node
    slots = np.array([first[anchor.id] % spacing for anchor in site.anchors])
    master = slots[row_of_master(site)]
    return (slots - master) / spacing, spacing * schedule.slot_ticks * TICK_S


def phase_covariance(kappa: Vector, round_s: float, noise: ClockNoise, *, first: bool) -> Matrix:
    """Covariance, m², of one clock's noise in TDoAs with these κ; shape (n, n)."""
    reference = 0.0 if first else 1.0
    near, far = (1.0 + kappa, -kappa) if first else (kappa, 1.0 - kappa)
    times = np.array([kappa, kappa + 1.0, np.full_like(kappa, reference)]) * round_s
    weights = np.array([near, far, -np.ones_like(kappa)])
    total: Matrix = np.zeros((len(kappa), len(kappa)))
    for a in range(3):
        for b in range(3):
            total += np.outer(weights[a], weights[b]) * _phase(times[a][:, None], times[b][None, :], noise)
    return total


def _phase(s: Matrix, t: Matrix, noise: ClockNoise) -> Matrix:
    """Covariance of a clock's phase at two times after an instant with exact phase and rate."""
    low, high = np.maximum(np.minimum(s, t), 0.0), np.maximum(s, t)
    covariance: Matrix = noise.white * low + noise.walk * low * low * (3.0 * high - low) / 6.0
    return covariance


def _factors(covariance: Matrix) -> Matrix:
    values, vectors = np.linalg.eigh(covariance)
    kept = values > _MIN_EIGENVALUE * values[-1]
    factors: Matrix = np.ascontiguousarray(vectors[:, kept] * np.sqrt(values[kept]))
    return factors


def gains(towards: Array, weights: Matrix, common: float) -> Array:
    """Gain G of the least squares over TDoAs, shape (m, n, dim); infinite where singular.

    ``towards``: rows of H, shape (m, n, dim). TDoAs have variances 1/weights, shape (m, n), and a common error of
    variance ``common`` (Sherman-Morrison).
    """
    weighted = weights[..., None] * towards
    mean = weighted.sum(axis=1)
    share = common / (1.0 + common * weights.sum(axis=1))[:, None, None]
    normal = towards.transpose(0, 2, 1) @ weighted - share * (mean[:, :, None] * mean[:, None])
    inverse, is_determined = inverses(normal)
    gain: Array = (weighted - share * (weights[..., None] * mean[:, None])) @ inverse
    gain[~is_determined] = np.inf
    return gain


def variances(gain: Array, own: Matrix, common: Array) -> Matrix:
    """Diagonal of G·(diag(own) + common·commonᵀ)·Gᵀ, shape (m, dim). ``own``: shape (m, n); ``common``: (m, n, k)."""
    together = gain.transpose(0, 2, 1) @ common
    found: Matrix = np.einsum("mna,mna,mn->ma", gain, gain, own) + (together * together).sum(axis=2)
    return found


def anchor_sets(part: Matrix) -> Iterator[tuple[Vector, Mask]]:
    """Sets of anchors that fixes at points may use: their probabilities, shape (m,), and masks, shape (m, n).

    ``part``: share of the rounds in which each anchor takes part, shape (m, n).
    """
    uncertain = (part > _UNCERTAIN) & (part < 1.0 - _UNCERTAIN)
    order = np.argsort(np.where(uncertain, np.abs(part - 0.5), np.inf), axis=1, kind="stable")[:, :_MAX_UNCERTAIN]
    order = order[:, np.take_along_axis(uncertain, order, axis=1).any(axis=0)]
    uncertain_here, there = np.take_along_axis(uncertain, order, axis=1), np.take_along_axis(part, order, axis=1)
    usual = part >= 0.5
    usual_here = np.take_along_axis(usual, order, axis=1)
    for present in product((False, True), repeat=order.shape[1]):
        chances = np.where(uncertain_here, np.where(present, there, 1.0 - there), np.logical_not(present))
        np.put_along_axis(usual, order, np.where(uncertain_here, present, usual_here), axis=1)
        yield chances.prod(axis=1), usual


def fill_snapshot_sigma(
    points: Matrix,
    dim: int,
    scene: Scene,
    master: int,
    links: AnchorLinks,
    rounds: Rounds,
    weighted: bool,
    farthest_m: float,
    table: Matrix,
) -> None:
    """Fill ``table`` (points, columns) with errors of a snapshot method at points, shape (m, 3).

    Sets of anchors whose error would exceed ``farthest_m`` give no fix.
    """
    share, delay_m = scene.heard_at(points)
    fill_dops(scene, points, share, dim, table)
    part = share * share * np.where(rounds.usable & (scene.sends > 0.0), links.share**2, 0.0)
    part[:, master] = 0.0
    # For each point only the anchors that take part, in descending order of their part.
    some = np.argsort(-part, axis=1, kind="stable")[:, : int((part > _UNCERTAIN).sum(axis=1).max())]
    part = np.take_along_axis(part, some, axis=1)
    towards = (_directions(scene.anchors[some], points) - _directions(scene.anchors[master], points))[..., :dim]
    late_m = np.take_along_axis(delay_m, some, axis=1) - delay_m[:, master, None] + links.delay_m[some]
    assumed, true, common = rounds.assumed_own[some], rounds.true_own[some], rounds.common[some]
    assumed_common = np.full((*some.shape, 1), rounds.assumed_common**0.5)
    weights = 1.0 / assumed if weighted else np.ones(some.shape)
    fixes, claimed = np.zeros((2, len(points)))
    total, bias = np.zeros((2, len(points), 3))
    for probability, chosen in anchor_sets(part):
        rows = np.flatnonzero((probability > 0.0) & (chosen.sum(axis=1) >= dim))
        gain = gains(towards[rows], chosen[rows] * weights[rows], rounds.assumed_common if weighted else 0.0)
        with np.errstate(invalid="ignore"):
            predicted = variances(gain, assumed[rows], assumed_common[rows]).sum(axis=1)
        good = predicted < farthest_m**2
        rows, gain = rows[good], gain[good]
        chance = probability[rows]
        shift = np.einsum("mna,mn->ma", gain, late_m[rows])
        fixes[rows] += chance
        claimed[rows] += chance * predicted[good]
        bias[rows, :dim] += chance[:, None] * shift
        total[rows, :dim] += chance[:, None] * (variances(gain, true[rows], common[rows]) + shift * shift)
    table[:, SIGMA:] = np.inf
    table[:, FIX_SHARE] = fixes * share[:, master] ** 2
    known = np.flatnonzero(table[:, FIX_SHARE] >= _UNCERTAIN)
    shift = bias[known] / fixes[known, None]
    variance = np.maximum(total[known] / fixes[known, None] - shift * shift, 0.0)
    fill_errors(table, known, variance, (shift * shift).sum(axis=1), claimed[known] / fixes[known])


def _directions(anchors: Array, points: Matrix) -> Array:
    """Unit vectors from anchors, shape (m, n, 3) or (3,), to points, shape (m, 3)."""
    away = points[:, None] - anchors
    unit: Array = away / np.maximum(np.linalg.norm(away, axis=2, keepdims=True), 1e-6)
    return unit


Fill = Callable[[Matrix, Matrix], None]

MAX_PREDICTED: Final = 60
"""Larger sites of protocol 2 are planned by the beacons that reach tags (``rates``)."""

# Points that a thread computes at a time: fewer for the filter, which is slower.
_SNAPSHOT_CHUNK: Final = 2000
_FILTER_CHUNK: Final = 100


class PlanSettings(Struct, frozen=True):
    """Assumptions beyond the site file."""

    method: str = DEFAULT_METHOD
    noise_ps: float | None = None
    """Noise of every TX and RX stamp; None for the site's own figures."""
    qa: float = 0.3
    """Process noise of the filter: spectral density of the acceleration, m²/s³."""
    channel: ChannelModel = ChannelModel()


class Predictor:
    """Predictions for one site and one method."""

    def __init__(self, site: Site, settings: PlanSettings) -> None:
        self.site = with_noise(site, settings.noise_ps)
        self.settings = settings
        self.dim = 3 if site.tags.height_m is None else 2
        self.anchors_m = anchor_positions(site)
        self.master = row_of_master(site) if site.schedule.needs_master else None
        """Row of the master; None where there is none."""
        self.budget, self.barriers = link_budget(settings.channel), barriers_of(site.walls, site.storeys)
        self.links: AnchorLinks = (
            AnchorLinks(np.ones(len(site.anchors)), np.zeros(len(site.anchors)))
            if self.master is None
            else anchor_links(self.anchors_m, self.master, self.budget, self.barriers)
        )
        self.clocks = anchor_clocks(self.site, self.links.share)
        self.scene = Scene(
            self.anchors_m, np.where(self.clocks.sends, self.clocks.kept, 0.0), self.budget, self.barriers
        )
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
        """Standard deviations that ``joint`` claims after walks of 1 m from points, along x and along y, shape (2·m,).

        Walks go towards the middle of the points, shape (m, 3), at 1 m/s. Infinite where there is no fix.
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
        """Estimator settings, anchors, messages and relays of the site, and the most anchors that a tag uses."""
        settings = estimator_settings(
            self.settings.qa, self.site.tags.height_m, *filter_pages_of(self.site), superframe_s(self.site)
        )
        relays = relays_of(self.anchors_m, self.master, self.clocks, self.budget, self.barriers)
        return settings, self.scene, self.clocks, relays, MAX_ANCHORS_IN_USE if self.master is None else None

    def at(self, points_m: Matrix, progress: Callable[[float], None] | None = None) -> Matrix:
        """Table of predictions (m, len(PLAN_COLUMNS)) at points, shape (m, 3); ``progress`` gets the points done."""
        return in_threads(self._fill, np.ascontiguousarray(points_m, np.float64), self._chunk, progress)

    def geometry_at(self, points_m: Matrix) -> Matrix:
        """Table with only anchors in view and DOPs; its column ``sigma_m`` is the weighted PDOP."""
        return in_threads(self._geometry, np.ascontiguousarray(points_m, np.float64), _SNAPSHOT_CHUNK)

    def _geometry(self, points: Matrix, table: Matrix) -> None:
        share, _ = self.scene.heard_at(points)
        fill_dops(self.scene, points, share, self.dim, table)
        table[:, SIGMA] = weighted_pdop(self.scene, points, share, self.dim)


def with_noise(site: Site, noise_ps: float | None) -> Site:
    """The site with this noise of every stamp, or unchanged for None."""
    if noise_ps is None:
        return site
    return replace(site, noise=replace(site.noise, tx_stamp_ps=noise_ps, rx_stamp_ps=noise_ps))


def in_threads(fill: Fill, points_m: Matrix, chunk: int, progress: Callable[[float], None] | None = None) -> Matrix:
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
