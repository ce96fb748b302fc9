"""Predicted errors of ``joint`` for a stationary tag: the estimator's own kernels on a superframe, covariance only.

The filter's P, with constant errors of ranges and survey as the site configures them, is run through superframes until
it repeats. It holds what the filter allows for accelerations, which a stationary tag does not have. That part follows
from the estimator's sensitivities V: rows of V begin, at moments of a superframe, as a velocity that the filter does
not know of, and the squares of what they do to the position, integrated over the time after that, are what
accelerations add to P. Another row holds the walls' delays.

Where only a share of an anchor's packets arrives, the stamps of all count for as much less: their variances are divided
by the share, and those of relayed receptions by the share of all three that they take.
"""

import math
from typing import Final

import numpy as np

from skyless.core.constants import TICK_S
from skyless.core.estimator.faults import compute_fault_input
from skyless.core.estimator.kalman import compute_ph, predict, relax_range_error, reset_state, update
from skyless.core.estimator.measurements import first_reception, reception_terms, relay_terms, relay_variance
from skyless.core.estimator.settings import EstimatorSettings
from skyless.core.estimator.state import FAULT_KINDS, EstimatorState, layout, new_state, with_anchor
from skyless.core.kernels.arrays import Integers, Matrix, Vector
from skyless.core.kernels.compiled import kernel, threaded_kernel
from skyless.site.planning.anchor_clocks import AnchorClocks, Relays
from skyless.site.planning.links import BIAS, FIX_SHARE, SIGMA, SIGMA_X, SIGMA_Z, Scene, fill_dops, fill_errors

_RARELY: Final = 0.1  # an anchor of whose frames fewer arrive does not help the tag

# The position's variance, or a sum, counts as complete when it changes by less than this share in _COMPLETE_OVER_S or
# in a superframe, if that is longer; at the latest after _MAX_S and _MAX_SUPERFRAMES.
_COMPLETE_CHANGE: Final = 1e-3
_COMPLETE_OVER_S: Final = 0.1
_MAX_S: Final = 4.0
_MAX_SUPERFRAMES: Final = 20

_IMPULSES: Final = 4  # moments of a superframe at which an acceleration is tried
_AFTER_ALL_TICKS: Final = 1 << 62  # a time after all others
_START_VARIANCE: Final = 1.0  # of position and velocity, m² and m²/s²; the steady state does not depend on it


def site_state(settings: EstimatorSettings, anchors_m: Matrix, in_view: Integers) -> EstimatorState:
    """The estimator's state with the anchors in these rows of the site; V has rows for walls and accelerations."""
    s = new_state(settings, len(anchors_m))
    s.status["walk_scale"] = 1.0
    for axis in range(2 * settings.dim):
        s.P[axis, axis] = _START_VARIANCE
    for row in in_view.tolist():
        s = with_anchor(s, row, anchors_m[row])
    rows = len(s.V) + 1 + _IMPULSES * settings.dim
    return s._replace(V=np.zeros((rows, len(s.x))), fault_input=np.zeros(rows))


@kernel
def _superframe(
    s: EstimatorState,
    clocks: AnchorClocks,
    relays: Relays,
    share: Vector,
    delay_m: Vector,
    begin_ticks: int,
    impulses_ticks: int,
    motion: Vector,
    row: Vector,
) -> int:
    """Process a superframe's packets; when it ends.

    Leaves sums over packets, each by how often it arrives, of the position's variances and squared mean error in
    ``row``. Impulses act on the tag at moments of the superframe that begins at ``impulses_ticks``; the squares of what
    they do to the position are added to ``motion``.
    """
    dim, count, now = s.settings[0]["dim"], len(s.anchors), begin_ticks
    walls = FAULT_KINDS * count + dim
    row[SIGMA_X : SIGMA_Z + 1], row[FIX_SHARE], row[BIAS] = 0.0, 0.0, 0.0
    for k in range(len(clocks.sender)):
        now += round(clocks.gap_s[k] / TICK_S)
        own = s.index_of[clocks.sender[k]]
        if own < 0:
            continue
        _time_update(s, now, impulses_ticks, clocks.gap_s.sum())
        arrives = share[clocks.sender[k]]
        _own_reception(s, own, now, arrives, delay_m[clocks.sender[k]])
        for r in range(relays.ends[k - 1] if k > 0 else 0, relays.ends[k]):
            sender = s.index_of[relays.sender[r]]
            if sender >= 0 and s.anchors[sender]["packets"] > 0:
                used = arrives * share[relays.sender[r]] * relays.share[r]
                _relay(s, own, sender, relays.age_s[r], used, relays.delay_m[r])
        row[FIX_SHARE] += arrives
        for axis in range(dim):
            row[SIGMA_X + axis] += arrives * s.P[axis, axis]
            row[BIAS] += arrives * s.V[walls, axis] ** 2
            for fault in range(walls + 1, s.V.shape[0]):
                motion[axis] += arrives * s.V[fault, axis] ** 2
    return now


