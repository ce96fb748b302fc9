"""Cramér–Rao bounds: the least error that any unbiased estimator can have with the stamps of a schedule.

With Gaussian noise the (posterior) bound is the covariance of a filter that is linearised at the truth. Its states, in
metres and m/s of light, all clocks against the first anchor's:

    values      position p (dims), offset b of the tag's clock, offsets x_i of all anchors but the first
    rates       velocity v, rates f and f_i, in the same order
    biases      see ``Biases``; none where the bound has none
    TX noise    of the newest frame's stamp, which everyone who receives the frame shares

The first anchor's oscillator is in all clock differences, so their process noise is q·(I + 11ᵀ). Three bounds run the
same recursion: with all receptions (``tracking_bound``), with those that a receiver gets to know where frames are lost
(``received_bound``), and with biases of survey and ranges (``biased_bound``). Equations: ``docs/maths.md`` section 7.
"""

import math
from typing import Final, NamedTuple, TypeAlias

import numpy as np
from msgspec import Struct
from numpy.random import Generator
from numpy.typing import ArrayLike

from skyless.constants import SPEED_OF_LIGHT_MPS
from skyless.kernels.arrays import Array, Indices, Integers, Mask, Matrix, Vector
from skyless.kernels.compiled import jitted, kernel, threaded_kernel
from skyless.kernels.covariance import (
    add_process_noise,
    decay_state,
    integrate_rates,
    multiply_ph,
    reset_covariance,
    subtract_information,
)
from skyless.uncertainty.dop import direction

POSITION_STD_M: Final = 30.0
OFFSET_STD_M: Final = 1e4
RATE_STD_MPS: Final = 10e-6 * SPEED_OF_LIGHT_MPS
"""What is known before the first frame, next to nothing: 30 m, 33 µs, ±10 ppm."""

_MOST_TERMS: Final = 12
"""Of a reception by the tag with all biases: two directions, two clocks, TX noise, and three errors of the range."""


class BoundSettings(Struct, frozen=True):
    """A schedule of one frame per anchor and superframe, and the noise."""

    tx_variance_m2: float
    rx_variance_m2: float
    white: float
    """Of each oscillator, m²/s (c²·σ_y²(1 s) of white FM)."""
    walk: float
    """Of each oscillator's rate, m²/s³."""
    qa: float
    """Spectral density of the acceleration, m²/s³ per axis."""
    slot_s: float
    speed_std_mps: float
    """Of each component of the velocity, before the first frame."""
    mesh: bool
    """Whether anchors also relay when they received each other, not only the first anchor."""
    height_known: bool = True
    at_once: bool = True
    """Whether anchors' receptions are known at once; else each comes with the listener's next frame, as on the air."""

    @property
    def dims(self) -> int:
        """Dimensions of the position that are estimated."""
        return 2 if self.height_known else 3


def bound_settings(
    stamp_s: float,
    *,
    white_fm: float,
    random_walk_fm: float,
    qa: float,
    slot_s: float,
    speed_std_mps: float,
    mesh: bool,
    height_known: bool = True,
    at_once: bool = True,
) -> BoundSettings:
    """Settings from a stamp's noise in seconds (TX and RX alike) and oscillator figures as in ``clocks/filter.py``."""
    light2 = SPEED_OF_LIGHT_MPS**2
    stamp = light2 * stamp_s**2
    return BoundSettings(
        tx_variance_m2=stamp,
        rx_variance_m2=stamp,
        white=light2 * white_fm**2,
        walk=light2 * random_walk_fm**2,
        qa=qa,
        slot_s=slot_s,
        speed_std_mps=speed_std_mps,
        mesh=mesh,
        height_known=height_known,
        at_once=at_once,
    )


PerAnchor: TypeAlias = float | tuple[float, ...]
"""One value for all anchors, or one for each."""


