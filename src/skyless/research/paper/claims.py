"""The paper's claims, figure by figure: what is simulated, what is expected, and what is drawn.

``claims.toml`` is the table of claims. Here are the cells of each, which are simulated, and what their results say:
figures that are judged by the table's rules, tables, pictures, numbers.
"""

import math
import sys
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Final

import msgspec
import numpy as np
from msgspec import Struct, structs
from msgspec.structs import replace
from scipy.stats import norm

from skyless.core.arrays import Array, Integers
from skyless.core.geometry import dops_at
from skyless.core.protocol1.beacon import schedule_of
from skyless.core.protocol1.snapshots import literal_covariance
from skyless.core.site import AnchorSite, ScheduleSite, Site
from skyless.core.ticks import SPEED_OF_LIGHT_MPS, TICK_M, TICK_S
from skyless.research.paper import _scale
from skyless.research.paper.plan import (
    CLAIM_M,
    DW1000_PS,
    P1,
    P1_METHODS,
    P2,
    PAPER_PS,
    RADIO_PS,
    ChainMoments,
    Figures,
    Found,
    Panel,
    Plan,
    Point,
    Quantity,
    Results,
    Section,
    Table,
    TimedReception,
    Track,
    Verdict,
    draw_lambdas,
    draw_moments,
    grouped,
    listen,
    receptions,
)
from skyless.research.studies.runner import Cell, seed_of
from skyless.research.uncertainty import CORRECTED, PRINTED, Chain
from skyless.sim.evaluation.scenarios import Request, fleet_of
from skyless.sim.impairments import DelayError, Impairments, Outage, lab_impairments
from skyless.sim.lab import paper_lab_site
from skyless.sim.listening import TagSpec
from skyless.sim.trajectory import Static, Waypoints
from skyless.site.channel import ChannelModel, power_bias_m, received_power_dbm
from skyless.site.report import (
    BLUE,
    GREEN,
    GRID,
    INK,
    MAP,
    MAP_WHITE,
    METHOD_COLOURS,
    MUTED,
    RED,
    draw_floor_plan,
    panel,
)


class Rule(Struct, frozen=True, forbid_unknown_fields=True):
    """A verdict that is given where all figures are within limits."""

    verdict: Verdict
    reason: str
    limits: dict[str, tuple[float, float]] = {}


class Claim(Struct, frozen=True, forbid_unknown_fields=True):
    """A statement of the paper, as ``claims.toml`` has it."""

    key: str
    title: str
    label: str
    claim: str
    simulated: str
    rules: tuple[Rule, ...]
    measured: str = ""
    """A part of the reasons."""
    command: str = "skyless paper --out DIR --seed {plan.seed}"
    """Reproduces the central number."""

    def cells(self, plan: Plan) -> list[Cell]:
        """Work to simulate."""
        return _WORK[self.key][0](plan)

    def judge(self, figures: Figures) -> tuple[Verdict, str]:
        """The verdict, and why."""
        for rule in self.rules:
            if all(low <= figures[name] <= high for name, (low, high) in rule.limits.items()):
                break
        return rule.verdict, rule.reason.format(**figures, measured=self.measured.format(**figures))

    def section(self, plan: Plan, results: Results) -> Section:
        """The claim as a section of the report."""
        figures, table, panels, numbers = _WORK[self.key][1](plan, results)
        amounts = {name: grouped(getattr(plan, name)) for name in ("fixes", "fewer_fixes", "draws")}
        words: Figures = {"plan": plan, **amounts, **figures}
        title, simulated, command = (one.format(**words) for one in (self.title, self.simulated, self.command))
        about = self.key, title, self.label, self.claim, simulated, *self.judge(figures)
        return Section(*about, tuple(panels), tuple(table), numbers, command)


Line = tuple[Any, Any, dict[str, Any]]
"""Points along x and y, and their style."""


def _plot(name: str, title: str, caption: str, lines: Sequence[Line], axis: Figures, height_in: float = 3.4) -> Panel:
    """A picture of lines and points; ``axis``: arguments of ``Axes.set``."""
    figure, axes = panel(title, height_in)
    for x, y, style in lines:
        axes.plot(x, y, **style)
    if any("label" in style for _, _, style in lines):
        axes.margins(y=0.3)
        axes.legend(loc="upper left", ncols=2)
    axes.set(**axis)
    return Panel(name, caption, figure)


def _in_the_lab(name: str, title: str, caption: str, lines: Sequence[Line]) -> Panel:
    """The same within the lab's walls."""
    drawn = _plot(name, title, caption, lines, {"xlim": (-0.5, 6.5), "ylim": (-0.5, 8.5)}, 4.6)
    draw_floor_plan(drawn.figure.axes[0], _LAB_M)
    return drawn


def _bars(spans: dict[str, tuple[float, str]]) -> tuple[list[Line], dict[str, Any]]:
    """Lines that draw a bar for each name, with its value and colour, and arguments for the axis."""
    style = {"linewidth": 14.0, "solid_capstyle": "butt"}
    lines: list[Line] = [((0, end), (-row, -row), {**style, "color": c}) for row, (end, c) in enumerate(spans.values())]
    labels = [f"{name}: {end:.0f}" for name, (end, _) in spans.items()]
    return lines, {
        "yticks": [-row for row in range(len(spans))],
        "yticklabels": labels,
        "ylim": (0.6 - len(spans), 0.6),
    }


# 1: uplink and downlink, and the lab.

LAB_ANCHORS_M: Final = np.array([(anchor.x_m, anchor.y_m) for anchor in paper_lab_site().anchors])
"""The lab's anchors, shape (6, 2), the master first, in the order in which they send."""
_LAB_M: Final[list[Point]] = [(x_m, y_m) for x_m, y_m in LAB_ANCHORS_M.tolist()]

_TAGS_M: Final = ((2.0, 2.4), (4.1, 5.9), (1.6, 5.6))
_MANY: Final = 50


def count_frames(tags: int, seed: int) -> dict[str, int]:
    """Frames on the air in a second, their senders, and frames that tags received."""
    world = fleet_of(Request(site=paper_lab_site(), tags=tags, seed=seed)).world
    senders = {broadcast.anchor for broadcast in world.run(1.0)}
    return {"sent": world.tally.transmissions, "senders": len(senders), "heard_by_tags": world.tally.at_tags["heard"]}


def _scenario_cells(plan: Plan) -> list[Cell]:
    """The lab with one tag and with many."""
    worlds = {tags: partial(count_frames, tags=tags, seed=plan.seed) for tags in (1, _MANY)}
    return [Cell(f"scenario/{tags}", world, 0.2 + tags * 0.02) for tags, world in worlds.items()]


def scenario_figures(alone: dict[str, int], many: dict[str, int], tags: int) -> Figures:
    """Frames on the air, and received by each tag, over those with one tag."""
    heard = many["heard_by_tags"] / alone["heard_by_tags"] / tags
    return {"alone": alone, "many": many, "tags": tags, "sent": many["sent"] / alone["sent"], "heard": heard}


