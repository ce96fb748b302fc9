"""Figure 3: the distribution of one DTDoA's error, Gaussian and uniform stamps (fig:TDoAApprox, E10)."""

import math
from functools import partial
from typing import Final

import numpy as np
from msgspec import Struct, structs

from skyless.core.arrays import Array, Integers
from skyless.research.paper._checks import NOISES, draw_seed, first_number, paper_chain
from skyless.research.paper.plan import Panel, Plan, Results, Section, Verdict, draw_lambdas, gaussian, grouped
from skyless.research.studies.runner import Cell
from skyless.research.uncertainty import CORRECTED, PRINTED
from skyless.site.report import BLUE, INK, RED, panel

_AGREES_SIGMAS: Final = 5.0
_REACH_SIGMAS: Final = 5.0


class LambdaDistribution(Struct, frozen=True):
    """Histogram of the error λ of one DTDoA (``eq:FinalTDoAUnc``), anchor 1."""

    noise: str
    edges_m: Array
    """Shape (bins + 1,), to five sigma on both sides; the one draw in two million beyond is not counted."""
    counts: Integers
    """Shape (bins,)."""
    std_m: float
    """Standard deviation of the draws."""
    corrected_std_m: float
    printed_std_m: float | None
    draws: int


_BINS: Final = 101


def lambda_distributions(seed: int, draws: int) -> tuple[LambdaDistribution, ...]:
    """Distributions of λ of anchor 1, one for each of ``NOISES``."""
    return tuple(_distribution(seed, noise, draws) for noise in NOISES)


def _distribution(seed: int, noise: str, draws: int) -> LambdaDistribution:
    chain = paper_chain(seed, 1, noise)
    theory_m = math.sqrt(first_number(CORRECTED.lambda_m2(chain)))
    printed_variance = first_number(PRINTED.lambda_m2(chain))
    edges = np.linspace(-_REACH_SIGMAS, _REACH_SIGMAS, _BINS + 1) * theory_m
    counts = np.zeros(_BINS, np.int64)
    squares = 0.0
    for lambdas in draw_lambdas(chain, draw_seed(seed, 1), draws, uniform=noise == "uniform"):
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


def cells(plan: Plan) -> list[Cell]:
    """One anchor, two kinds of noise."""
    return [Cell("distributions", partial(lambda_distributions, seed=plan.seed, draws=plan.draws), plan.draws * 3e-6)]


def shape_distance(one: LambdaDistribution) -> float:
    """Share of the draws that lie otherwise than in a Gaussian of the corrected deviation (total variation)."""
    below = [math.erf(edge / (math.sqrt(2.0) * one.corrected_std_m)) / 2.0 for edge in one.edges_m.tolist()]
    expected = np.diff(below)
    return float(0.5 * np.abs(one.counts / one.draws - expected).sum())


def deviation_pct(one: LambdaDistribution) -> float:
    """Corrected deviation against that of the draws, in per cent."""
    return 100.0 * (one.corrected_std_m / one.std_m - 1.0)


def judge(gaussian: LambdaDistribution, uniform: LambdaDistribution) -> tuple[Verdict, str]:
    """Whether the theory is less accurate for uniform stamps."""
    standard_error_pct = 100.0 / (2.0 * uniform.draws) ** 0.5
    figures = (
        f"σ is {deviation_pct(gaussian):+.2f} % off for Gaussian and {deviation_pct(uniform):+.2f} % for uniform "
        f"stamps, with a standard error of {standard_error_pct:.2f} %; {100 * shape_distance(uniform):.1f} % of the "
        "uniform draws lie otherwise than in a Gaussian"
    )
    if abs(deviation_pct(uniform)) <= max(_AGREES_SIGMAS * standard_error_pct, 0.1):
        return Verdict.FAILS, (
            f"The deviation is as accurate for uniform stamps as for Gaussian ones ({figures}). Uniform stamps within "
            "the same limits are √3 noisier (9.04 against 5.22 ps): that alone widens the distribution."
        )
    return Verdict.HOLDS, f"The theory is less accurate for uniform stamps ({figures})."


def section(plan: Plan, results: Results) -> Section:
    """The figure with its verdict."""
    both: tuple[LambdaDistribution, ...] = results["distributions"]
    by = {one.noise: one for one in both}
    verdict, reason = judge(by["gaussian"], by["uniform"])
    rows = [("stamps", "σ of the draws in mm", "corrected", "as printed", "shape off by")]
    for one in both:
        printed_mm = "variance negative" if one.printed_std_m is None else f"{1e3 * one.printed_std_m:.3f}"
        distance = f"{100 * shape_distance(one):.2f} %"
        rows.append(
            (_stamps_name(one), f"{1e3 * one.std_m:.3f}", f"{1e3 * one.corrected_std_m:.3f}", printed_mm, distance)
        )
    return Section(
        key="dtdoa-distribution",
        title="The distribution of a DTDoA",
        label="fig:TDoAApprox, eq:FinalTDoAUnc",
        claim=(
            "The approximation of the DTDoA's uncertainty becomes less accurate when stamps err uniformly instead of "
            "normally."
        ),
        simulated=(
            f"{grouped(plan.draws)} draws of the exact algorithm for anchor 1 of figure 2, stamps within ±15.65 ps: "
            "Gaussian (three standard deviations) and uniform."
        ),
        verdict=verdict,
        reason=reason,
        panels=tuple(_density(one) for one in both),
        table=tuple(rows),
        numbers={
            "distributions": [
                {name: value for name, value in structs.asdict(one).items() if name not in {"edges_m", "counts"}}
                | {"corrected_error_pct": deviation_pct(one), "shape_distance": shape_distance(one)}
                for one in both
            ]
        },
        command=f"skyless paper --out DIR --seed {plan.seed} --json",
    )


def _stamps_name(one: LambdaDistribution) -> str:
    return "Gaussian" if one.noise == "gaussian" else one.noise


def _density(one: LambdaDistribution) -> Panel:
    figure, axes = panel(f"λ with {_stamps_name(one)} stamps", 3.2)
    edges_mm = 1e3 * one.edges_m
    density = one.counts / one.draws / np.diff(edges_mm)
    axes.stairs(density, edges_mm, fill=True, color=BLUE, alpha=0.4, label="draws")
    x = np.linspace(edges_mm[0], edges_mm[-1], 400)
    corrected_mm = 1e3 * one.corrected_std_m
    axes.plot(x, gaussian(x, corrected_mm), color=INK, label=f"corrected, σ = {corrected_mm:.2f} mm")
    if one.printed_std_m is not None:
        printed_mm = 1e3 * one.printed_std_m
        axes.plot(x, gaussian(x, printed_mm), "--", color=RED, label=f"as printed, σ = {printed_mm:.2f} mm")
    axes.set(xlabel="error of one DTDoA in mm", ylabel="density in 1/mm", xlim=(-5 * corrected_mm, 5 * corrected_mm))
    axes.set_ylim(0, 1.4 * axes.get_ylim()[1])
    axes.legend(loc="upper left")
    return Panel(
        f"03-lambda-{one.noise}",
        f"Error of one DTDoA, {_stamps_name(one)} stamps, and the densities that theory gives.",
        figure,
    )