class Biases(Struct, frozen=True):
    """Standard deviations of errors that nobody knows, in metres; each has a normal prior with mean zero.

    They are states behind the clocks, and every measurement updates all of them: what anchors receive of each other
    informs about their positions as well. For priors that are not normal the bound is the least mean square error
    of all linear estimators.
    """

    survey_std_m: PerAnchor = 0.0
    """Of each coordinate of an anchor that the position has (two where the height is known): true − configured."""
    constant_std_m: PerAnchor = 0.0
    """Of what all of the tag's ranges to an anchor are wrong by."""
    changing_std_m: PerAnchor = 0.0
    """Of a part of that error that changes: Gauss–Markov along time, the tag's path, or both."""
    slope_std_m: float = 0.0
    """Of what ranges gain for each unit of clip((range − 4 m)/4 m, −1, 1)."""
    pair_std_m: float = 0.0
    """Of what receptions of one anchor by another are wrong by, for each pair, alike both ways."""
    correlation_s: float = math.inf
    """Time in which the correlation of the part that changes falls to 1/e ..."""
    correlation_m: float = math.inf
    """... and distance walked by the tag in which it does."""


def tracking_bound(anchors_m: ArrayLike, path_m: ArrayLike, settings: BoundSettings) -> Array:
    """Posterior bound of the position after every superframe, shape (superframes, dims, dims), in m².

    ``anchors_m``: shape (n, 3), in the order of their slots, the reference first. ``path_m``: where the tag is at each
    frame, shape (superframes·n, 3).

    Raises:
        ValueError: the path has no whole number of superframes.
    """
    return _superframe_bound(anchors_m, path_m, settings, None)


def biased_bound(anchors_m: ArrayLike, path_m: ArrayLike, settings: BoundSettings, biases: Biases) -> Array:
    """As ``tracking_bound``, with biases; ``anchors_m`` are the anchors' true positions.

    Raises:
        ValueError: the path has no whole number of superframes, or there is not one deviation for each anchor.
    """
    return _superframe_bound(anchors_m, path_m, settings, biases)


class Sendings(Struct, frozen=True):
    """Frames that do not come in the order of a superframe."""

    senders: Integers
    """Index of each frame's anchor, shape (frames,)."""
    times_s: Array
    """When they are sent, in order, shape (frames,)."""


def received_bound(
    anchors_m: ArrayLike,
    path_m: ArrayLike,
    settings: BoundSettings,
    known: Mask,
    sendings: Sendings | None = None,
    biases: Biases | None = None,
) -> Array:
    """Posterior bound of the position after every frame, shape (frames, dims, dims), in m², where frames are lost.

    ``anchors_m``: shape (n, 3), in the order of their slots, the reference first. ``path_m``: where the tag is at each
    frame, shape (frames, 3). ``known``: as of ``known_receptions``, shape (frames, n + 1); it, not the settings, states
    what of the mesh is known. ``sendings``: who sends when, if not one anchor after the other in equal slots.

    Raises:
        ValueError: there is not one row of ``known`` and one sending for each position.
    """
    anchors = np.ascontiguousarray(anchors_m, np.float64)
    path = np.ascontiguousarray(path_m, np.float64)
    if known.shape != (len(path), len(anchors) + 1):
        raise ValueError(f"known has shape {known.shape}; it should be {(len(path), len(anchors) + 1)}")
    if sendings is not None and not len(sendings.senders) == len(sendings.times_s) == len(path):
        raise ValueError(f"sendings has {len(sendings.senders)} frames; it should be {len(path)}")
    return _frame_bound(anchors, path, settings, known, True, biases, sendings)


