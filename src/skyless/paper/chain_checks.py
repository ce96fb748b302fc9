"""The check of the paper's uncertainty analysis: printed and corrected deviations against Monte Carlo draws."""

import math
from collections.abc import Callable, Iterator
from typing import Final

import numpy as np
from msgspec import Struct

from skyless.constants import SPEED_OF_LIGHT_MPS, TICK_S
from skyless.kernels.arrays import Array, Integers
from skyless.paper.monte_carlo import ChainMoments, Quantity, draw_lambdas, draw_moments
from skyless.uncertainty import corrected, printed
from skyless.uncertainty.chain import Chain

QUANTITIES: Final = ("beta", "gamma_first", "gamma_delayed", "gamma_averaged", "epsilon", "xi", "phi", "lambda")
"""β, γ(t̄), γ(t̄+D), γ̄, ε(t_i), ξ, φ, λ, in the order in which the paper derives them."""

NOISES: Final = ("gaussian", "uniform")

ANCHORS: Final = 10
"""As many as in the paper's numerical analysis."""

SIGMAS_S: Final = {"gaussian": TICK_S / 3.0, "uniform": TICK_S / 3.0**0.5}
"""Of every stamp: "plus/minus 15.65 ps" read as three sigma, or as the half width of the uniform noise."""

_ROWS: Final = {
    "beta": (Quantity.BETA, printed.beta, corrected.beta),
    "gamma_first": (Quantity.GAMMA_FIRST, printed.gamma_first, corrected.gamma_first),
    "gamma_delayed": (Quantity.GAMMA_DELAYED, printed.gamma_delayed, corrected.gamma_delayed),
    "gamma_averaged": (Quantity.GAMMA_AVERAGED, printed.gamma_averaged, corrected.gamma_averaged),
    "epsilon": (Quantity.EPSILON_FIRST, printed.epsilon_first, corrected.epsilon_first),
    "xi": (Quantity.XI, printed.xi, corrected.xi),
    "phi": (Quantity.PHI, printed.phi, corrected.phi),
    "lambda": (Quantity.LAMBDA, printed.lambda_m2, corrected.lambda_m2),
}

_REACH_SIGMAS: Final = 5.0


class PaperCheck(Struct, frozen=True):
    """One standard deviation as printed and as corrected, against that of the draws."""

    name: str
    """``"<noise>/<quantity>/anchor <number>"``, for example ``"gaussian/gamma_first/anchor 3"``."""
    noise: str
    quantity: str
    anchor: int
    """1 to 10."""
    printed_error_pct: float | None
    """100·|printed − drawn| / drawn, as the paper defines it; None where the printed variance is negative."""
    corrected_error_pct: float
    standard_error_pct: float
    """Standard error of the drawn deviation."""
    mean_error_sigmas: float
    """Mean of the draws (zero in theory) over its standard error."""
    draws: int


class LambdaDistribution(Struct, frozen=True):
    """Histogram of the error λ of one DTDoA (``eq:FinalTDoAUnc``), anchor 1."""

    noise: str
    edges_m: Array
    """Shape (bins + 1,), to five sigma on both sides; the one draw in two million beyond is not counted."""
    counts: Integers
    """Shape (bins,)."""
    std_m: float
    """Of the draws."""
    corrected_std_m: float
    printed_std_m: float | None
    draws: int


def paper_chain(seed: int, anchor: int, noise: str, *, origin_s: float | None = None) -> Chain:
    """Random chain of anchor 1 to 10: offsets, rates, positions and delays, as in the paper's numerical analysis.

    Rates within ±20 ppm, distances of 1 to 12 m, synchronisation and message spacings of 10 to 20 ms. The paper does
    not say how far the clocks' origin is from the synchronisation, on which the printed variances depend:
    ``origin_s`` is the master's reading at its first message, 0.3 to 1 spacings if it is not given.
    """
    draw = np.random.default_rng([seed, anchor])
    offsets_s = draw.uniform(0.0, 1.0, 2)
    rates = 1.0 + draw.uniform(-20e-6, 20e-6, 3)
    tofs_s = draw.uniform(1.0, 12.0, 3) / SPEED_OF_LIGHT_MPS
    spacings_s = draw.uniform(10e-3, 20e-3, 2)
    delay_s = draw.uniform(1e-3, 10e-3)
    early = draw.uniform(0.3, 1.0)
    sigma_s = SIGMAS_S[noise]
    return Chain(
        master_offset_s=early * spacings_s[0] if origin_s is None else origin_s,
        master_rate=rates[0],
        tag_offset_s=offsets_s[0],
        tag_rate=rates[1],
        anchor_offset_s=offsets_s[1:],
        anchor_rate=rates[2:],
        anchor_tof_s=tofs_s[:1],
        tag_tof_s=tofs_s[1:2],
        tag_master_tof_s=tofs_s[2],
        sync_s=0.0,
        sync_spacing_s=spacings_s[0],
        reference_s=spacings_s[0] + 1e-3,
        delay_s=np.array([delay_s]),
        spacing_s=spacings_s[1:],
        sigma_master_s=sigma_s,
        sigma_anchor_s=sigma_s,
        sigma_tag_s=sigma_s,
    )


