"""Uncertainty of positions: the variances of the paper's DTDoA, and Cramér–Rao bounds.

Names follow ``docs/maths.md`` section 1. Everything is in true seconds unless stated otherwise; the tag stands still.
All formulas are arithmetic on the chain's fields alone and hold element by element for many anchors; the derivation in
``tests/research`` puts symbols in.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from msgspec import Struct
from numpy.typing import ArrayLike

from skyless.core.arrays import Array, Integers, Mask
from skyless.core.estimator.compiled import add_anchor
from skyless.core.estimator.settings import EstimatorSettings
from skyless.core.estimator.state import State, covariances, new_state
from skyless.core.estimator.steady_state import process_known
from skyless.core.native.library import compiled
from skyless.core.ticks import SPEED_OF_LIGHT_MPS, TICK_S

_process_known = compiled(process_known)


@dataclass(frozen=True, slots=True)
class Chain:
    """A master, n anchors that it synchronises with two messages, and a tag that receives two messages of each."""

    master_offset_s: float
    """o_m."""
    master_rate: float
    """ν_m."""
    tag_offset_s: float
    """o."""
    tag_rate: float
    """ν."""
    anchor_offset_s: Array
    """o_i, shape (n,)."""
    anchor_rate: Array
    """ν_i, shape (n,)."""
    anchor_tof_s: Array
    """δ_{i,m}, from the master to each anchor, shape (n,)."""
    tag_tof_s: Array
    """δ_i, from each anchor to the tag, shape (n,)."""
    tag_master_tof_s: float
    """δ_m, from the master to the tag."""
    sync_s: float
    """t̄, the first synchronisation message."""
    sync_spacing_s: float
    """D, from there to the second one (the paper: Δ_{i,m})."""
    reference_s: float
    """t_m, the master's message that the TDoAs refer to; at the time of a synchronisation message it is that one."""
    delay_s: Array
    """Δ_im = t_i − t_m, the protocol interval, shape (n,) (the paper: also Δ_{i,m}; erratum E8)."""
    spacing_s: Array
    """Δ_i, between each anchor's two messages, shape (n,)."""
    sigma_master_s: float
    """σ_{η_m}, of every stamp of the master."""
    sigma_anchor_s: float
    """σ_{η_i}, of every stamp of the anchors."""
    sigma_tag_s: float
    """σ_η, of every stamp of the tag."""

    @property
    def T(self) -> float:
        """τ^m(t̄), the master's reading at the first synchronisation message."""
        return self.master_offset_s + self.master_rate * self.sync_s

    @property
    def L(self) -> float:
        """ν_m·D, the spacing of the synchronisation messages on the master's clock."""
        return self.master_rate * self.sync_spacing_s

    @property
    def T_c(self) -> float:
        """τ^m(t̄ + D/2), the middle of the synchronisation."""
        return self.T + self.L / 2

    @property
    def N(self) -> Array:
        """ν̄_{i,m} = ν_i/ν_m (``eq:Synchro``)."""
        return self.anchor_rate / self.master_rate

    @property
    def V(self) -> float:
        """ν̄_m = ν/ν_m for a stationary tag (``eq:TagSynchro``)."""
        return self.tag_rate / self.master_rate

    @property
    def S(self) -> Array:
        """σ_i² + N²σ_m²."""
        return self.sigma_anchor_s**2 + self.N**2 * self.sigma_master_s**2

    @property
    def e(self) -> Array:
        """e_{i,m} = (1 − ν_i)·δ_{i,m}/N, what the synchronisation leaves (``eq:AnchorSync``)."""
        return (1 - self.anchor_rate) * self.anchor_tof_s / self.N

    @property
    def P(self) -> Array:
        """ν_m·Δ_i."""
        return self.master_rate * self.spacing_s

    @property
    def G(self) -> Array:
        """ν_m·Δ_im + e."""
        return self.master_rate * self.delay_s + self.e

    @property
    def kappa(self) -> Array:
        """κ = G/P."""
        return self.G / self.P

    @property
    def X1(self) -> Array:
        """τ^m(t_i) + e, the anchor's first stamp on the master's scale."""
        return self.master_offset_s + self.master_rate * (self.reference_s + self.delay_s) + self.e

    @property
    def X2(self) -> Array:
        """τ^m(t_i + Δ_i) + e, its second one."""
        return self.X1 + self.P


