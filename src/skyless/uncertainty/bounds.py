"""Cramér–Rao bounds: the least error that any unbiased estimator can have with the stamps of a schedule.

With Gaussian noise the (posterior) bound is the covariance of a filter that is linearised at the truth. Its states, in
metres and m/s of light, are the tag's position p, velocity v and clock (b, f), and the clock (x_i, f_i) of every anchor
but the first, all clocks against the first anchor's. Each frame brings a state of its own for the noise of its TX
stamp, which everyone who hears the frame shares. The first anchor's oscillator is in all clock differences, so their
process noise is q·(I + 11ᵀ).
"""

from typing import Final

import numpy as np
from msgspec import Struct
from numpy.typing import ArrayLike

from skyless.constants import SPEED_OF_LIGHT_MPS
from skyless.kernels.arrays import Array
from skyless.kernels.compiled import kernel, threaded_kernel
from skyless.uncertainty.dop import direction

POSITION_STD_M: Final = 30.0
OFFSET_STD_M: Final = 1e4
RATE_STD_MPS: Final = 10e-6 * SPEED_OF_LIGHT_MPS
"""What is known before the first frame, next to nothing: 30 m, 33 µs, ±10 ppm."""

QA, WHITE, WALK, TX, RX, DIM = range(6)
"""Places of the kernels' settings."""


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
    """Whether anchors also relay when they heard each other, not only the first anchor."""
    height_known: bool = True
    at_once: bool = True
    """Whether anchors' receptions are known at once; else each comes with the listener's next frame, as on the air."""


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