@kernel
def _time_update(s: EstimatorState, now: int, impulses_ticks: int, superframe_s: float) -> None:
    """Time update, with a velocity of 1 m/s that the filter does not know of from each impulse on."""
    dim, count, before = s.settings[0]["dim"], len(s.anchors), s.status[0]["epoch_ticks"]
    velocity = layout(dim, count).velocity
    predict(s, now)
    for impulse in range(_IMPULSES):
        moment = impulses_ticks + round((impulse + 0.5) / _IMPULSES * superframe_s / TICK_S)
        if before < moment <= now:
            for axis in range(dim):
                row = FAULT_KINDS * count + dim + 1 + dim * impulse + axis
                s.V[row, axis], s.V[row, velocity + axis] = (now - moment) * TICK_S, 1.0


@kernel
def _own_reception(s: EstimatorState, anchor: int, rx_ticks: int, share: float, late_m: float) -> None:
    """The tag's reception of an anchor, of which this share arrives, late by ``late_m``."""
    settings, a, _n = s.settings[0], s.anchors[anchor], len(s.x)
    where = layout(settings["dim"], len(s.anchors))
    walls = FAULT_KINDS * len(s.anchors) + settings["dim"]
    if a["packets"] == 0:
        first_reception(s, anchor, rx_ticks, rx_ticks)
        s.V[walls, where.offset + anchor] += late_m
    else:
        relax_range_error(s, anchor, (rx_ticks - a["rx_ticks"]) * TICK_S, 0.0)
        reset_state(s, where.tx_noise + anchor, settings["tx_variance_m2"] / share)
        terms, _ = reception_terms(s, anchor, 1)
        variance = compute_ph(s, terms) + settings["rx_variance_m2"] / share
        compute_fault_input(s, terms, anchor)
        s.fault_input[walls] += late_m
        update(s, 0.0, variance)
    a["rx_ticks"] = rx_ticks
    a["packets"] += 1


@kernel
def _relay(s: EstimatorState, listener: int, sender: int, age_s: float, share: float, late_m: float) -> None:
    """A relayed reception, of which the tag can use this share, late by ``late_m``."""
    terms = relay_terms(s, listener, sender, age_s, True)
    variance = relay_variance(s, listener, sender, age_s) / share
    variance += compute_ph(s, terms)
    compute_fault_input(s, terms, -1)
    if s.links[listener, sender]["variance_m2"] == 0.0:  # else the pair's constant takes the delay
        s.fault_input[FAULT_KINDS * len(s.anchors) + s.settings[0]["dim"]] += late_m
    update(s, 0.0, variance)


@threaded_kernel
def predict_steady_state(
    s: EstimatorState,
    clocks: AnchorClocks,
    relays: Relays,
    share: Vector,
    delay_m: Vector,
    motion: Vector,
    row: Vector,
) -> None:
    """Predict for a tag at the state's position: sums over a superframe's fixes, whose number is in ``FIX_SHARE``.

    ``motion``, which is zero before, becomes what accelerations have of each axis' variance.
    """
    superframe_s = clocks.gap_s.sum()
    most = max(_MAX_SUPERFRAMES, math.ceil(_MAX_S / superframe_s))
    step = max(1, math.ceil(_COMPLETE_OVER_S / superframe_s))
    now, before = 0, 0.0
    for superframe in range(most):
        now = _superframe(s, clocks, relays, share, delay_m, now, _AFTER_ALL_TICKS, motion, row)
        if superframe % step == step - 1:
            variance = row[SIGMA_X : SIGMA_Z + 1].sum()
            if abs(variance - before) <= _COMPLETE_CHANGE * variance:
                break
            before = variance
    impulses_ticks, before = now, 0.0
    for superframe in range(most):
        now = _superframe(s, clocks, relays, share, delay_m, now, impulses_ticks, motion, row)
        if superframe % step == step - 1:
            if superframe >= 1 and motion.sum() - before <= _COMPLETE_CHANGE * motion.sum():
                break
            before = motion.sum()
    motion *= s.settings[0]["qa"] * superframe_s / (_IMPULSES * row[FIX_SHARE])


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
    seen = np.zeros(0, np.int64)
    fresh = site_state(settings, scene.anchors, seen)
    motions, messages = np.zeros((len(points), 3)), np.full(len(points), len(clocks.sender))
    for k, (point, share, delay_m, motion, row) in enumerate(
        zip(points, shares, delays_m, motions, table, strict=True)
    ):
        in_view = np.flatnonzero(share >= _RARELY)
        if most is not None:
            in_view = scene.strongest(point, in_view, most)
            messages[k] = np.isin(clocks.sender, in_view).sum()
        if len(in_view) <= dim:
            continue
        if not np.array_equal(in_view, seen):
            seen, fresh = in_view, site_state(settings, scene.anchors, in_view)
        s = EstimatorState._make(part.copy() for part in fresh)
        s.x[:dim] = point[:dim]
        if dim == 2:
            s.settings["height_m"] = point[2]
        predict_steady_state(s, clocks, relays, share, delay_m, motion, row)
    known = np.flatnonzero(table[:, FIX_SHARE] > 0.0)
    heard = table[known, FIX_SHARE]
    claimed = table[known, SIGMA_X : SIGMA_Z + 1] / heard[:, None]
    variance = np.maximum(claimed - motions[known], 0.0)
    fill_errors(table, known, variance, table[known, BIAS] / heard, claimed.sum(axis=1))
    table[known, FIX_SHARE] = heard / messages[known]
    lost = ~(table[:, SIGMA] < farthest)
    table[lost, SIGMA:], table[lost, FIX_SHARE] = math.inf, 0.0
