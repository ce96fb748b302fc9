"""Figure 2: printed and corrected standard deviations against Monte Carlo draws (fig:GammaApprox, E1 to E7)."""

from typing import Final

import numpy as np
from matplotlib.axes import Axes

from skyless.evaluation.figures import BLUE, INK, RED, panel
from skyless.paper.chain_checks import ANCHORS, PaperCheck, paper_checks
from skyless.paper.plan import Plan, Progress, Results, Task
from skyless.paper.section import Panel, Section, Verdict, grouped

SYMBOLS: Final = {
    "beta": "β",
    "gamma_first": "γ(t̄)",
    "gamma_delayed": "γ(t̄+D)",
    "gamma_averaged": "γ̄",
    "epsilon": "ε",
    "xi": "ξ",
    "phi": "φ",
    "lambda": "λ",
}
GAMMAS: Final = ("gamma_first", "gamma_delayed", "gamma_averaged")
DRAWN_TIMES: Final = 2 * ANCHORS
"""Each anchor draws with either kind of noise."""
SECONDS_PER_DRAW: Final = 2e-5
FAR_S: Final = 1.0
"""Reading of the master's clock at the synchronisation, in the second check."""
FLOOR_PCT: Final = 1e-3
"""Smallest error that the logarithmic axes show."""
SIGMAS: Final = 5.0
"""Standard errors within which hundreds of checks are expected to lie."""