class Variances:
    """The paper's section on uncertainties: variances in s², and of λ in m².

    What is printed right stands here. ``CORRECTED`` follows from the paper's own algorithm
    (``core/protocol1/snapshots.py``) by linearising it; ``tests/research/test_paper_derivation.py`` does that
    with symbols, and Monte Carlo draws of the algorithm as it is agree (``tests/research/test_paper_checks.py``). The
    reference packet is taken to be no synchronisation packet, as in the paper.
    ``PRINTED`` is kept to be compared with it; ``docs/errata.md`` explains each difference.
    """

    def beta(self, chain: Chain) -> Array:
        """σ_β² of the relative rate, below ``eq:Synchro`` with ``eq:TauUnc``; right as printed."""
        return 2 * chain.S / chain.L**2

    def gamma_first(self, chain: Chain) -> Array:
        """σ_γ²(t̄) of the relative offset (``eq:Gamma``); erratum E1."""
        return chain.S * (1 + 2 * chain.T / chain.L) + chain.T**2 * self.beta(chain)

    def gamma_delayed(self, chain: Chain) -> Array:
        """σ_γ²(t̄ + D): the same, because both offsets are equal for any noise (erratum E2)."""
        return self.gamma_first(chain)

    def gamma_averaged(self, chain: Chain) -> Array:
        """σ_γ̄² of the averaged offset (``eq:AverageRelOff``), equal to both others; errata E2 and E3."""
        return chain.S / 2 + chain.T_c**2 * self.beta(chain)

    def epsilon_first(self, chain: Chain) -> Array:
        """σ_ε²(t_i) of the anchor's stamp on the master's scale, below ``eq:AnchorSync``; erratum E4."""
        return self._epsilon(chain, chain.X1)

    def epsilon_delayed(self, chain: Chain) -> Array:
        """σ_ε²(t_i + Δ_i)."""
        return self._epsilon(chain, chain.X2)

    def _epsilon(self, chain: Chain, reading: Array) -> Array:
        rate_part = (reading - chain.T_c) ** 2 * self.beta(chain)
        return (chain.sigma_anchor_s**2 + chain.S / 2 + rate_part) / chain.N**2

    def epsilon_covariance(self, chain: Chain) -> Array:
        """E[ε(t_i)·ε(t_i + Δ_i)]; erratum E5."""
        return (chain.S / 2 + (chain.X1 - chain.T_c) * (chain.X2 - chain.T_c) * self.beta(chain)) / chain.N**2

    def xi(self, chain: Chain) -> Array:
        """σ_ξ²(Δ_i) of the tag's rate, below ``eq:TagSynchro``; erratum E6 is a misprint: ν̄_{i,m} is meant."""
        anchors = 2 * chain.V**2 * chain.sigma_anchor_s**2 / (chain.N**2 * chain.P**2)
        return anchors + 2 * chain.sigma_tag_s**2 / chain.P**2 + chain.V**2 / chain.N**2 * self.beta(chain)

    def phi(self, chain: Chain) -> Array:
        """σ_φ²(t_i, t_m) of the protocol interval (``eq:ProtocolInterval``); E7 is a misprint: σ_{η_m}² is meant."""
        first = self.epsilon_first(chain)
        difference = 2 * chain.V**2 * chain.kappa * (first - self.epsilon_covariance(chain))
        return chain.V**2 * (first + chain.sigma_master_s**2) + difference + chain.G**2 * self.xi(chain)

    def lambda_m2(self, chain: Chain) -> Array:
        """σ_λ²(t_i, t_m) of the DTDoA in m² (``eq:FinalTDoAUnc``)."""
        return SPEED_OF_LIGHT_MPS**2 * (2 * (1 + chain.kappa) * chain.sigma_tag_s**2 + self.phi(chain))