def _scenario(plan: Plan, results: Results) -> Found:  # noqa: ARG001
    alone, many = results["scenario/1"], results[f"scenario/{_MANY}"]
    table: Table = [("tags", "frames sent", "senders", "frames heard by tags")]
    table += [(tags, *map(str, counts.values())) for tags, counts in (("1", alone), (str(_MANY), many))]
    ways = [(anchor_m, tag_m, {"color": BLUE, "alpha": 0.5}) for anchor_m in _LAB_M for tag_m in _TAGS_M]
    tags: Line = (*np.array(_TAGS_M).T, {"color": RED, "marker": "o", "linestyle": ""})
    lines = [((a[0], b[0]), (a[1], b[1]), style) for a, b, style in ways]
    caption = "Downlink TDoA: anchors take turns (1 is the master), tags (red) only listen."
    panels = [_in_the_lab("01-downlink", "Downlink: the anchors send", caption, [*lines, tags])]
    numbers = {"one_tag": alone, "many_tags": many, "tags": _MANY, "anchors_m": LAB_ANCHORS_M}
    return Found(scenario_figures(alone, many, _MANY), table, panels, numbers)


# 2: printed and corrected standard deviations against Monte Carlo draws (E1 to E7).

NOISES: Final = {"gaussian": TICK_S / 3.0, "uniform": TICK_S / 3.0**0.5}
"""Noise of every stamp: "plus/minus 15.65 ps" read as three sigma, or as the half width of the uniform noise."""

CHECKED_ANCHORS: Final = 10
"""Number of anchors in the paper's numerical analysis."""

_Variance = Callable[[Chain], Array]
QUANTITIES: Final[dict[str, tuple[str, Quantity, _Variance, _Variance]]] = {
    "beta": ("β", Quantity.BETA, PRINTED.beta, CORRECTED.beta),
    "gamma_first": ("γ(t̄)", Quantity.GAMMA_FIRST, PRINTED.gamma_first, CORRECTED.gamma_first),
    "gamma_delayed": ("γ(t̄+D)", Quantity.GAMMA_DELAYED, PRINTED.gamma_delayed, CORRECTED.gamma_delayed),
    "gamma_averaged": ("γ̄", Quantity.GAMMA_AVERAGED, PRINTED.gamma_averaged, CORRECTED.gamma_averaged),
    "epsilon": ("ε", Quantity.EPSILON_FIRST, PRINTED.epsilon_first, CORRECTED.epsilon_first),
    "xi": ("ξ", Quantity.XI, PRINTED.xi, CORRECTED.xi),
    "phi": ("φ", Quantity.PHI, PRINTED.phi, CORRECTED.phi),
    "lambda": ("λ", Quantity.LAMBDA, PRINTED.lambda_m2, CORRECTED.lambda_m2),
}
"""β, γ(t̄), γ(t̄+D), γ̄, ε(t_i), ξ, φ, λ, in the order in which the paper derives them."""
_SYMBOLS: Final = {name: symbol for name, (symbol, *_) in QUANTITIES.items()}

_SECONDS_PER_DRAW: Final = 2e-5
_FAR_S: Final = 1.0
"""Reading of the master's clock at the synchronisation, in the second check."""
_FLOOR_PCT: Final = 1e-3
"""Smallest error that the logarithmic axes show."""
_SIGMAS: Final = 5.0
"""Standard errors within which hundreds of checks are expected to lie."""
_SECOND_ORDER_PCT: Final = 0.1
"""Terms of second order that linearisation leaves."""


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


def paper_chain(seed: int, anchor: int, noise: str, *, origin_s: float | None = None) -> Chain:
    """Random chain of anchor 1 to 10: offsets, rates, positions and delays, as in the paper's numerical analysis.

    Rates within ±20 ppm, distances of 1 to 12 m, synchronisation and message spacings of 10 to 20 ms. The paper does
    not state how far the clocks' origin is from the synchronisation, on which the printed variances depend:
    ``origin_s`` is the master's reading at its first message, 0.3 to 1 spacings if it is not given.
    """
    draw = np.random.default_rng([seed, anchor])
    offsets_s = draw.uniform(0.0, 1.0, 2)
    rates = 1.0 + draw.uniform(-20e-6, 20e-6, 3)
    tofs_s = draw.uniform(1.0, 12.0, 3) / SPEED_OF_LIGHT_MPS
    spacings_s = draw.uniform(10e-3, 20e-3, 2)
    delay_s = draw.uniform(1e-3, 10e-3)
    early = draw.uniform(0.3, 1.0)
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
        sigma_master_s=NOISES[noise],
        sigma_anchor_s=NOISES[noise],
        sigma_tag_s=NOISES[noise],
    )


def paper_checks(seed: int, draws: int, *, origin_s: float | None = None) -> tuple[PaperCheck, ...]:
    """Every quantity of ``QUANTITIES`` for ten random anchors, Gaussian and uniform noise.

    ``draws`` of each anchor and noise; ``origin_s``: see ``paper_chain``.
    """
    checks: list[PaperCheck] = []
    for noise in NOISES:
        for anchor in range(1, CHECKED_ANCHORS + 1):
            chain = paper_chain(seed, anchor, noise, origin_s=origin_s)
            moments = draw_moments(chain, seed_of(seed, anchor) >> 1, draws, uniform=noise == "uniform")
            checks.extend(_checks(chain, moments, noise, anchor))
    return tuple(checks)


def _checks(chain: Chain, moments: ChainMoments, noise: str, anchor: int) -> Iterator[PaperCheck]:
    for quantity, (_, row, as_printed, as_corrected) in QUANTITIES.items():
        std = float(moments.std[row, 0])
        printed_variance = _first_number(as_printed(chain))
        yield PaperCheck(
            name=f"{noise}/{quantity}/anchor {anchor}",
            noise=noise,
            quantity=quantity,
            anchor=anchor,
            printed_error_pct=_error_pct(printed_variance, std) if printed_variance >= 0.0 else None,
            corrected_error_pct=_error_pct(_first_number(as_corrected(chain)), std),
            standard_error_pct=100.0 * float(moments.std_relative_error[row, 0]),
            mean_error_sigmas=float(moments.mean[row, 0] / np.sqrt(moments.variance[row, 0] / moments.draws)),
            draws=moments.draws,
        )


def _first_number(value: Array) -> float:
    """The only number of a chain with one anchor."""
    return float(np.asarray(value).reshape(-1)[0])


def _error_pct(variance: float, std: float) -> float:
    return 100.0 * abs(math.sqrt(variance) - std) / std


