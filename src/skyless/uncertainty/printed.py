"""The paper's section on uncertainties as printed: variances in s², and of λ in m².

Kept to be compared with ``corrected``, which holds the same names; ``docs/errata.md`` explains each difference. Two
misprints are read as meant, because they have no other value: ν_{i,m} in σ_ξ² as ν̄_{i,m} (E6), σ_{ν_m}² in σ_φ² as
σ_{η_m}² (E7). Some printed variances can be negative.
"""

from skyless.constants import SPEED_OF_LIGHT_MPS
from skyless.kernels.arrays import Array
from skyless.uncertainty.chain import Chain


def beta(chain: Chain) -> Array:
    """σ_β² of the relative rate, below ``eq:Synchro`` with ``eq:TauUnc``; right as printed."""
    return 2 / chain.L**2 * (chain.sigma_anchor_s**2 + chain.N**2 * chain.sigma_master_s**2)


def gamma_first(chain: Chain) -> Array:
    """σ_γ²(t̄) of the relative offset (``eq:Gamma``); erratum E1."""
    return _gamma(chain, chain.T)


def gamma_delayed(chain: Chain) -> Array:
    """σ_γ²(t̄ + D): ``eq:Gamma`` with t̄ + D for t̄, as the text says ("a similar quantity"); errata E1 and E2."""
    return _gamma(chain, chain.T + chain.L)


def _gamma(chain: Chain, reading: float) -> Array:
    own = (1 - 2 * reading / chain.L) * chain.sigma_anchor_s**2
    masters = chain.N**2 * (1 + 2 * reading / chain.L) * chain.sigma_master_s**2
    return own + masters + reading**2 * beta(chain)


def gamma_averaged(chain: Chain) -> Array:
    """σ_γ̄² of the averaged offset (``eq:AverageRelOff``); erratum E3."""
    return chain.sigma_anchor_s**2 / 2 + chain.sigma_master_s**2 / 2 + chain.T_c**2 * beta(chain)


def epsilon_first(chain: Chain) -> Array:
    """σ_ε²(t_i) of the anchor's stamp on the master's scale, below ``eq:AnchorSync``; erratum E4."""
    return _epsilon(chain, chain.X1)


def epsilon_delayed(chain: Chain) -> Array:
    """σ_ε²(t_i + Δ_i)."""
    return _epsilon(chain, chain.X2)


def _epsilon(chain: Chain, reading: Array) -> Array:
    constant = (chain.sigma_anchor_s**2 + gamma_averaged(chain)) / chain.N**2
    return constant + (reading**2 - 2 * reading * chain.T) / chain.N**2 * beta(chain)


def epsilon_covariance(chain: Chain) -> Array:
    """E[ε(t_i)·ε(t_i + Δ_i)]; erratum E5 (the bracket that is not closed is closed, e_{i,m} is missing)."""
    product = chain.X1 * (chain.X2 - chain.e) * beta(chain)
    return (product + gamma_averaged(chain) - (chain.X1 + chain.X2) * chain.T_c * beta(chain)) / chain.N**2


def xi(chain: Chain) -> Array:
    """σ_ξ²(Δ_i) of the tag's rate, below ``eq:TagSynchro``; erratum E6 is a misprint of one symbol."""
    anchors = 2 * chain.V**2 / (chain.anchor_rate**2 * chain.spacing_s**2) * chain.sigma_anchor_s**2
    tags = 2 / (chain.master_rate**2 * chain.spacing_s**2) * chain.sigma_tag_s**2
    return anchors + tags + chain.V**2 / chain.N**2 * beta(chain)


def phi(chain: Chain) -> Array:
    """σ_φ²(t_i, t_m) of the protocol interval (``eq:ProtocolInterval``); right but for what it inherits (E4, E5)."""
    first = epsilon_first(chain)
    difference = 2 * chain.V**2 * chain.G / chain.P * (first - epsilon_covariance(chain))
    return chain.V**2 * (first + chain.sigma_master_s**2) + difference + chain.G**2 * xi(chain)


def lambda_m2(chain: Chain) -> Array:
    """σ_λ²(t_i, t_m) of the DTDoA in m² (``eq:FinalTDoAUnc``); right but for what it inherits."""
    return SPEED_OF_LIGHT_MPS**2 * (2 * (1 + chain.kappa) * chain.sigma_tag_s**2 + phi(chain))