def paper_checks(
    seed: int,
    draws: int,
    progress: Callable[[int], None] | None = None,
    *,
    origin_s: float | None = None,
) -> tuple[PaperCheck, ...]:
    """Every quantity of ``QUANTITIES`` for ten random anchors, Gaussian and uniform noise.

    ``draws`` of each anchor and noise; ``progress`` is called with the draws done, of 20·``draws`` in all.
    ``origin_s``: see ``paper_chain``.
    """
    checks: list[PaperCheck] = []
    done = 0

    def report(part: int) -> None:
        if progress is not None:
            progress(done + part)

    for noise in NOISES:
        for anchor in range(1, ANCHORS + 1):
            chain = paper_chain(seed, anchor, noise, origin_s=origin_s)
            moments = draw_moments(chain, _key(seed, anchor), draws, uniform=noise == "uniform", progress=report)
            done += draws
            checks.extend(_checks(chain, moments, noise, anchor))
    return tuple(checks)


def _key(seed: int, anchor: int) -> int:
    """Seed of one anchor's draws."""
    return int(np.random.SeedSequence([seed, anchor]).generate_state(1, np.uint64)[0] >> 1)


def _checks(chain: Chain, moments: ChainMoments, noise: str, anchor: int) -> Iterator[PaperCheck]:
    for quantity, (row, as_printed, as_corrected) in _ROWS.items():
        std = float(moments.std[row, 0])
        printed_variance = _number(as_printed(chain))
        yield PaperCheck(
            name=f"{noise}/{quantity}/anchor {anchor}",
            noise=noise,
            quantity=quantity,
            anchor=anchor,
            printed_error_pct=_error_pct(printed_variance, std) if printed_variance >= 0.0 else None,
            corrected_error_pct=_error_pct(_number(as_corrected(chain)), std),
            standard_error_pct=100.0 * float(moments.std_relative_error[row, 0]),
            mean_error_sigmas=float(moments.mean[row, 0] / moments.mean_error[row, 0]),
            draws=moments.draws,
        )


def _number(value: Array) -> float:
    return float(np.asarray(value).reshape(-1)[0])


def _error_pct(variance: float, std: float) -> float:
    return 100.0 * abs(math.sqrt(variance) - std) / std


def lambda_distributions(
    seed: int, draws: int, bins: int = 101, progress: Callable[[int], None] | None = None
) -> tuple[LambdaDistribution, ...]:
    """Distributions of λ of anchor 1, one for each of ``NOISES``; ``progress``: of 2·``draws`` in all."""
    found = []
    for number, noise in enumerate(NOISES):
        found.append(_distribution(seed, noise, draws, bins))
        if progress is not None:
            progress((number + 1) * draws)
    return tuple(found)


def _distribution(seed: int, noise: str, draws: int, bins: int) -> LambdaDistribution:
    chain = paper_chain(seed, 1, noise)
    theory_m = math.sqrt(_number(corrected.lambda_m2(chain)))
    printed_variance = _number(printed.lambda_m2(chain))
    edges = np.linspace(-_REACH_SIGMAS, _REACH_SIGMAS, bins + 1) * theory_m
    counts = np.zeros(bins, np.int64)
    squares = 0.0
    for lambdas in draw_lambdas(chain, _key(seed, 1), draws, uniform=noise == "uniform"):
        values = lambdas[:, 0]
        counts += np.histogram(values, edges)[0]
        squares += float(values @ values)
    return LambdaDistribution(
        noise=noise,
        edges_m=edges,
        counts=counts,
        std_m=math.sqrt(squares / draws),
        corrected_std_m=theory_m,
        printed_std_m=math.sqrt(printed_variance) if printed_variance >= 0.0 else None,
        draws=draws,
    )