def _gamma_cells(plan: Plan) -> list[Cell]:
    """All quantities of ten anchors, Gaussian and uniform; and a few draws with clocks that started earlier."""
    few = max(plan.draws // 20, 10_000)
    return [
        Cell("checks", partial(paper_checks, seed=plan.seed, draws=plan.draws), plan.draws * _SECONDS_PER_DRAW),
        Cell("checks/far", partial(paper_checks, seed=plan.seed, draws=few, origin_s=_FAR_S), few * _SECONDS_PER_DRAW),
    ]


def gamma_figures(checks: Sequence[PaperCheck]) -> Figures:
    """Largest errors of the printed and corrected deviations, over the errors that the draws allow."""
    printed = {check.name: _excess(check.printed_error_pct, check) for check in checks}
    wrong = {check.quantity for check in checks if printed[check.name] > 1.0}
    worst = max(checks, key=lambda check: check.corrected_error_pct / check.standard_error_pct)
    return {
        "printed": max(printed.values()),
        "corrected": max(_excess(check.corrected_error_pct, check) for check in checks),
        "wrong": ", ".join(symbol for name, symbol in _SYMBOLS.items() if name in wrong),
        "right": ", ".join(symbol for name, symbol in _SYMBOLS.items() if name not in wrong),
        "most_pct": grouped(round(max(check.printed_error_pct or 0.0 for check in checks))),
        "corrected_pct": max(check.corrected_error_pct for check in checks),
        "standard_error_pct": checks[0].standard_error_pct,
        "worst": worst,
    }


def _excess(error_pct: float | None, check: PaperCheck) -> float:
    """An error over the largest that scatter and terms of second order explain."""
    return math.inf if error_pct is None else error_pct / max(_SIGMAS * check.standard_error_pct, _SECOND_ORDER_PCT)


def _gamma(plan: Plan, results: Results) -> Found:  # noqa: ARG001
    checks, far = results["checks"], results["checks/far"]
    table: Table = [("quantity", "noise", "printed off by in %", "corrected off by in %", "mean in standard errors")]
    for quantity, symbol in _SYMBOLS.items():
        for noise in NOISES:
            mine = [check for check in checks if check.quantity == quantity and check.noise == noise]
            printed_pct = [check.printed_error_pct for check in mine if check.printed_error_pct is not None]
            negative = f" ({len(mine) - len(printed_pct)} negative)" if len(printed_pct) < len(mine) else ""
            span = f"{min(printed_pct):.3g} to {max(printed_pct):.3g}" if printed_pct else ""
            corrected_pct = [check.corrected_error_pct for check in mine]
            corrected = f"{min(corrected_pct):.3f} to {max(corrected_pct):.3f}"
            mean = f"{max(abs(check.mean_error_sigmas) for check in mine):.1f}"
            table.append((symbol, noise, span + negative, corrected, mean))
    panels = [
        _by_quantity("02-all-quantities", "All quantities, all anchors", checks),
        _by_quantity("02-all-quantities-later", f"The same, {_FAR_S:g} s after the clocks' start", far),
    ]
    numbers = {"symbols": _SYMBOLS, "checks": len(checks), "far": far, "far_origin_s": _FAR_S}
    return Found(gamma_figures(checks), table, panels, numbers)


def _by_quantity(name: str, title: str, checks: Sequence[PaperCheck]) -> Panel:
    shown = [check for check in checks if check.noise == "gaussian"]
    columns = np.array([list(_SYMBOLS).index(check.quantity) for check in shown])
    lines: list[Line] = []
    for label, colour, side in (("printed", RED, -0.12), ("corrected", BLUE, 0.12)):
        errors_pct = np.array([getattr(check, f"{label}_error_pct") for check in shown], np.float64)
        style = {"marker": "o", "linestyle": "", "color": colour, "markersize": 4, "label": label}
        lines.append((columns + side, np.maximum(errors_pct, _FLOOR_PCT), style))
    caption = (
        f"Absolute relative error of σ of every quantity, {grouped(checks[0].draws)} draws; a dot for each of ten "
        "anchors."
    )
    ticks = {"xticks": range(len(_SYMBOLS)), "xticklabels": list(_SYMBOLS.values())}
    return _plot(name, title, caption, lines, {"yscale": "log", "ylabel": "|theory − draws| in %", **ticks})


# 3: the distribution of one DTDoA's error, Gaussian and uniform stamps (E10).

_BINS: Final = 101
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

    @property
    def corrected_error_pct(self) -> float:
        """Corrected deviation against that of the draws."""
        return 100.0 * (self.corrected_std_m / self.std_m - 1.0)

    @property
    def shape_distance(self) -> float:
        """Share of the draws that lie otherwise than in a Gaussian of the corrected deviation (total variation)."""
        below = [math.erf(edge / (math.sqrt(2.0) * self.corrected_std_m)) / 2.0 for edge in self.edges_m.tolist()]
        return float(0.5 * np.abs(self.counts / self.draws - np.diff(below)).sum())


def lambda_distribution(seed: int, noise: str, draws: int) -> LambdaDistribution:
    """Distribution of λ of anchor 1 with stamps of one of ``NOISES``."""
    chain = paper_chain(seed, 1, noise)
    theory_m = math.sqrt(_first_number(CORRECTED.lambda_m2(chain)))
    printed_variance = _first_number(PRINTED.lambda_m2(chain))
    edges = np.linspace(-_REACH_SIGMAS, _REACH_SIGMAS, _BINS + 1) * theory_m
    counts = np.zeros(_BINS, np.int64)
    squares = 0.0
    for lambdas in draw_lambdas(chain, seed_of(seed, 1) >> 1, draws, uniform=noise == "uniform"):
        values = lambdas[:, 0]
        counts += np.histogram(values, edges)[0]
        squares += float(values @ values)
    printed_m = math.sqrt(printed_variance) if printed_variance >= 0.0 else None
    return LambdaDistribution(noise, edges, counts, math.sqrt(squares / draws), theory_m, printed_m, draws)


def _distribution_cells(plan: Plan) -> list[Cell]:
    """One anchor, two kinds of noise."""
    draws = plan.draws
    return [Cell(f"lambda/{one}", partial(lambda_distribution, plan.seed, one, draws), draws * 2e-6) for one in NOISES]


def distribution_figures(normal: LambdaDistribution, uniform: LambdaDistribution) -> Figures:
    """Error of the theory for uniform stamps, over the largest that the draws allow."""
    standard_error_pct = 100.0 / (2.0 * uniform.draws) ** 0.5
    return {
        "excess": abs(uniform.corrected_error_pct) / max(_SIGMAS * standard_error_pct, _SECOND_ORDER_PCT),
        "normal_pct": normal.corrected_error_pct,
        "uniform_pct": uniform.corrected_error_pct,
        "standard_error_pct": standard_error_pct,
        "shape_pct": 100.0 * uniform.shape_distance,
    }


def _distributions(plan: Plan, results: Results) -> Found:  # noqa: ARG001
    both: list[LambdaDistribution] = [results[f"lambda/{noise}"] for noise in NOISES]
    table: Table = [("stamps", "σ of the draws in mm", "corrected", "as printed", "shape off by")]
    numbers = []
    for one in both:
        printed_mm = "variance negative" if one.printed_std_m is None else f"{1e3 * one.printed_std_m:.3f}"
        corrected_mm, distance = f"{1e3 * one.corrected_std_m:.3f}", f"{100 * one.shape_distance:.2f} %"
        table.append((one.noise, f"{1e3 * one.std_m:.3f}", corrected_mm, printed_mm, distance))
        fields = {name: value for name, value in structs.asdict(one).items() if name not in {"edges_m", "counts"}}
        derived = {"corrected_error_pct": one.corrected_error_pct, "shape_distance": one.shape_distance}
        numbers.append(fields | derived)
    return Found(distribution_figures(*both), table, [_density(one) for one in both], {"distributions": numbers})


def _density(one: LambdaDistribution) -> Panel:
    edges_mm = 1e3 * one.edges_m
    x_mm = (edges_mm[1:] + edges_mm[:-1]) / 2.0
    lines: list[Line] = [
        (x_mm, one.counts / one.draws / np.diff(edges_mm), {"color": BLUE, "drawstyle": "steps-mid", "label": "draws"})
    ]
    for name, std_m, style in (
        ("corrected", one.corrected_std_m, {"color": INK}),
        ("printed", one.printed_std_m, {"color": RED, "linestyle": "--"}),
    ):
        if std_m is not None:
            lines.append(
                (x_mm, norm.pdf(x_mm, 0.0, 1e3 * std_m), {**style, "label": f"{name}, σ = {1e3 * std_m:.2f} mm"})
            )
    caption = f"Error of one DTDoA, {one.noise} stamps, and the densities that theory gives."
    axis = {"xlabel": "error of one DTDoA in mm", "ylabel": "density in 1/mm"}
    return _plot(f"03-lambda-{one.noise}", f"λ with {one.noise} stamps", caption, lines, axis)


# 4: errors at two static positions, and what biased stamps leave.

_POSITIONS: Final = {"P1": P1, "P2": P2}
_WORLDS: Final = {"noise": "stamp noise only", "power": "power-dependent bias", "delay": "antenna-delay errors"}
_METHODS: Final = ("literal", "joint")
_BATCHES: Final = 30
_DELAY_STD_M: Final = 0.05
"""Standard deviation of the errors of antenna delays in the biased world, TX and RX each (assumed)."""
_MOMENTS_MATTER: Final = 0.1
"""Smaller skewness and excess kurtosis do not matter."""


class Moments(Struct, frozen=True):
    """One axis of the errors at one position."""

    count: int
    mean_m: float
    mean_standard_error_m: float
    std_m: float
    skewness: float
    excess_kurtosis: float


def _static_cells(plan: Plan) -> list[Cell]:
    """One world for each kind of stamp error, a tag at each position.

    Without biases the first tag also computes ``fewer_fixes`` by the other methods of figure 9.
    """
    cells = []
    for name in _WORLDS:
        fixes = plan.fixes if name == "noise" else plan.fewer_fixes
        usual = dict.fromkeys(_METHODS, fixes)
        methods = dict.fromkeys(P1_METHODS, plan.fewer_fixes) | usual if name == "noise" else usual
        tags = [(Static(*P1), methods), (Static(*P2), usual)]
        world = partial(listen, paper_lab_site(RADIO_PS), tags, biased_impairments(name, plan.seed), plan.seed)
        cells.append(Cell(f"static/{name}", world, fixes * 2e-3))
    return cells


def biased_impairments(name: str, seed: int) -> Impairments:
    """The lab, with one kind of systematic stamp error or none."""
    lab = lab_impairments(RADIO_PS)
    if name == "power":
        return replace(lab, channel=ChannelModel(power_bias=True))
    return replace(lab, delay_errors=delay_errors(seed)) if name == "delay" else lab


def delay_errors(seed: int) -> tuple[DelayError, ...]:
    """Errors of uncalibrated antenna delays: normal, ``_DELAY_STD_M`` for TX and for RX of every anchor."""
    anchors = paper_lab_site().anchors
    errors = np.random.default_rng([seed, 4]).normal(0.0, _DELAY_STD_M / TICK_M, (len(anchors), 2)).tolist()
    return tuple(DelayError(anchor.id, tx, rx) for anchor, (tx, rx) in zip(anchors, errors, strict=True))


def expected_bias_m(name: str, position_m: Point, seed: int) -> Array:
    """Mean position error of ``literal`` to first order, shape (2,).

    A DTDoA is late by what its RX stamps at the tag are late, less the master's, plus what the anchor's stamp of the
    master is late (its offset carries that on), plus the anchor's own TX delay; the master's TX delay cancels. The
    unweighted least squares make (JᵀJ)⁻¹Jᵀ of it.
    """
    away = np.array(position_m) - LAB_ANCHORS_M
    ranges_m = np.linalg.norm(away, axis=1)
    late_m = np.zeros(len(LAB_ANCHORS_M))
    if name == "power":
        to_master_m = np.linalg.norm(LAB_ANCHORS_M - LAB_ANCHORS_M[0], axis=1)
        at_tag, at_anchors = _power_bias_m(ranges_m), _power_bias_m(to_master_m)
        late_m = at_tag - at_tag[0] + at_anchors
    elif name == "delay":
        late_m = np.array([error.tx_ticks + error.rx_ticks for error in delay_errors(seed)]) * TICK_M
    units = away / ranges_m[:, None]
    bias, *_ = np.linalg.lstsq(units[1:] - units[0], late_m[1:], rcond=None)
    return np.asarray(bias)


def _power_bias_m(ranges_m: Array) -> Array:
    power_dbm = ChannelModel().tx_power_dbm
    return np.array([power_bias_m(received_power_dbm(power_dbm, float(range_m), 0.0)) for range_m in ranges_m])


def moments_of(error_m: Array) -> Moments:
    """Moments of a run of errors, shape (n,); the mean's standard error is from batches, as neighbours correlate."""
    batches = error_m[: len(error_m) // _BATCHES * _BATCHES].reshape(_BATCHES, -1).mean(axis=1)
    standard_error_m = float(batches.std(ddof=1)) / _BATCHES**0.5
    mean_m, std_m = float(error_m.mean()), float(error_m.std())
    scaled = (error_m - mean_m) / std_m
    skewness, kurtosis = float((scaled**3).mean()), float((scaled**4).mean())
    return Moments(len(error_m), mean_m, standard_error_m, std_m, skewness, kurtosis - 3.0)


def static_figures(noise_only: Sequence[Moments], biased: Sequence[Moments]) -> Figures:
    """Means in standard errors, and the higher moments over their scatter in Gaussian errors.

    Those scatter by √(6/n) and √(24/n).
    """
    return {
        "shape": max(
            abs(moment) / (_MOMENTS_MATTER + 4.0 * (scatter / axis.count) ** 0.5)
            for axis in noise_only
            for moment, scatter in ((axis.skewness, 6.0), (axis.excess_kurtosis, 24.0))
        ),
        "noise_sigmas": max(abs(axis.mean_m) / axis.mean_standard_error_m for axis in noise_only),
        "biased_sigmas": max(abs(axis.mean_m) / axis.mean_standard_error_m for axis in biased),
    }


def _static(plan: Plan, results: Results) -> Found:
    table: Table = [("stamps", "position", "method", "mean x, y in cm", "expected", "σ x, y in cm", "largest in cm")]
    numbers: list[dict[str, object]] = []
    literal: dict[str, list[Moments]] = {name: [] for name in _WORLDS}
    for name, stamps in _WORLDS.items():
        for (point, position_m), tracks in zip(_POSITIONS.items(), results[f"static/{name}"], strict=True):
            for method in _METHODS:
                error_m = tracks[method].error_m
                axes = [moments_of(axis) for axis in error_m.T]
                largest_m = float(np.linalg.norm(error_m, axis=1).max())
                expected_m = None
                if method == "literal":
                    literal[name] += axes
                    expected_m = expected_bias_m(name, position_m, plan.seed).tolist()
                means, expected, stds = (
                    ", ".join(f"{100 * one:+.2f}" for one in values)
                    for values in ([one.mean_m for one in axes], expected_m or (), [one.std_m for one in axes])
                )
                table.append((stamps, point, method, means, expected, stds.replace("+", ""), f"{100 * largest_m:.1f}"))
                numbers.append(
                    {
                        "stamps": name,
                        "position": point,
                        "position_m": position_m,
                        "method": method,
                        "fixes": len(error_m),
                        "rmse_m": float(np.sqrt((error_m**2).sum(axis=1).mean())),
                        "max_m": largest_m,
                        "below_20_cm": largest_m < CLAIM_M,
                        "expected_bias_m": expected_m,
                        **dict(zip("xy", axes, strict=True)),
                    }
                )
    figures = static_figures(literal["noise"], literal["power"] + literal["delay"])
    errors_cm = {
        point: 100 * tracks["literal"].error_m
        for point, tracks in zip(_POSITIONS, results["static/noise"], strict=True)
    }
    panels = [
        _histogram(point, axis, error_cm[:, k]) for point, error_cm in errors_cm.items() for k, axis in enumerate("xy")
    ]
    return Found(figures, table, panels, {"rows": numbers})


def _histogram(point: str, axis: str, error_cm: Array) -> Panel:
    density, edges = np.histogram(error_cm, 90, density=True)
    x_cm = (edges[1:] + edges[:-1]) / 2.0
    label = f"mean {error_cm.mean():+.2f}, σ {error_cm.std():.2f} cm".replace("-", "−")
    lines: list[Line] = [
        (x_cm, density, {"color": METHOD_COLOURS["literal"], "drawstyle": "steps-mid"}),
        (x_cm, norm.pdf(x_cm, error_cm.mean(), error_cm.std()), {"color": INK, "label": label}),
    ]
    caption = f"Errors of literal along {axis.upper()} at {point}, stamp noise only; line: a Gaussian."
    along = {"xlabel": f"error along {axis.upper()} in cm", "ylabel": "density in 1/cm"}
    return _plot(f"04-{point.lower()}-{axis}", f"{point}: error along {axis.upper()}", caption, lines, along)


# 5: the walking test.

_CORNERS_M: Final = ((1.0, 1.0), (5.0, 1.0), (5.0, 7.0), (1.0, 7.0))
_SPEED_MPS: Final = 1.0
_CORNER_S: Final = 1.0
"""Time over which the tag turns at a corner."""
_LAP_S: Final = 20.0
_PIECES: Final = 40
"""Pieces of the path, half a metre each."""


def _walk_cells(plan: Plan) -> list[Cell]:
    path = Waypoints(_CORNERS_M, _SPEED_MPS, loop=True, corner_s=_CORNER_S)
    tag, until_s = (path, dict.fromkeys(_METHODS, sys.maxsize)), (plan.laps + 0.5) * _LAP_S
    world = partial(listen, paper_lab_site(RADIO_PS), [tag], lab_impairments(RADIO_PS), plan.seed, until_s)
    return [Cell("walk", world, plan.laps * 1.5)]


def _walk(plan: Plan, results: Results) -> Found:  # noqa: ARG001
    (tracks,) = results["walk"]
    table: Table = [("method", "RMSE 2-D in cm", "95 % 2-D in cm", "largest in cm", "fixes")]
    numbers = []
    for method, track in tracks.items():
        radial = np.linalg.norm(track.error_m, axis=1)
        rmse, p95, worst = float((radial**2).mean() ** 0.5), float(np.percentile(radial, 95)), float(radial.max())
        table.append((method, f"{100 * rmse:.2f}", f"{100 * p95:.1f}", f"{100 * worst:.1f}", grouped(len(radial))))
        numbers.append({"method": method, "rmse_m": rmse, "p95_m": p95, "max_m": worst, "fixes": len(radial)})
    literal: Track = tracks["literal"]
    piece = ((literal.time_s % _LAP_S) / _LAP_S * _PIECES).astype(int) % _PIECES
    rows = [piece == k for k in range(_PIECES)]
    positions_m = np.array([literal.truth_m[row].mean(axis=0) for row in rows])
    # About each piece's mean error, which holds the delay of a fix behind a moving tag.
    scatter_m = np.array([float((literal.error_m[row].var(axis=0)).sum() ** 0.5) for row in rows])
    pdop, predicted_m = pdop_at(positions_m), np.array([_literal_std_m(at) for at in positions_m])
    figures = {
        "pdop_correlation": float(np.corrcoef(scatter_m, pdop)[0, 1]),
        "predicted_correlation": float(np.corrcoef(scatter_m, predicted_m)[0, 1]),
    }
    along_m = (np.arange(_PIECES) + 0.5) * _LAP_S / _PIECES * _SPEED_MPS
    pdop_m = pdop * scatter_m.mean() / pdop.mean()
    explained: list[Line] = [
        (along_m, 100 * scatter_m, {"marker": "o", "linestyle": "", "color": METHOD_COLOURS["literal"]}),
        (along_m, 100 * predicted_m, {"color": INK, "label": "full covariance"}),
        (along_m, 100 * pdop_m, {"color": RED, "linestyle": "--", "label": "PDoP, scaled"}),
    ]
    caption = "Scatter about the local mean (dots), and what the two explanations predict."
    axis = {"xlabel": "way along the path in m", "ylabel": "standard deviation in cm"}
    panels = [*(_path(method, tracks[method]) for method in _METHODS)]
    panels += [_plot("05-walk-scatter", "Scatter of literal along the path", caption, explained, axis)]
    ratio = float((scatter_m / predicted_m).mean())
    return Found(figures, table, panels, {"methods": numbers, **figures, "measured_over_predicted": ratio})


def _path(method: str, track: Track) -> Panel:
    first = track.time_s < track.time_s[0] + _LAP_S
    style = {"marker": ".", "linestyle": "", "color": METHOD_COLOURS[method], "markersize": 3, "zorder": 2}
    planned = np.array([*_CORNERS_M, _CORNERS_M[0]])
    lines: list[Line] = [(*track.position_m[first].T, style), (*planned.T, {"color": INK, "linestyle": "--"})]
    caption = f"Estimates of the first round by {method}, {first.sum()} fixes, over the planned path (dashed)."
    return _in_the_lab(f"05-walk-{method}", f"First round by {method}", caption, lines)


# 6: the PDoP map of the lab, and the map of the predicted deviation next to it.

_STEP_M: Final = 0.1


def literal_covariance_m2(position_m: Array) -> Array:
    """Covariance of one fix of ``literal`` at a position, shape (2, 2).

    G Σ Gᵀ with G = (JᵀJ)⁻¹Jᵀ of the unweighted least squares and Σ the full covariance of its TDoAs. Anchor i sends
    i slots after the master, so κ is i over the slots of the superframe.
    """
    variance_m2 = (RADIO_PS * 1e-12 * SPEED_OF_LIGHT_MPS) ** 2
    kappa = np.arange(1, len(LAB_ANCHORS_M)) / len(LAB_ANCHORS_M)
    away = position_m - LAB_ANCHORS_M
    units = away / np.linalg.norm(away, axis=1)[:, None]
    gain = np.linalg.pinv(units[1:] - units[0])
    return np.asarray(gain @ literal_covariance(kappa, variance_m2, variance_m2) @ gain.T)


def _literal_std_m(position_m: Array) -> float:
    return float(np.trace(literal_covariance_m2(position_m)) ** 0.5)


def pdop_at(positions_m: Array) -> Array:
    """PDoP for a known height at positions of shape (n, 2)."""
    flat = (np.pad(one, ((0, 0), (0, 1))) for one in (LAB_ANCHORS_M, positions_m))
    return dops_at(*flat, height_known=True)[:, 1]


def _dop_map(plan: Plan, results: Results) -> Found:  # noqa: ARG001
    x, y = (np.arange(low + _STEP_M / 2, high, _STEP_M) for low, high in ((0.0, 6.0), (0.0, 8.0)))
    positions_m = np.stack([axis.ravel() for axis in np.meshgrid(x, y)], axis=1)
    spots = np.array(list(_POSITIONS.values()))
    pdop, pdop_spots = pdop_at(positions_m), pdop_at(spots).tolist()
    sigma_m, sigma_spots = (np.array([_literal_std_m(at) for at in where]) for where in (positions_m, spots))
    field = sigma_m.reshape(len(y), len(x))
    asymmetry = float(np.stack([field / field[:, ::-1], field / field[::-1, :]]).max() - 1.0)
    table: Table = [("", "smallest", "median", "largest", *_POSITIONS)]
    numbers: dict[str, object] = {}
    for key, name, values, own, scale, digits in (
        ("pdop", "PDoP", pdop, pdop_spots, 1.0, (2, 2)),
        ("literal_sigma_m", "literal, predicted σ in cm", sigma_m, sigma_spots.tolist(), 100.0, (1, 2)),
    ):
        three = (values.min(), np.median(values), values.max())
        table.append(
            (
                name,
                *(f"{scale * value:.{digits[0]}f}" for value in three),
                *(f"{scale * value:.{digits[1]}f}" for value in own),
            )
        )
        numbers[key] = dict(zip(("min", "median", "max", "p1", "p2"), (*three, *own), strict=True))
    figures = {"correlation": float(np.corrcoef(pdop, sigma_m)[0, 1]), "asymmetry_pct": 100.0 * asymmetry}
    panels = [
        _map("06-pdop-map", "PDoP", (x, y, pdop), "PDoP for a known height; darker is better."),
        _map("06-sigma-map", "σ of literal in cm", (x, y, 100 * sigma_m), "Predicted σ of one fix of literal."),
    ]
    numbers |= {"correlation": figures["correlation"], "sigma_asymmetry": asymmetry}
    return Found(figures, table, panels, numbers)


def _map(name: str, title: str, field: tuple[Array, ...], caption: str) -> Panel:
    figure, axes = panel(title, 4.6)
    x, y, values = field
    grid_values = values.reshape(len(y), len(x))
    low, high = float(values.min()), float(np.percentile(values, 98))
    extent = (0.0, float(x[-1] + _STEP_M / 2), 0.0, float(y[-1] + _STEP_M / 2))
    image = axes.imshow(grid_values, MAP, origin="lower", extent=extent, vmin=low, vmax=high, interpolation="bilinear")
    axes.clabel(axes.contour(x, y, grid_values, 7, colors=MAP_WHITE, linewidths=0.7), fontsize=7.5)
    figure.colorbar(image, ax=axes, shrink=0.75, label=title, extend="max")
    draw_floor_plan(axes, _LAB_M, labels=False)
    for label, spot in _POSITIONS.items():
        axes.plot(*spot, "+", color=MAP_WHITE, markersize=9)
        axes.annotate(label, spot, (5, 5), textcoords="offset points", color=MAP_WHITE, fontsize=8.5)
    axes.set(xlim=(-0.4, 6.4), ylim=(-0.4, 8.4))
    return Panel(name, caption, figure)


# 7: three tags in their positioning phases.

_RECEIVERS_M: Final = ((3.0, 4.0), (1.2, 1.6), (4.6, 6.3))
_SWITCHED_ON_S: Final = (0.5, 0.512, 0.512)
"""The first receiver begins before the other two, which begin together."""
_MEASURED_S: Final = 2.5
"""Phases after this true time are timed: kernels are loaded and caches warm."""
_SHOWN_UNTIL_S: Final = 0.66
_LAST_ANCHOR: Final = 6
"""Its message completes a superframe."""


def _timeline_cells(plan: Plan) -> list[Cell]:
    """Three receivers for a few seconds."""
    tags = [
        TagSpec(Static(*position_m), outages=(Outage(0.0, on_s),))
        for position_m, on_s in zip(_RECEIVERS_M, _SWITCHED_ON_S, strict=True)
    ]
    site, until_s = paper_lab_site(RADIO_PS), 4.0 if plan.quick else 12.0
    return [Cell("timeline", partial(receptions, site, tags, ("literal",), plan.seed, until_s), 6.0)]


def phases_of(heard: Sequence[TimedReception]) -> list[tuple[float, TimedReception]]:
    """Phases that ended in a fix: arrival of the first message after the last fix, and reception of the last one."""
    phases: list[tuple[float, TimedReception]] = []
    begun: dict[int, float] = {}
    for one in heard:
        begun.setdefault(one.tag, one.arrival_s)
        if one.fixed:
            phases.append((begun.pop(one.tag), one))
    return phases


def _timeline(plan: Plan, results: Results) -> Found:  # noqa: ARG001
    heard: list[TimedReception] = results["timeline"]
    phases = phases_of(heard)
    firsts_s = [min(last.end_s for _, last in phases if last.tag == tag) for tag in range(len(_RECEIVERS_M))]
    settled = [(begin_s, last) for begin_s, last in phases if last.end_s > _MEASURED_S]
    table: Table = [
        ("receiver", "switched on at s", "first fix at s", "fixes per s", "processing in µs, median (95 %)")
    ]
    by_message: dict[float, list[float]] = {}
    for _, last in settled:
        by_message.setdefault(last.end_s, []).append(last.arrival_s)
    for tag, (on_s, first_s) in enumerate(zip(_SWITCHED_ON_S, firsts_s, strict=True)):
        cost = 1e6 * np.array([last.processing_s for _, last in settled if last.tag == tag])
        rate = len(cost) / (heard[-1].end_s - _MEASURED_S)
        measured = f"{np.median(cost):.0f} ({np.percentile(cost, 95):.0f}), measured here"
        table.append((str(tag + 1), f"{on_s:.3f}", f"{first_s:.3f}", f"{rate:.1f}", measured))
    possible = sum(one.anchor == _LAST_ANCHOR and one.end_s > _MEASURED_S for one in heard)
    figures = timeline_figures(len({last.tag for _, last in settled}), len(_RECEIVERS_M), len(settled), possible)
    processing_s = np.array([last.processing_s for _, last in settled])
    numbers = {
        "first_fix_s": firsts_s,
        "phase_s": float(np.median([last.end_s - begin_s for begin_s, last in settled])),
        "fixes": len(settled),
        "possible_fixes": possible,
        "arrival_spread_s": float(np.median([max(times) - min(times) for times in by_message.values()])),
        "measured": {
            "processing_median_s": float(np.median(processing_s)),
            "processing_p95_s": float(np.percentile(processing_s, 95)),
        },
    }
    return Found(figures, table, [_cold_start(phases)], numbers)


def timeline_figures(receivers: int, of: int, fixes: int, possible: int) -> Figures:
    """Receivers with fixes, and fixes, also as shares of the possible ones."""
    shares = {"receivers_share": receivers / of, "fixes_share": fixes / possible}
    return {"receivers": receivers, "of": of, "fixes": fixes, "possible": possible, **shares}


def _cold_start(phases: Sequence[tuple[float, TimedReception]]) -> Panel:
    lines: list[Line] = []
    for tag, on_s in enumerate(_SWITCHED_ON_S):
        own = [(begin_s, one.end_s) for begin_s, one in phases if one.tag == tag and one.end_s < _SHOWN_UNTIL_S]
        for number, span_s in enumerate(own):
            colour = METHOD_COLOURS["literal"] if number else GRID
            lines.append((span_s, (tag, tag), {"color": colour, "linewidth": 14.0, "solid_capstyle": "butt"}))
            lines.append((span_s[1:], (tag,), {"color": INK, "marker": "|", "markersize": 17}))
        lines.append(((on_s,), (tag,), {"color": GREEN, "marker": "v"}))
    names = [f"receiver {tag + 1}" for tag in range(len(_SWITCHED_ON_S))]
    axis = {"yticks": range(len(names)), "yticklabels": names, "ylim": (len(names) - 0.5, -0.5)}
    caption = (
        "Green: switched on. Grey: gathering the almanac and the first two rounds. Orange: a positioning phase, "
        "from the first message of a superframe to the fix (black)."
    )
    title = "From switching on to a fix in every superframe"
    return _plot("07-cold-start", title, caption, lines, axis | {"xlabel": "true time in s"})


# 8: the update rate.

_PAPER_HZ: Final = 67.0
_COUNTED_FROM_S: Final = 1.0
"""Updates count from this true time on."""


def rate_sites() -> dict[str, Site]:
    """The lab with its six slots of 2.5 ms, and seven nodes in slots of 2²⁷ ticks (2.1 ms), as short as the paper's."""
    lab = paper_lab_site(RADIO_PS)
    seven = replace(lab, anchors=(*lab.anchors, AnchorSite(id=7, x_m=3.0, y_m=8.0)), schedule=ScheduleSite())
    return {"six nodes, 2.5 ms": lab, "seven nodes, 2.1 ms": seven}


def _rate_cells(plan: Plan) -> list[Cell]:
    tags, until_s = [TagSpec(Static(3.0, 4.0))], _COUNTED_FROM_S + plan.rate_s
    return [
        Cell(f"rate/{name}", partial(receptions, site, tags, _METHODS, plan.seed, until_s), plan.rate_s * 0.05)
        for name, site in rate_sites().items()
    ]


def _rate(plan: Plan, results: Results) -> Found:
    counts: list[dict[str, Any]] = []
    for name, site in rate_sites().items():
        schedule = schedule_of(site)
        foreseen_hz = {"literal": schedule.superframe_rate_hz, "joint": schedule.messages_per_s(len(site.anchors))}
        for method in _METHODS:
            fixes = (one for one in results[f"rate/{name}"] if one.fixed and one.method == method)
            times_s = [one.end_s for one in fixes if one.end_s >= _COUNTED_FROM_S]
            rates = {"foreseen_hz": foreseen_hz[method], "longest_gap_s": float(np.diff(times_s).max())}
            count = {"site": name, "method": method, "updates": len(times_s), "counted_s": plan.rate_s, **rates}
            counts.append({**count, "rate_hz": len(times_s) / plan.rate_s})
    form = "{rate_hz:.1f}", "{foreseen_hz:.2f}", "{longest_gap_s:.5f}"
    table: Table = [("site", "method", "updates per s", "foreseen", "longest gap in s")]
    table += [(one["site"], one["method"], *(cell.format(**one) for cell in form)) for one in counts]
    bars = {
        f"{one['site'].split()[0]}, {one['method']}": (one["rate_hz"], METHOD_COLOURS[one["method"]]) for one in counts
    }
    lines, axis = _bars(bars)
    lines.append(((_PAPER_HZ, _PAPER_HZ), (-len(bars), 1), {"color": INK, "linestyle": "--"}))
    caption = "Counted updates: one per superframe (literal) and one per message (joint); dashed: the paper's 67."
    panels = [_plot("08-update-rate", "Updates of one tag", caption, lines, axis | {"xlabel": "updates per second"})]
    figures = {"superframe_hz": counts[0]["rate_hz"], "message_hz": counts[-1]["rate_hz"]}
    return Found(figures, table, panels, {"counts": counts})


# 9: for which stamp noise the largest of 30 000 errors stays below 20 cm.

_CLAIM_FIXES: Final = 30_000
"""Fixes per position in the paper."""
_FIT_FROM_PS: Final = 50.0
"""Below, rounding to ticks and the crystals' own noise flatten the curve."""


class Worst(Struct, frozen=True):
    """Errors of one method at one stamp noise."""

    method: str
    noise_ps: float
    seed: int
    fixes: int
    max_m: float
    rmse_m: float
    growth: float
    """How much larger the largest of ``_CLAIM_FIXES`` Gaussian errors of this covariance is than that of ``fixes``."""
    scatter: tuple[float, float]
    """5 % and 95 % of the largest of ``_CLAIM_FIXES`` independent errors of this covariance over its median."""


def _claim_cells(plan: Plan) -> list[Cell]:
    """A tag at P1 for each stamp noise but figure 4's, in a world of its own, heard by all methods."""
    tags = [(Static(*P1), dict.fromkeys(P1_METHODS, plan.fewer_fixes))]
    return [
        Cell(
            f"claim/{noise_ps:g}",
            partial(listen, paper_lab_site(noise_ps), tags, lab_impairments(noise_ps), _claim_seed(plan, noise_ps)),
            plan.fewer_fixes * 2e-3,
        )
        for noise_ps in plan.noises_ps
        if noise_ps != RADIO_PS
    ]


def _claim_seed(plan: Plan, noise_ps: float) -> int:
    """Seed of the world with this noise: figure 4's, or one of its own."""
    return plan.seed if noise_ps == RADIO_PS else plan.seed + 1 + plan.noises_ps.index(noise_ps)


def _worst_of(method: str, noise_ps: float, seed: int, error_m: Array) -> Worst:
    """Summary of the errors of a run, shape (n, 2)."""
    squared = (error_m**2).sum(axis=1)
    covariance_m2 = np.cov(error_m.T)
    low, middle, high = (largest_of_m(covariance_m2, _CLAIM_FIXES, q) for q in (0.05, 0.5, 0.95))
    growth = middle / largest_of_m(covariance_m2, len(error_m), 0.5)
    largest_m, rmse_m = float(squared.max() ** 0.5), float(squared.mean() ** 0.5)
    return Worst(method, noise_ps, seed, len(error_m), largest_m, rmse_m, growth, (low / middle, high / middle))


def largest_of_m(covariance_m2: Array, count: float, quantile: float) -> float:
    """Quantile of the largest radius of ``count`` independent zero-mean Gaussian vectors, covariance (2, 2).

    The radius' distribution is integrated over the angle: P(r > R) = mean over θ of exp(−R²/(2 s(θ)))·w(θ), with
    1/s(θ) the quadratic form of the inverse covariance along θ and w(θ) = s(θ)/√det.
    """
    angles = np.linspace(0.0, np.pi, 721)[:-1]
    along = np.stack([np.cos(angles), np.sin(angles)])
    variances_m2 = 1.0 / np.einsum("ia,ij,ja->a", along, np.linalg.inv(covariance_m2), along)
    weight = variances_m2 / np.sqrt(np.linalg.det(covariance_m2))
    exceed, most_m = -np.expm1(np.log(quantile) / count), 12.0 * float(np.sqrt(np.trace(covariance_m2)))
    least_m = 0.0
    for _ in range(50):
        middle_m = (least_m + most_m) / 2.0
        if np.mean(np.exp(-0.5 * middle_m**2 / variances_m2) * weight) > exceed:
            least_m = middle_m
        else:
            most_m = middle_m
    return most_m


class Trend(Struct, frozen=True):
    """Largest error of a typical run, coefficient·noise^exponent in metres, and how runs scatter about it."""

    coefficient: float
    exponent: float
    scatter: tuple[float, float]

    def largest_m(self, noise_ps: Array, factor: float = 1.0) -> Array:
        """Largest error of a run that is ``factor`` times a typical one."""
        return factor * self.coefficient * noise_ps**self.exponent

    @property
    def crossings_ps(self) -> tuple[float, float, float]:
        """Stamp noise at which an unlucky run (95 %), a typical one and a lucky one (5 %) reach the limit."""
        low, high = self.scatter
        unlucky, typical, lucky = (
            float((CLAIM_M / (factor * self.coefficient)) ** (1.0 / self.exponent)) for factor in (high, 1.0, low)
        )
        return unlucky, typical, lucky


def trend_of(rows: Sequence[Worst]) -> Trend:
    """Fit one method's largest errors from ``_FIT_FROM_PS`` on."""
    fitted = [row for row in rows if row.noise_ps >= _FIT_FROM_PS]
    noise, largest = np.array([(row.noise_ps, row.growth * row.max_m) for row in fitted]).T
    exponent, offset = np.polyfit(np.log(noise), np.log(largest), 1)
    low, high = np.mean([row.scatter for row in fitted], axis=0).tolist()
    return Trend(float(np.exp(offset)), float(exponent), (low, high))


def _claim(plan: Plan, results: Results) -> Found:
    rows: list[Worst] = []
    table: Table = [("stamp noise in ps", "seed", *(f"{method}: largest (RMSE), cm" for method in P1_METHODS))]
    for noise_ps in plan.noises_ps:
        tracks = results["static/noise" if noise_ps == RADIO_PS else f"claim/{noise_ps:g}"][0]
        seed = _claim_seed(plan, noise_ps)
        own = [_worst_of(method, noise_ps, seed, track.error_m) for method, track in tracks.items()]
        rows += own
        errors = (f"{100 * one.max_m:.1f} ({100 * one.rmse_m:.2f})" for one in own)
        table.append((f"{noise_ps:g}", str(seed), *errors))
    by_method = {method: [row for row in rows if row.method == method] for method in P1_METHODS}
    trends = {method: trend_of(found) for method, found in by_method.items()}
    crossings = {method: trend.crossings_ps for method, trend in trends.items()}
    ranges = (f"{typical:.0f} ps ({low:.0f} to {high:.0f})" for low, typical, high in crossings.values())
    table.append(("reaches 20 cm at", "", *ranges))
    most_ps = max(plan.noises_ps)
    beyond = " and ".join(method for method in P1_METHODS if crossings[method][1] > most_ps)
    extrapolated = f" Where the limit is reached by {beyond}, beyond {most_ps:g} ps, the power law is extrapolated."
    figures = {
        **{method: crossing[1] for method, crossing in crossings.items()},
        "others": len(plan.noises_ps) - 1,
        "extrapolated": extrapolated if beyond else "",
        "least_fixes": grouped(min(row.fixes for row in rows)),
        "seed": _claim_seed(plan, RADIO_PS),
    }
    crossing_ps = {name: {"typical": at, "from": low, "to": high} for name, (low, at, high) in crossings.items()}
    panels = [_largest(by_method, trends), _limits(crossings)]
    return Found(figures, table, panels, {"rows": rows, "crossing_ps": crossing_ps})


def _largest(by_method: dict[str, list[Worst]], trends: dict[str, Trend]) -> Panel:
    lines: list[Line] = []
    for method, rows in by_method.items():
        colour = {"color": METHOD_COLOURS[method]}
        curve_ps = np.linspace(_FIT_FROM_PS, max(row.noise_ps for row in rows), 60)
        for factor, style in ((1.0, "-"), *((factor, ":") for factor in trends[method].scatter)):
            largest_cm = 100 * trends[method].largest_m(curve_ps, factor)
            lines.append((curve_ps, largest_cm, {**colour, "linestyle": style, "linewidth": 1.0}))
        dots = np.array([(row.noise_ps, 100 * row.growth * row.max_m) for row in rows])
        lines.append((*dots.T, {**colour, "marker": "o", "linestyle": "", "markersize": 4.5, "label": method}))
    lines.append(((0.0, max(curve_ps)), (100 * CLAIM_M, 100 * CLAIM_M), {"color": INK, "linestyle": "--"}))
    caption = "Dots: simulated; lines: power laws fitted; between the dotted ones lie 90 % of runs. Dashed: 20 cm."
    axis = {"xlabel": "noise of every stamp in ps", "ylabel": f"largest of {grouped(_CLAIM_FIXES)} errors in cm"}
    return _plot("09-largest-error", "Largest error against stamp noise", caption, lines, axis)


def _limits(crossings: dict[str, tuple[float, float, float]]) -> Panel:
    lines, axis = _bars({method: (typical, METHOD_COLOURS[method]) for method, (_, typical, _) in crossings.items()})
    lines += [((low, high), (-row, -row), {"color": INK}) for row, (low, _, high) in enumerate(crossings.values())]
    for noise_ps, colour in ((PAPER_PS, GREEN), *((noise_ps, MUTED) for noise_ps in DW1000_PS)):
        lines.append(((noise_ps, noise_ps), (-len(crossings), 1), {"color": colour, "linestyle": ":"}))
    caption = (
        f"Largest stamp noise that keeps {grouped(_CLAIM_FIXES)} errors below 20 cm; black: where 90 % of runs lie. "
        "Dotted: the paper's ±15.65 ps (green), and what is reported for a DW1000."
    )
    axis["xlabel"] = "stamp noise at which 20 cm are reached, in ps"
    return _plot("09-limits", "Stamp noise that keeps the claim", caption, lines, axis)


# The table

_WORK: Final[dict[str, tuple[Callable[[Plan], list[Cell]], Callable[[Plan, Results], Found]]]] = {
    "scenario": (_scenario_cells, _scenario),
    "gamma-check": (_gamma_cells, _gamma),
    "dtdoa-distribution": (_distribution_cells, _distributions),
    "static-errors": (_static_cells, _static),
    "walking-test": (_walk_cells, _walk),
    "pdop-map": (lambda _: [], _dop_map),
    "three-receivers": (_timeline_cells, _timeline),
    "update-rate": (_rate_cells, _rate),
    "largest-error": (_claim_cells, _claim),
    "scaling": (_scale.cells, _scale.evaluated),
}
"""Cells of each claim, and their evaluation."""

CLAIMS: Final = msgspec.toml.decode(
    Path(__file__).with_suffix(".toml").read_bytes(), type=dict[str, tuple[Claim, ...]]
)["claim"]