class PrintedVariances(Variances):
    """The variances as printed, where they differ; some can be negative."""

    def gamma_first(self, chain: Chain) -> Array:
        """``eq:Gamma``; erratum E1."""
        return self._gamma(chain, chain.T)

    def gamma_delayed(self, chain: Chain) -> Array:
        """``eq:Gamma`` with t̄ + D for t̄, as the text has it ("a similar quantity"); errata E1 and E2."""
        return self._gamma(chain, chain.T + chain.L)

    def _gamma(self, chain: Chain, reading: float) -> Array:
        own = (1 - 2 * reading / chain.L) * chain.sigma_anchor_s**2
        masters = chain.N**2 * (1 + 2 * reading / chain.L) * chain.sigma_master_s**2
        return own + masters + reading**2 * self.beta(chain)

    def gamma_averaged(self, chain: Chain) -> Array:
        """Erratum E3."""
        return chain.sigma_anchor_s**2 / 2 + chain.sigma_master_s**2 / 2 + chain.T_c**2 * self.beta(chain)

    def _epsilon(self, chain: Chain, reading: Array) -> Array:
        """Erratum E4."""
        constant = (chain.sigma_anchor_s**2 + self.gamma_averaged(chain)) / chain.N**2
        return constant + (reading**2 - 2 * reading * chain.T) / chain.N**2 * self.beta(chain)

    def epsilon_covariance(self, chain: Chain) -> Array:
        """Erratum E5 (the bracket that is not closed is closed, e_{i,m} is missing)."""
        product = chain.X1 * (chain.X2 - chain.e) * self.beta(chain)
        rest = (chain.X1 + chain.X2) * chain.T_c * self.beta(chain)
        return (product + self.gamma_averaged(chain) - rest) / chain.N**2


CORRECTED: Final = Variances()
PRINTED: Final = PrintedVariances()


# Cramér–Rao bounds: the least error that any unbiased estimator can have with the stamps of a schedule.
#
# With Gaussian noise the (posterior) bound is the covariance of a filter that is linearised at the truth: the
# estimator's own steps with the tag at its true position and innovations of zero. Relayed receptions count without
# age, and with what they say of the survey, both of which the estimator approximates. Phases of the carrier count
# with their cycles known; the ambiguity of each anchor is a real number, of which nothing is known before.
# Equations: ``docs/maths.md`` section 7.

# What is known before the first frame, almost nothing: 30 m, 33 µs, ±10 ppm.
POSITION_STD_M: Final = 30.0
OFFSET_STD_M: Final = 1e4
RATE_STD_MPS: Final = 10e-6 * SPEED_OF_LIGHT_MPS


class Biases(Struct, frozen=True):
    """Standard deviations of unknown errors, in metres; each has a normal prior with mean zero.

    They are states behind the clocks, and every measurement updates all of them: what anchors receive of each other
    informs about their positions as well. For priors that are not normal the bound is the least mean square error
    of all linear estimators.
    """

    survey_std_m: float = 0.0
    """True less configured, of each coordinate of an anchor that the position has (two where the height is known)."""
    constant_std_m: float = 0.0
    """Constant error of the tag's ranges to an anchor."""
    changing_std_m: float = 0.0
    """Part of that error that changes: Gauss–Markov along time, the tag's path, or both."""
    slope_std_m: float = 0.0
    """What ranges gain for each unit of clip((range − 4 m)/4 m, −1, 1)."""
    correlation_s: float = math.inf
    """Time in which the correlation of the part that changes falls to 1/e."""
    correlation_m: float = math.inf
    """Distance walked by the tag in which it does."""