def known_receptions(
    draw: Generator, frames: int, anchors: int, *, lost_at_tags: float, lost_at_anchors: float, mesh: bool
) -> Mask:
    """Which receptions of each frame the tag gets to know, shape (frames, anchors + 1); its own are the last column.

    Anchors send in turn, the reference first. The information is what there is on the air at most. What an anchor
    receives of the reference is known at once, whatever the tag receives of that anchor, as its next beacon states its
    clock, in which all of it is. Other receptions among anchors are known where the tag has received the packet itself,
    without whose stamp they give no information, and receives the listener before that has received a newer one; they
    are known at once as well, so that no receiver can do better.
    """
    senders = np.arange(frames) % anchors
    heard = draw.random((frames, anchors + 1)) >= np.append(np.full(anchors, lost_at_anchors), lost_at_tags)
    own = heard[:, -1]
    relay_share = (1.0 - lost_at_tags) / max(1.0 - lost_at_tags * lost_at_anchors, 1e-12)
    relayed = draw.random((frames, anchors)) < relay_share
    others = relayed & own[:, None] if mesh else np.zeros_like(relayed)
    others[senders == 0] = True
    heard[:, :-1] &= others
    heard[np.arange(frames), senders] = False
    return heard


def _superframe_bound(anchors_m: ArrayLike, path_m: ArrayLike, settings: BoundSettings, biases: Biases | None) -> Array:
    anchors = np.ascontiguousarray(anchors_m, np.float64)
    path = np.ascontiguousarray(path_m, np.float64)
    n, frames = len(anchors), len(path)
    if frames % n:
        raise ValueError(f"the path has {frames} positions, no multiple of {n} anchors")
    senders = np.arange(frames) % n
    known = np.ones((frames, n + 1), np.bool_)
    known[:, :-1] = settings.mesh | (senders == 0)[:, None]
    known[np.arange(frames), senders] = False
    return _frame_bound(anchors, path, settings, known, settings.at_once, biases)[n - 1 :: n]


def _frame_bound(
    anchors: Array,
    path: Array,
    settings: BoundSettings,
    known: Mask,
    at_once: bool,
    biases: Biases | None,
    sendings: Sendings | None = None,
) -> Array:
    """Bound after every frame; where receptions are not known at once it holds at the end of a superframe."""
    n, dims = len(anchors), settings.dims
    errors = Biases() if biases is None else biases
    senders, intervals_s = np.arange(len(path), dtype=np.uint32) % n, np.full(len(path), settings.slot_s)
    if sendings is not None:
        senders, intervals_s = sendings.senders.astype(np.uint32), np.diff(sendings.times_s, prepend=0.0)
    model = _Model(
        anchors,
        path,
        known,
        senders,
        intervals_s,
        dims,
        biases is not None,
        settings.qa,
        settings.white,
        settings.walk,
        settings.tx_variance_m2,
        settings.rx_variance_m2,
        np.square(_of_each("changing_std_m", errors.changing_std_m, n)),
        1.0 / errors.correlation_s,
        1.0 / errors.correlation_m,
    )
    P = _prior(n, settings, biases)
    bound = np.empty((len(path), dims, dims))
    h, h_index, ph = np.empty(_MOST_TERMS + dims), np.empty(_MOST_TERMS + dims, np.uint32), np.empty(len(P))
    _run(model, at_once, P, np.empty_like(P), h, h_index, ph, bound)
    return bound


def _of_each(name: str, std_m: PerAnchor, anchors: int) -> Array:
    given = np.atleast_1d(np.asarray(std_m, np.float64))
    if len(given) not in {1, anchors}:
        raise ValueError(
            f"{name} has {len(given)} values; it should be one number, or one for each of {anchors} anchors"
        )
    return np.broadcast_to(given, anchors).copy()


