"""The paper's section on uncertainties, corrected: variances in s², and of λ in m².

The same names as in ``printed``. Each follows from the paper's own algorithm (``clocks/paper.py``,
``positioning/solver/paper.py``) by linearising it; ``tests/uncertainty/test_paper_derivation.py`` does that with
symbols, and Monte Carlo draws of the algorithm as it is agree (``tests/paper/test_paper_checks.py``). The reference
packet is taken to be no synchronisation packet, as in the paper; the other cases: ``uncertainty/tdoa.py``.
"""

from skyless.constants import SPEED_OF_LIGHT_MPS
from skyless.kernels.arrays import Array
from skyless.uncertainty.chain import Chain


def beta(chain: Chain) -> Array:
    """σ_β² of the relative rate, below ``eq:Synchro`` with ``eq:TauUnc``."""
    return 2 * chain.S / chain.L**2


def gamma_first(chain: Chain) -> Array:
    """σ_γ²(t̄) of the relative offset (``eq:Gamma``); erratum E1."""
    return chain.S * (1 + 2 * chain.T / chain.L) + chain.T**2 * beta(chain)


def gamma_delayed(chain: Chain) -> Array:
    """σ_γ²(t̄ + D): the same, because both offsets are equal for any noise (erratum E2)."""
    return gamma_first(chain)


def gamma_averaged(chain: Chain) -> Array:
    """σ_γ̄² of the averaged offset (``eq:AverageRelOff``), equal to both others; errata E2 and E3."""
    return chain.S / 2 + chain.T_c**2 * beta(chain)


def epsilon_first(chain: Chain) -> Array:
    """σ_ε²(t_i) of the anchor's stamp on the master's scale, below ``eq:AnchorSync``; erratum E4."""
    return _epsilon(chain, chain.X1)


def epsilon_delayed(chain: Chain) -> Array:
    """σ_ε²(t_i + Δ_i)."""
    return _epsilon(chain, chain.X2)


def _epsilon(chain: Chain, reading: Array) -> Array:
    spread = (reading - chain.T_c) ** 2 * beta(chain)
    return (chain.sigma_anchor_s**2 + chain.S / 2 + spread) / chain.N**2


def epsilon_covariance(chain: Chain) -> Array:
    """E[ε(t_i)·ε(t_i + Δ_i)]; erratum E5."""
    return (chain.S / 2 + (chain.X1 - chain.T_c) * (chain.X2 - chain.T_c) * beta(chain)) / chain.N**2


def xi(chain: Chain) -> Array:
    """σ_ξ²(Δ_i) of the tag's rate, below ``eq:TagSynchro``; erratum E6."""
    anchors = 2 * chain.V**2 * chain.sigma_anchor_s**2 / (chain.N**2 * chain.P**2)
    return anchors + 2 * chain.sigma_tag_s**2 / chain.P**2 + chain.V**2 / chain.N**2 * beta(chain)


def phi(chain: Chain) -> Array:
    """σ_φ²(t_i, t_m) of the protocol interval (``eq:ProtocolInterval``); erratum E7."""
    first = epsilon_first(chain)
    difference = 2 * chain.V**2 * chain.kappa * (first - epsilon_covariance(chain))
    return chain.V**2 * (first + chain.sigma_master_s**2) + difference + chain.G**2 * xi(chain)


def lambda_m2(chain: Chain) -> Array:
    """σ_λ²(t_i, t_m) of the DTDoA in m² (``eq:FinalTDoAUnc``)."""
    return SPEED_OF_LIGHT_MPS**2 * (2 * (1 + chain.kappa) * chain.sigma_tag_s**2 + phi(chain))


def lambda_compact_m2(chain: Chain) -> Array:
    """σ_λ² in m² again, free of the origin of time: what of which stamp remains (``docs/maths.md`` section 2)."""
    tag = (chain.Q + 1) * chain.sigma_tag_s**2 + chain.V**2 * chain.sigma_master_s**2
    anchor = (chain.Q + 0.5) * chain.sigma_anchor_s**2 + chain.N**2 * chain.sigma_master_s**2 / 2
    return SPEED_OF_LIGHT_MPS**2 * (tag + (chain.V / chain.N) ** 2 * (anchor + chain.u**2 * beta(chain)))