class BoundSettings(Struct, frozen=True):
    """A schedule of one frame per anchor and superframe, and the noise."""

    stamp_s: float
    """Noise of every stamp, TX and RX alike."""
    white_fm: float
    """White frequency noise of each oscillator, σ_y(1 s)."""
    random_walk_fm: float
    """Random walk of each oscillator's frequency, 1/√s."""
    qa: float
    """Spectral density of the acceleration, m²/s³ per axis."""
    slot_s: float
    speed_std_mps: float
    """Each component of the velocity, before the first frame."""
    mesh: bool
    """Whether anchors also relay when they received each other, not only the first anchor."""
    height_known: bool = True
    at_once: bool = True
    """Whether anchors' receptions are known at once; else each comes with the listener's next frame, as on the air."""
    phase_std_m: float = math.inf
    """Noise of the carrier's phase, one for each reception of the tag; infinite where it measures none."""
    phase_wander: float = 0.0
    """What reflections change in the phases of an anchor as the tag walks, m²/m."""

    def model(self, biases: Biases = Biases()) -> EstimatorSettings:  # noqa: B008 - a frozen value
        """Settings of an estimator whose model is that of the bound."""
        light2 = SPEED_OF_LIGHT_MPS**2
        stamp = light2 * self.stamp_s**2
        return EstimatorSettings(
            qa=self.qa,
            white=light2 * self.white_fm**2,
            walk=light2 * self.random_walk_fm**2,
            tx_variance_m2=stamp,
            rx_variance_m2=stamp,
            height_m=0.0 if self.height_known else None,
            survey_std_m=biases.survey_std_m,
            range_std_m=biases.constant_std_m,
            slope_std_m=biases.slope_std_m,
            place_std_m=biases.changing_std_m,
            place_time_s=biases.correlation_s,
            place_distance_m=biases.correlation_m,
            phase_wander=self.phase_wander,
        )


def tracking_bound(
    anchors_m: ArrayLike,
    path_m: ArrayLike,
    settings: BoundSettings,
    biases: Biases = Biases(),  # noqa: B008 - a frozen value
) -> Array:
    """Posterior bound of the position after every superframe, shape (superframes, dims, dims), in m².

    ``anchors_m``: true positions, shape (n, 3), in the order of their slots, the reference first. ``path_m``: where the
    tag is at each frame, shape (superframes·n, 3).

    Raises ValueError: the path has no whole number of superframes.
    """
    anchors, path = np.asarray(anchors_m, np.float64), np.asarray(path_m, np.float64)
    n, frames = len(anchors), len(path)
    if frames % n:
        raise ValueError(f"the path has {frames} positions, no multiple of {n} anchors")
    senders = np.arange(frames) % n
    known = np.ones((frames, n + 1), np.bool_)
    known[:, :-1] = settings.mesh | (senders == 0)[:, None]
    known[np.arange(frames), senders] = False
    return received_bound(anchors, path, settings, known, None, biases, at_once=settings.at_once)[n - 1 :: n]


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
    biases: Biases = Biases(),  # noqa: B008 - a frozen value
    *,
    at_once: bool = True,
) -> Array:
    """Posterior bound of the position after every frame, shape (frames, dims, dims), in m², where frames are lost.

    ``anchors_m``: shape (n, 3), in the order of their slots, the reference first. ``path_m``: where the tag is at each
    frame, shape (frames, 3). ``known``: as of ``relayed_receptions``, shape (frames, n + 1); it, not the settings,
    states what of the mesh is known. ``sendings``: who sends when, if not one anchor after the other in equal slots.
    Where receptions are not known ``at_once`` the bound holds at the end of a superframe.

    Raises ValueError: there is not one row of ``known`` and one sending for each position.
    """
    anchors, path = np.asarray(anchors_m, np.float64), np.asarray(path_m, np.float64)
    n, frames = len(anchors), len(path)
    if known.shape != (frames, n + 1):
        raise ValueError(f"known has shape {known.shape}; it should be {(frames, n + 1)}")
    if sendings is None:
        sendings = Sendings(np.arange(frames) % n, settings.slot_s * np.arange(frames, dtype=np.float64))
    if not len(sendings.senders) == len(sendings.times_s) == frames:
        raise ValueError(f"sendings has {len(sendings.senders)} frames; it should be {frames}")
    s = _prior(anchors, settings, biases)
    dim, senders = s.dim, sendings.senders.tolist()
    ticks = np.rint(sendings.times_s / TICK_S).astype(np.int64).tolist()
    walked_m = np.cumsum(np.linalg.norm(np.diff(path, axis=0, prepend=path[:1]), axis=1)).tolist()
    s.status.epoch_ticks = ticks[0]
    path, heard = np.ascontiguousarray(path), np.ascontiguousarray(known, np.uint8)
    bound = np.empty((len(path), dim, dim))

    def process(state: State, frame: int, first: int, newest: list[int]) -> None:
        sender = senders[frame]
        before = newest[sender]
        elapsed_s, way_m = (ticks[frame] - ticks[before]) * TICK_S, walked_m[frame] - walked_m[before]
        _process_known(state, sender, ticks[frame], path[frame], heard[frame], first, elapsed_s, way_m)
        if known[frame, n]:
            newest[sender] = frame

    newest, present = [0] * n, State.from_buffer_copy(s)
    all_of_it, P, P_present = memoryview(s).cast("B"), covariances(s)[:dim, :dim], covariances(present)[:dim, :dim]
    for frame in range(len(path)):
        if not at_once and frame % n == 0:  # without what anchors whose turn is earlier relay in the next superframe
            memoryview(present).cast("B")[:] = all_of_it
            newest_present = list(newest)
            for own in range(frame, frame + n):
                process(present, own, senders[own] + 1, newest_present)
                bound[own] = P_present
        process(s, frame, 0, newest)
        if at_once:
            bound[frame] = P
    return bound