def tasks(plan: Plan) -> list[Task]:
    """All quantities of ten anchors, Gaussian and uniform; and a few draws with clocks that started earlier."""
    few = max(plan.draws // 20, 10_000)
    return [
        Task("checks", run_checks, {"seed": plan.seed, "draws": plan.draws}, plan.draws * SECONDS_PER_DRAW),
        Task("checks/far", run_checks, {"seed": plan.seed, "draws": few, "origin_s": FAR_S}, few * SECONDS_PER_DRAW),
    ]


def run_checks(progress: Progress, seed: int, draws: int, origin_s: float | None = None) -> tuple[PaperCheck, ...]:
    """Draw, and compare; ``origin_s`` is what the master's clock reads at the synchronisation."""
    return paper_checks(seed, draws, lambda done: progress(done / (DRAWN_TIMES * draws)), origin_s=origin_s)


def judge(checks: tuple[PaperCheck, ...]) -> tuple[Verdict, str]:
    """Whether the printed deviations, or only the corrected ones, are those of the draws."""
    worst = max(checks, key=lambda check: check.corrected_error_pct / check.standard_error_pct)
    right = [_agrees(check.printed_error_pct, check) for check in checks]
    off = [check.printed_error_pct for check in checks if check.printed_error_pct is not None]
    wrong = sorted(
        {check.quantity for check, fine in zip(checks, right, strict=True) if not fine}, key=list(SYMBOLS).index
    )
    names = ", ".join(SYMBOLS[name] for name in wrong)
    most = grouped(round(max(off)))
    fine = ", ".join(symbol for name, symbol in SYMBOLS.items() if name not in wrong)
    corrected = f"the corrected ones are within {max(check.corrected_error_pct for check in checks):.2f} %"
    if all(right):
        return Verdict.HOLDS, f"All printed deviations agree with the draws; {corrected}."
    if all(_agrees(check.corrected_error_pct, check) for check in checks):
        return Verdict.CORRECTED, (
            f"As printed, the deviations of {names} are off, by up to {most} %; {corrected} of the draws, whose "
            f"standard error is {checks[0].standard_error_pct:.3f} % (errata E1 to E7). {fine} are right to within "
            "parts per million, misprinted symbols read as meant, and averaging the two offsets changes nothing "
            "(E2)."
        )
    return Verdict.FAILS, f"Even the corrected deviation of {worst.name} is {worst.corrected_error_pct:.2f} % off."


def _agrees(error_pct: float | None, check: PaperCheck) -> bool:
    """Within the scatter of the draws, or within the terms of second order that linearisation leaves."""
    return error_pct is not None and error_pct <= max(SIGMAS * check.standard_error_pct, 0.1)


def section(plan: Plan, results: Results) -> Section:
    """The figure with its verdict."""
    checks: tuple[PaperCheck, ...] = results["checks"]
    verdict, reason = judge(checks)
    rows = [("quantity", "noise", "printed off by in %", "corrected off by in %", "largest mean in standard errors")]
    for quantity, symbol in SYMBOLS.items():
        for noise in ("gaussian", "uniform"):
            mine = [check for check in checks if check.quantity == quantity and check.noise == noise]
            printed = [check.printed_error_pct for check in mine if check.printed_error_pct is not None]
            negative = len(mine) - len(printed)
            span = f"{min(printed):.3g} to {max(printed):.3g}" if printed else ""
            told = f"{span} ({negative} negative)" if negative else span
            corrected = [check.corrected_error_pct for check in mine]
            means = max(abs(check.mean_error_sigmas) for check in mine)
            rows.append((symbol, noise, told, f"{min(corrected):.3f} to {max(corrected):.3f}", f"{means:.1f}"))
    far: tuple[PaperCheck, ...] = results["checks/far"]
    panels = [_by_anchor(checks, quantity) for quantity in GAMMAS]
    panels += [_by_quantity("02-all-quantities", "All quantities, all anchors", checks)]
    panels += [_by_quantity("02-all-quantities-later", f"The same, {FAR_S:g} s after the clocks' start", far)]
    return Section(
        key="gamma-check",
        title="The uncertainty analysis against Monte Carlo",
        label="fig:GammaApprox, eq:Gamma, eq:AverageRelOff, eq:FinalTDoAUnc",
        claim=(
            "For ten random anchors the standard deviations of γ at both times and of their average match 10 000 "
            "draws very well, whichever is considered; the same is said of all other quantities."
        ),
        simulated=(
            f"{grouped(plan.draws)} draws of the exact algorithm for each of ten anchors with random clocks, places "
            "and delays, stamps Gaussian and uniform within ±15.65 ps. Shown is the absolute relative error of "
            "each standard deviation, as the paper defines it. 10 000 draws have a standard error of 0.7 %; these "
            f"have {checks[0].standard_error_pct:.3f} %. The printed terms depend on when the clocks started, which "
            f"the paper leaves open: once they read a few milliseconds at the synchronisation, once {FAR_S:g} s."
        ),
        verdict=verdict,
        reason=reason,
        panels=tuple(panels),
        table=tuple(rows),
        numbers={"symbols": SYMBOLS, "checks": len(checks), "far": far, "far_origin_s": FAR_S},
        command=f"skyless paper --out DIR --seed {plan.seed} --json",
    )


def _by_anchor(checks: tuple[PaperCheck, ...], quantity: str) -> Panel:
    symbol = SYMBOLS[quantity]
    figure, axes = panel(f"Standard deviation of {symbol}", 2.9)
    mine = [check for check in checks if check.quantity == quantity and check.noise == "gaussian"]
    anchors = np.array([check.anchor for check in mine])
    printed = [_shown(check.printed_error_pct) for check in mine]
    corrected = [_shown(check.corrected_error_pct) for check in mine]
    axes.bar(anchors - 0.2, printed, 0.38, bottom=FLOOR_PCT, color=RED, label="as printed")
    axes.bar(anchors + 0.2, corrected, 0.38, bottom=FLOOR_PCT, color=BLUE, label="corrected")
    axes.axhline(
        mine[0].standard_error_pct, color=INK, linestyle="--", linewidth=1.0, label="standard error of the draws"
    )
    _logarithmic(axes)
    axes.set(xlabel="anchor", xticks=anchors)
    axes.legend(loc="upper left", ncols=2)
    missing = sum(check.printed_error_pct is None for check in mine)
    note = f" {missing} printed variances are negative and have no bar." if missing else ""
    caption = f"Absolute relative error of σ of {symbol}, Gaussian stamps.{note}"
    return Panel(f"02-{quantity.replace('_', '-')}", caption, figure)


def _by_quantity(name: str, title: str, checks: tuple[PaperCheck, ...]) -> Panel:
    figure, axes = panel(title, 2.9)
    for place, quantity in enumerate(SYMBOLS):
        mine = [check for check in checks if check.quantity == quantity and check.noise == "gaussian"]
        printed = [_shown(check.printed_error_pct) for check in mine]
        corrected = [_shown(check.corrected_error_pct) for check in mine]
        axes.plot(
            [place - 0.12] * len(mine), printed, "o", color=RED, markersize=4, label=None if place else "as printed"
        )
        axes.plot(
            [place + 0.12] * len(mine), corrected, "o", color=BLUE, markersize=4, label=None if place else "corrected"
        )
    axes.set_xticks(range(len(SYMBOLS)), list(SYMBOLS.values()))
    _logarithmic(axes)
    axes.legend(loc="upper left", ncols=2)
    caption = (
        f"Absolute relative error of σ of every quantity, {grouped(checks[0].draws)} draws; a dot for each of ten "
        "anchors."
    )
    return Panel(name, caption, figure)


def _logarithmic(axes: Axes) -> None:
    """Per cent on a logarithmic axis with room for the legend."""
    axes.set_yscale("log")
    low, high = axes.get_ylim()
    axes.set_ylim(max(low, FLOOR_PCT), 30.0 * high)
    axes.set_ylabel("|theory − draws| in %")


def _shown(error_pct: float | None) -> float:
    """What a logarithmic axis can show; NaN for a deviation that does not exist."""
    return np.nan if error_pct is None else max(error_pct, FLOOR_PCT)
