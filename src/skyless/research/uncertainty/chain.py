"""One DTDoA of the paper: what it depends on, the covariance of several, and its variances as printed and corrected.

Names follow ``docs/maths.md`` section 1. Everything is in true seconds unless stated otherwise; the tag stands still.
All formulas are arithmetic on the chain's fields alone and hold element by element for many anchors; the derivation in
``tests/uncertainty`` puts symbols in.
"""

from dataclasses import dataclass
from enum import StrEnum
from typing import Final

import numpy as np

from skyless.core.arrays import Array, Matrix
from skyless.core.ticks import SPEED_OF_LIGHT_MPS


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
    """t_m, the master's message that the TDoAs refer to."""
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
    def Q(self) -> Array:
        """(1 + κ)² + κ²."""
        return (1 + self.kappa) ** 2 + self.kappa**2

    @property
    def X1(self) -> Array:
        """τ^m(t_i) + e, the anchor's first stamp on the master's scale."""
        return self.master_offset_s + self.master_rate * (self.reference_s + self.delay_s) + self.e

    @property
    def X2(self) -> Array:
        """τ^m(t_i + Δ_i) + e, its second one."""
        return self.X1 + self.P

    @property
    def u(self) -> float:
        """τ^m(t_m) − T_c, the reference packet from the middle of the synchronisation."""
        return self.master_offset_s + self.master_rate * self.reference_s - self.T_c


class Reference(StrEnum):
    """Which packet of the master the TDoAs refer to (t_m), as far as it matters."""

    APART = "apart"
    """None of the synchronisation packets: the paper's assumption."""
    FIRST_SYNC = "first-sync"
    SECOND_SYNC = "second-sync"


def chain_covariance(chain: Chain, reference: Reference) -> Matrix:
    """Covariance of the paper's TDoAs (``eq:GPSTDoA``) of n anchors, shape (n, n), first order in the noise.

    The tag's stamp of the reference packet is common to all, and so are the master's stamps: with weights w1 and w2
    those of the synchronisation, and with one that of the reference packet. If that is one of the two, its weights
    cancel and the master's noise is gone, with the rate error β. ``chain.reference_s`` must be the time of that packet.

    Raises:
        ValueError: it is not.
    """
    expected_s = {Reference.FIRST_SYNC: chain.sync_s, Reference.SECOND_SYNC: chain.sync_s + chain.sync_spacing_s}
    if reference in expected_s and chain.reference_s != expected_s[reference]:
        raise ValueError(f"reference_s is {chain.reference_s}, the {reference} packet is at {expected_s[reference]}")
    w1, w2 = 0.5 - chain.u / chain.L, 0.5 + chain.u / chain.L
    masters = 1.0 + w1**2 + w2**2 if reference is Reference.APART else 0.0
    common = chain.sigma_tag_s**2 + chain.V**2 * chain.sigma_master_s**2 * masters
    anchors = (chain.V / chain.N) ** 2 * chain.sigma_anchor_s**2 * (chain.Q + w1**2 + w2**2)
    covariance: Matrix = np.diag(chain.Q * chain.sigma_tag_s**2 + anchors) + common
    return SPEED_OF_LIGHT_MPS**2 * covariance


class Variances:
    """The paper's section on uncertainties: variances in s², and of λ in m².

    What is printed right stands here. ``CORRECTED`` follows from the paper's own algorithm
    (``positioning/methods/snapshots.py``) by linearising it; ``tests/uncertainty/test_paper_derivation.py`` does that
    with symbols, and Monte Carlo draws of the algorithm as it is agree (``tests/paper/test_paper_checks.py``). The
    reference packet is taken to be no synchronisation packet, as in the paper; the other cases: ``chain_covariance``.
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
    """What is printed otherwise; some of these variances can be negative."""

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