def tracking_bound(anchors_m: ArrayLike, path_m: ArrayLike, settings: BoundSettings) -> Array:
    """Posterior bound of the position after every superframe, shape (superframes, dims, dims), in m².

    ``anchors_m``: shape (n, 3), in the order of their slots, the reference first. ``path_m``: where the tag is at each
    frame, shape (superframes·n, 3).

    Raises:
        ValueError: the path has no whole number of superframes.
    """
    anchors = np.ascontiguousarray(anchors_m, np.float64)
    path = np.ascontiguousarray(path_m, np.float64)
    if len(path) % len(anchors):
        raise ValueError(f"the path has {len(path)} places, no multiple of {len(anchors)} anchors")
    dims = 2 if settings.height_known else 3
    bound = np.empty((len(path) // len(anchors), dims, dims))
    size = 2 * dims + 2 * len(anchors) + 1
    array = kernel_settings(settings)
    P = diffuse(size, dims, settings.speed_std_mps)
    scratch = np.empty_like(P), np.empty(size), np.empty(size)
    _run(anchors, path, settings.slot_s, settings.mesh, settings.at_once, array, P, *scratch, bound)
    return bound


def kernel_settings(settings: BoundSettings) -> Array:
    """The settings as the kernels take them."""
    noise = (settings.qa, settings.white, settings.walk, settings.tx_variance_m2, settings.rx_variance_m2)
    return np.array([*noise, 2 if settings.height_known else 3])


def diffuse(size: int, dims: int, speed_std_mps: float) -> Array:
    """Covariance before the first frame: [p, v, offsets and rates of the tag and all anchors but one, TX noise]."""
    clocks = (size - 1 - 2 * dims) // 2
    clock = [OFFSET_STD_M, RATE_STD_MPS] * clocks
    return np.diag(np.square([*[POSITION_STD_M] * dims, *[speed_std_mps] * dims, *clock, 0.0]))


@threaded_kernel
def _run(
    anchors: Array,
    path: Array,
    slot_s: float,
    mesh: bool,
    at_once: bool,
    settings: Array,
    P: Array,
    known: Array,
    h: Array,
    ph: Array,
    bound: Array,
) -> None:
    """Take superframe by superframe; what of the newest one has not come in yet is left out of its own bound only.

    A frame's reception by an anchor whose turn is earlier in the superframe comes with the next superframe.
    """
    dims, n = int(settings[DIM]), len(anchors)
    for superframe in range(len(path) // n):
        if not at_once:
            known[:] = P
            _superframe(anchors, path, slot_s, mesh, False, settings, known, h, ph, superframe)
        _superframe(anchors, path, slot_s, mesh, True, settings, P, h, ph, superframe)
        bound[superframe] = P[:dims, :dims] if at_once else known[:dims, :dims]


@kernel
def _superframe(
    anchors: Array,
    path: Array,
    slot_s: float,
    mesh: bool,
    at_once: bool,
    settings: Array,
    P: Array,
    h: Array,
    ph: Array,
    superframe: int,
) -> None:
    """Take the frames of a superframe; the tag hears each of them, and so do the anchors whose stamps are relayed."""
    n, dims = len(anchors), int(settings[DIM])
    for sender in range(n):
        frame = superframe * n + sender
        if frame > 0:
            predict(P, dims, n, slot_s, settings)
        new_packet(P, settings[TX])
        hear_by_tag(P, h, ph, anchors, sender, path[frame], dims, settings[RX])
        for listener in range(n):
            if listener != sender and (mesh or sender == 0) and (at_once or listener > sender):
                hear_by_anchor(P, h, ph, sender, listener, dims, settings[RX])


@kernel
def predict(P: Array, dims: int, clocks: int, dt_s: float, settings: Array) -> None:
    """Advance by ``dt_s``: constant velocity, and clocks whose differences all hold the first anchor's oscillator.

    ``clocks``: how many clocks are states. What stands behind them stays as it is.
    """
    behind = 2 * (dims + clocks)
    for axis in range(dims):
        _advance(P, axis, dims + axis, dt_s)
        _add_noise(P, axis, dims + axis, axis, dims + axis, dt_s, 0.0, settings[QA])
    for i in range(2 * dims, behind, 2):
        _advance(P, i, i + 1, dt_s)
    for i in range(2 * dims, behind, 2):
        for j in range(2 * dims, behind, 2):
            share = 2.0 if i == j else 1.0
            _add_noise(P, i, i + 1, j, j + 1, dt_s, share * settings[WHITE], share * settings[WALK])


@kernel
def _advance(P: Array, i: int, j: int, dt_s: float) -> None:
    """State i gains dt·(state j)."""
    for column in range(len(P)):
        P[i, column] += dt_s * P[j, column]
    for row in range(len(P)):
        P[row, i] += dt_s * P[row, j]


@kernel
def _add_noise(P: Array, a: int, a_rate: int, b: int, b_rate: int, dt_s: float, white: float, walk: float) -> None:
    """Add the covariance of the noise that two pairs (value, rate) collect in common."""
    P[a, b] += white * dt_s + walk * dt_s**3 / 3.0
    P[a, b_rate] += walk * dt_s**2 / 2.0
    P[a_rate, b] += walk * dt_s**2 / 2.0
    P[a_rate, b_rate] += walk * dt_s


@kernel
def new_packet(P: Array, variance: float) -> None:
    """Forget the last frame's TX noise, the last state, for that of a new one."""
    last = len(P) - 1
    P[last, :] = 0.0
    P[:, last] = 0.0
    P[last, last] = variance


@kernel
def hear_by_tag(
    P: Array, h: Array, ph: Array, anchors: Array, sender: int, place: Array, dims: int, variance: float
) -> None:
    """The tag's stamp less the frame's: range, its clock, less the sender's clock, less the TX noise."""
    tag_terms(h, anchors, sender, place, dims)
    update(P, h, ph, variance)


@kernel
def tag_terms(h: Array, anchors: Array, sender: int, place: Array, dims: int) -> None:
    """Put that measurement into ``h``."""
    h[:] = 0.0
    towards = direction(anchors, sender, place)
    for axis in range(dims):
        h[axis] = towards[axis]
    h[2 * dims] = 1.0
    _subtract_sender(h, sender, dims)


@kernel
def hear_by_anchor(P: Array, h: Array, ph: Array, sender: int, listener: int, dims: int, variance: float) -> None:
    """An anchor's stamp less the frame's; the distance is known."""
    anchor_terms(h, sender, listener, dims)
    update(P, h, ph, variance)


@kernel
def anchor_terms(h: Array, sender: int, listener: int, dims: int) -> None:
    """Put that measurement into ``h``."""
    h[:] = 0.0
    if listener > 0:
        h[2 * dims + 2 * listener] = 1.0
    _subtract_sender(h, sender, dims)


@kernel
def _subtract_sender(h: Array, sender: int, dims: int) -> None:
    if sender > 0:
        h[2 * dims + 2 * sender] -= 1.0
    h[len(h) - 1] = -1.0


@kernel
def update(P: Array, h: Array, ph: Array, variance: float) -> None:
    """What a scalar measurement h with this variance leaves of the covariance."""
    n = len(P)
    ph[:] = 0.0
    for column in range(n):
        if h[column] != 0.0:
            for row in range(n):
                ph[row] += P[column, row] * h[column]
    spread = variance
    for row in range(n):
        spread += h[row] * ph[row]
    for row in range(n):
        gain = ph[row] / spread
        for column in range(row, n):
            P[row, column] -= gain * ph[column]
            P[column, row] = P[row, column]
