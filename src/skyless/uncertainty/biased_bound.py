"""Cramér–Rao bound with biases: survey, ranges and pairs of anchors are off, by amounts that nobody knows.

The recursion of ``bounds`` with more states, behind the clocks. Each has a normal prior with mean zero:

    survey      of each anchor and axis: its true position − the position that it is told to have
    constant    for each anchor, what all of the tag's ranges to it are off by
    change      for each anchor, a part of that error that changes: Gauss–Markov along time, the tag's way, or both
    slope       what ranges gain for each unit of clip((range − 4 m)/4 m, −1, 1)
    pair        for each pair of anchors, what receptions of one by the other are off by, alike both ways

Everything is linearised at the truth, and every measurement updates every state: what anchors hear of each other says
something of their places as well. For priors that are not normal this is the least mean square error of all linear
estimators. Equations: ``docs/maths.md`` section 7.
"""

import math
from typing import NamedTuple, TypeAlias

import numpy as np
from msgspec import Struct
from numpy.typing import ArrayLike

from skyless.kernels.arrays import Array
from skyless.kernels.compiled import jitted, kernel, threaded_kernel
from skyless.uncertainty.bounds import (
    DIM,
    RX,
    TX,
    BoundSettings,
    anchor_terms,
    diffuse,
    kernel_settings,
    new_packet,
    predict,
    tag_terms,
    update,
)
from skyless.uncertainty.dop import direction

PerAnchor: TypeAlias = float | tuple[float, ...]
"""One value for all anchors, or one for each."""


class Biases(Struct, frozen=True):
    """Standard deviations of what is off, in metres."""

    survey_std_m: PerAnchor = 0.0
    """Of each coordinate of an anchor that the position has (two where the height is known)."""
    constant_std_m: PerAnchor = 0.0
    changing_std_m: PerAnchor = 0.0
    slope_std_m: float = 0.0
    pair_std_m: float = 0.0
    correlation_s: float = math.inf
    """Time in which the correlation of the part that changes falls to 1/e ..."""
    correlation_m: float = math.inf
    """... and way of the tag in which it does."""


class _Places(NamedTuple):
    """Where the states of the biases begin; the TX noise is the last state, as in ``bounds``."""

    survey: int
    constant: int
    change: int
    slope: int
    pair: int


@jitted
def _places(dims: int, anchors: int) -> _Places:
    survey = 2 * dims + 2 * anchors
    constant = survey + dims * anchors
    slope = constant + 2 * anchors
    return _Places(survey, constant, constant + anchors, slope, slope + 1)