def relayed_receptions(
    senders: Integers, sequences: Integers, relays: Sequence[Iterable[tuple[int, int]]], anchors: int
) -> Mask:
    """Which anchors' receptions of each beacon another beacon has relayed to the tag, shape (frames, anchors + 1).

    The frames are those that the tag has received, which its own column, the last, says. ``senders``: index of each
    frame's anchor; ``relays``: of each frame, anchor and sequence number of the beacons whose reception it relays.
    """
    known = np.zeros((len(senders), anchors + 1), np.bool_)
    known[:, -1] = True
    newest: dict[tuple[int, int], int] = {}
    for frame, (listener, sequence) in enumerate(zip(senders.tolist(), sequences.tolist(), strict=True)):
        for beacon in relays[frame]:
            if beacon in newest:
                known[newest[beacon], listener] = True
        newest[listener, sequence] = frame
    return known


def _prior(anchors: Array, settings: BoundSettings, biases: Biases) -> State:
    """State before the first frame, with clocks known to ``OFFSET_STD_M`` and ``RATE_STD_MPS`` of the first anchor's.

    Its offsets are the tag's clock against each anchor's, so that the tag's own prior is in all of them.
    """
    s, n = new_state(settings.model(biases)), len(anchors)
    s.status.walk_scale = 1.0
    s.status.has_phases, s.status.phase_variance_m2 = math.isfinite(settings.phase_std_m), settings.phase_std_m**2
    s.tuning.phase_walking_mps = math.inf  # no cycle is ever uncertain
    for row, position_m in enumerate(anchors):
        add_anchor(s, row, position_m, -1.0, False)
    s.rows = 0  # nothing is asked of faults
    dim, where, P = s.dim, s.layout, covariances(s)
    for first, std in ((0, POSITION_STD_M), (where.velocity, settings.speed_std_mps)):
        P[first : first + dim, first : first + dim] = std**2 * np.eye(dim)
    shared = 1.0 + np.diag([0.0] + [1.0] * (n - 1))
    for first, std in ((where.offset, OFFSET_STD_M), (where.rate, RATE_STD_MPS)):
        P[first : first + n, first : first + n] = std**2 * shared
    return s
