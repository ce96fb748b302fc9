"""What one DTDoA of the paper depends on: clocks, flight times, the times of the messages, the noise of the stamps.

Names follow ``docs/maths.md`` section 1. Everything is in true seconds unless it says otherwise; the tag is at rest
(motion: ``uncertainty/systematic.py``). All formulas of ``printed`` and ``corrected`` are arithmetic on these
fields alone and hold element by element for many anchors; the derivation in ``tests/uncertainty`` puts symbols in.
"""

from dataclasses import dataclass

from skyless.kernels.arrays import Array


@dataclass(frozen=True, slots=True)
class Chain:
    """A master, n anchors that it synchronises with two messages, and a tag that hears two messages of each."""

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
        """ν̄_m = ν/ν_m for a tag at rest (``eq:TagSynchro``)."""
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