def biased_bound(anchors_m: ArrayLike, path_m: ArrayLike, settings: BoundSettings, biases: Biases) -> Array:
    """Posterior bound of the position after every superframe, shape (superframes, dims, dims), in m².

    ``anchors_m``: where the anchors truly stand, shape (n, 3), in the order of their slots, the reference first.
    ``path_m``: where the tag is at each frame, shape (superframes·n, 3).

    Raises:
        ValueError: the path has no whole number of superframes, or there is not one deviation for each anchor.
    """
    anchors = np.ascontiguousarray(anchors_m, np.float64)
    path = np.ascontiguousarray(path_m, np.float64)
    n, dims = len(anchors), 2 if settings.height_known else 3
    if len(path) % n:
        raise ValueError(f"the path has {len(path)} places, no multiple of {n} anchors")
    changing = np.square(_of_each("changing_std_m", biases.changing_std_m, n))
    P = _prior(n, dims, settings.speed_std_mps, biases)
    scratch = np.empty_like(P), np.empty(len(P)), np.empty(len(P))
    bound = np.empty((len(path) // n, dims, dims))
    fading = np.array([1.0 / biases.correlation_s, 1.0 / biases.correlation_m])
    noise = kernel_settings(settings)
    _run(anchors, path, settings.slot_s, settings.mesh, settings.at_once, noise, changing, fading, P, *scratch, bound)
    return bound


def _of_each(name: str, std_m: PerAnchor, anchors: int) -> Array:
    given = np.atleast_1d(np.asarray(std_m, np.float64))
    if len(given) not in {1, anchors}:
        raise ValueError(
            f"{name} has {len(given)} values; it should be one number, or one for each of {anchors} anchors"
        )
    return np.broadcast_to(given, anchors)


def _prior(anchors: int, dims: int, speed_std_mps: float, biases: Biases) -> Array:
    """Covariance before the first frame."""
    known = np.diag(diffuse(2 * (dims + anchors) + 1, dims, speed_std_mps))
    surveys = np.repeat(_of_each("survey_std_m", biases.survey_std_m, anchors), dims)
    constants = _of_each("constant_std_m", biases.constant_std_m, anchors)
    changes = _of_each("changing_std_m", biases.changing_std_m, anchors)
    pairs = np.full(anchors * (anchors - 1) // 2, biases.pair_std_m)
    stds = np.concatenate([surveys, constants, changes, [biases.slope_std_m], pairs])
    return np.diag(np.concatenate([known[:-1], np.square(stds), known[-1:]]))


@threaded_kernel
def _run(
    anchors: Array,
    path: Array,
    slot_s: float,
    mesh: bool,
    at_once: bool,
    settings: Array,
    changing: Array,
    fading: Array,
    P: Array,
    known: Array,
    h: Array,
    ph: Array,
    bound: Array,
) -> None:
    """Take superframe by superframe; what of the newest one has not come in yet is left out of its own bound only."""
    dims = int(settings[DIM])
    for superframe in range(len(bound)):
        if not at_once:
            known[:] = P
            _superframe(anchors, path, slot_s, mesh, False, settings, changing, fading, known, h, ph, superframe)
        _superframe(anchors, path, slot_s, mesh, True, settings, changing, fading, P, h, ph, superframe)
        bound[superframe] = P[:dims, :dims] if at_once else known[:dims, :dims]


@kernel
def _superframe(
    anchors: Array,
    path: Array,
    slot_s: float,
    mesh: bool,
    at_once: bool,
    settings: Array,
    changing: Array,
    fading: Array,
    P: Array,
    h: Array,
    ph: Array,
    superframe: int,
) -> None:
    """Take the frames of a superframe; the tag hears each of them, and so do the anchors whose stamps are relayed."""
    n, dims = len(anchors), int(settings[DIM])
    for sender in range(n):
        frame = superframe * n + sender
        place = path[frame]
        if frame > 0:
            predict(P, dims, n, slot_s, settings)
            _change(P, dims, changing, math.exp(-slot_s * fading[0] - _distance_m(path[frame - 1], place) * fading[1]))
        new_packet(P, settings[TX])
        tag_terms(h, anchors, sender, place, dims)
        _add_range_errors(h, anchors, sender, place, dims)
        update(P, h, ph, settings[RX])
        for listener in range(n):
            if listener != sender and (mesh or sender == 0) and (at_once or listener > sender):
                anchor_terms(h, sender, listener, dims)
                _add_pair_errors(h, anchors, sender, listener, dims)
                update(P, h, ph, settings[RX])


@kernel
def _distance_m(a: Array, b: Array) -> float:
    return math.sqrt((a[0] - b[0]) ** 2 + (a[1] - b[1]) ** 2 + (a[2] - b[2]) ** 2)


@kernel
def _change(P: Array, dims: int, changing: Array, kept: float) -> None:
    """Let the parts that change keep so much of themselves, and in the long run their variances."""
    n = len(changing)
    first = _places(dims, n).change
    for i in range(first, first + n):
        for column in range(len(P)):
            P[i, column] *= kept
        for row in range(len(P)):
            P[row, i] *= kept
        P[i, i] += (1.0 - kept * kept) * changing[i - first]


@kernel
def _add_range_errors(h: Array, anchors: Array, sender: int, place: Array, dims: int) -> None:
    """The tag's range also holds the anchor's displacement and all errors of ranges."""
    where, towards = _places(dims, len(anchors)), direction(anchors, sender, place)
    for axis in range(dims):
        h[where.survey + dims * sender + axis] = -towards[axis]
    h[where.constant + sender] = h[where.change + sender] = 1.0
    h[where.slope] = min(max((_distance_m(anchors[sender], place) - 4.0) / 4.0, -1.0), 1.0)


@kernel
def _add_pair_errors(h: Array, anchors: Array, sender: int, listener: int, dims: int) -> None:
    """The distance of two anchors holds the displacements of both, and what their pair is off by."""
    n = len(anchors)
    where, towards = _places(dims, n), direction(anchors, sender, anchors[listener])
    for axis in range(dims):
        h[where.survey + dims * listener + axis] = towards[axis]
        h[where.survey + dims * sender + axis] = -towards[axis]
    low, high = min(sender, listener), max(sender, listener)
    h[where.pair + low * (2 * n - low - 1) // 2 + high - low - 1] = 1.0