def _prior(anchors: int, settings: BoundSettings, biases: Biases | None) -> Matrix:
    """Covariance before the first frame."""
    dims = settings.dims
    stds = [
        [POSITION_STD_M] * dims,
        [OFFSET_STD_M] * anchors,
        [settings.speed_std_mps] * dims,
        [RATE_STD_MPS] * anchors,
    ]
    parts = [np.array(part) for part in stds]
    if biases is not None:
        parts += [
            np.repeat(_of_each("survey_std_m", biases.survey_std_m, anchors), dims),
            _of_each("constant_std_m", biases.constant_std_m, anchors),
            _of_each("changing_std_m", biases.changing_std_m, anchors),
            np.array([biases.slope_std_m]),
            np.full(anchors * (anchors - 1) // 2 if biases.pair_std_m > 0.0 else 0, biases.pair_std_m),
        ]
    return np.diag(np.square(np.concatenate([*parts, np.zeros(1)])))


class _Model(NamedTuple):
    """What the kernels need to know."""

    anchors: Array
    path: Array
    known: Mask
    """Receptions, shape (frames, anchors + 1), the tag's own in the last column."""
    senders: Indices
    """Of each frame, shape (frames,)."""
    intervals_s: Vector
    """Since the frame before, shape (frames,)."""
    dims: int
    has_biases: bool
    qa: float
    white: float
    walk: float
    tx_variance_m2: float
    rx_variance_m2: float
    changing_m2: Vector
    """Variance of the part of range errors that changes, shape (anchors,)."""
    changes_per_s: float
    changes_per_m: float


class _Layout(NamedTuple):
    """Where the states begin; the TX noise is the last."""

    values: int
    """Number of states that have rates."""
    survey: int
    constant: int
    change: int
    slope: int
    pair: int


@jitted
def _layout(dims: int, anchors: int) -> _Layout:
    survey = 2 * (dims + anchors)
    constant = survey + dims * anchors
    slope = constant + 2 * anchors
    return _Layout(dims + anchors, survey, constant, constant + anchors, slope, slope + 1)


@threaded_kernel
def _run(
    m: _Model, at_once: bool, P: Matrix, present: Matrix, h: Vector, h_index: Indices, ph: Vector, bound: Array
) -> None:
    """Process frame by frame.

    Where receptions are not known at once, those by anchors whose turn is earlier in the superframe come with the next
    superframe: they are left out of ``present``, from which the superframe's own bound is.
    """
    n = len(m.anchors)
    for frame in range(len(m.path)):
        if not at_once and frame % n == 0:
            present[:] = P
            for own in range(frame, frame + n):
                _process_frame(m, own, False, present, h, h_index, ph)
                bound[own] = present[: m.dims, : m.dims]
        _process_frame(m, frame, True, P, h, h_index, ph)
        if at_once:
            bound[frame] = P[: m.dims, : m.dims]


@kernel
def _process_frame(m: _Model, frame: int, at_once: bool, P: Matrix, h: Vector, h_index: Indices, ph: Vector) -> None:
    """Process the receptions of a frame: the tag's, and those of anchors that are relayed."""
    n, sender = len(m.anchors), m.senders[frame]
    if frame > 0:
        _predict(m, m.intervals_s[frame], P)
        if m.has_biases:
            _decay_changes(m, frame, P)
    reset_covariance(P, len(P), len(P) - 1, m.tx_variance_m2)
    if m.known[frame, n]:
        _update(m, P, h, h_index, _tag_terms(m, frame, len(P), h, h_index), ph)
    for listener in range(n):
        if m.known[frame, listener] and (at_once or listener > sender):
            _update(m, P, h, h_index, _anchor_terms(m, sender, listener, len(P), h, h_index), ph)


@kernel
def _predict(m: _Model, dt_s: float, P: Matrix) -> None:
    """Time update: constant velocity, and clocks whose differences all hold the first anchor's oscillator."""
    values = m.dims + len(m.anchors)
    integrate_rates(P, len(P), values, dt_s)
    for axis in range(m.dims):
        add_process_noise(P, axis, values + axis, axis, values + axis, dt_s, 0.0, m.qa)
    for i in range(m.dims, values):
        for j in range(m.dims, values):
            share = 2.0 if i == j else 1.0
            add_process_noise(P, i, values + i, j, values + j, dt_s, share * m.white, share * m.walk)


@kernel
def _decay_changes(m: _Model, frame: int, P: Matrix) -> None:
    """Time update of the part of range errors that changes."""
    n, first = len(m.anchors), _layout(m.dims, len(m.anchors)).change
    walked_m = _distance_m(m.path[frame - 1], m.path[frame])
    kept = math.exp(-m.intervals_s[frame] * m.changes_per_s - walked_m * m.changes_per_m)
    for anchor in range(n):
        decay_state(P, len(P), first + anchor, kept, m.changing_m2[anchor])


@kernel
def _update(m: _Model, P: Matrix, h: Vector, h_index: Indices, terms: int, ph: Vector) -> None:
    """What the measurement in ``h`` leaves of the covariance."""
    n = len(P)
    innovation_variance = multiply_ph(P, n, h, h_index, terms, ph) + m.rx_variance_m2
    subtract_information(P, n, ph, innovation_variance)


@kernel
def _distance_m(a: Array, b: Array) -> float:
    return math.sqrt((a[0] - b[0]) ** 2 + (a[1] - b[1]) ** 2 + (a[2] - b[2]) ** 2)


@jitted
def _set_term(h: Vector, h_index: Indices, term: int, state: int, weight: float) -> int:
    h[term], h_index[term] = weight, state
    return term + 1


@kernel
def _tag_terms(m: _Model, frame: int, size: int, h: Vector, h_index: Indices) -> int:
    """The tag's stamp less the frame's: range, its clock, less the sender's, less the TX noise; number of terms.

    With biases the range also holds the anchor's displacement and all errors of ranges.
    """
    sender, position = m.senders[frame], m.path[frame]
    towards = direction(m.anchors, sender, position)
    term = _set_term(h, h_index, 0, m.dims, 1.0)
    for axis in range(m.dims):
        term = _set_term(h, h_index, term, axis, towards[axis])
    term = _sender_terms(m, sender, size, h, h_index, term)
    if m.has_biases:
        where = _layout(m.dims, len(m.anchors))
        for axis in range(m.dims):
            term = _set_term(h, h_index, term, where.survey + m.dims * sender + axis, -towards[axis])
        term = _set_term(h, h_index, term, where.constant + sender, 1.0)
        term = _set_term(h, h_index, term, where.change + sender, 1.0)
        far = min(max((_distance_m(m.anchors[sender], position) - 4.0) / 4.0, -1.0), 1.0)
        term = _set_term(h, h_index, term, where.slope, far)
    return term


@kernel
def _anchor_terms(m: _Model, sender: int, listener: int, size: int, h: Vector, h_index: Indices) -> int:
    """An anchor's stamp less the frame's, whose distance is known; number of terms.

    With biases the distance holds the displacements of both anchors, and what their pair is wrong by.
    """
    n, term = len(m.anchors), _sender_terms(m, sender, size, h, h_index, 0)
    if listener > 0:
        term = _set_term(h, h_index, term, m.dims + listener, 1.0)
    if m.has_biases:
        where, towards = _layout(m.dims, n), direction(m.anchors, sender, m.anchors[listener])
        for axis in range(m.dims):
            term = _set_term(h, h_index, term, where.survey + m.dims * listener + axis, towards[axis])
            term = _set_term(h, h_index, term, where.survey + m.dims * sender + axis, -towards[axis])
        low, high = min(sender, listener), max(sender, listener)
        if where.pair < size - 1:
            term = _set_term(h, h_index, term, where.pair + low * (2 * n - low - 1) // 2 + high - low - 1, 1.0)
    return term


@kernel
def _sender_terms(m: _Model, sender: int, size: int, h: Vector, h_index: Indices, term: int) -> int:
    """Less the sender's clock and the noise of its stamp."""
    if sender > 0:
        term = _set_term(h, h_index, term, m.dims + sender, -1.0)
    return _set_term(h, h_index, term, size - 1, -1.0)
