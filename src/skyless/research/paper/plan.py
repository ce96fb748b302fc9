"""Shared parts of the paper's figures: amounts, positions, noises, sections of the report, and simulations."""

import math
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from enum import IntEnum, StrEnum
from functools import reduce
from html import escape
from importlib.metadata import version
from typing import Any, Final, NamedTuple

import numpy as np
from matplotlib.figure import Figure
from msgspec import Struct

from skyless.core.any_receiver import AnyReceiver
from skyless.core.arrays import Array
from skyless.core.geometry import anchor_positions
from skyless.core.protocol1.anchor import Anchor
from skyless.core.protocol1.beacon import schedule_of
from skyless.core.protocol1.snapshots import (
    averaged_offset,
    protocol_interval,
    relative_offset,
    relative_rate,
    tag_rate,
    to_master,
)
from skyless.core.site import Site
from skyless.core.ticks import SPEED_OF_LIGHT_MPS, TICK_M, TICK_S
from skyless.machine import cores
from skyless.research.uncertainty import Chain
from skyless.sim.evaluation.figures import FirstFixes
from skyless.sim.evaluation.fleet import world_of
from skyless.sim.impairments import Impairments, lab_impairments
from skyless.sim.listening import TagSpec
from skyless.sim.trajectory import Trajectory
from skyless.sim.world import World
from skyless.site.report import page, svg_figure, table, text

Point = tuple[float, float]

P1: Final[Point] = (3.0, 4.0)
P2: Final[Point] = (1.2, 1.6)
"""Stand-ins for the paper's two static test positions, whose coordinates it does not give."""

RADIO_PS: Final = 100.0
"""Noise of every stamp where a figure does not vary it: the low end of what is reported for DW1000 stamps."""

PAPER_PS: Final = 15.65
"""The paper's largest stamp error, one tick."""

DW1000_PS: Final = (100.0, 150.0)
"""Range of a DW1000's stamp noise (``docs/radio.md``)."""

CLAIM_M: Final = 0.20
"""The paper's bound on the position error."""

P1_METHODS: Final = ("literal", "weighted", "bracketed", "joint")
"""Methods of the tag at P1: figure 4 shows some of them, figure 9 all."""

Results = Mapping[str, Any]
"""Results of the cells by their names."""


class Plan(Struct, frozen=True):
    """Sizes of the simulations."""

    seed: int
    quick: bool = False
    fixes: int = 30_000
    """Fixes, one per superframe, at each static position with the usual stamps."""
    fewer_fixes: int = 3_000
    """Fixes with stamps of other noises, with biased ones, or by methods that figure 4 does not show."""
    noises_ps: tuple[float, ...] = (5.2, PAPER_PS, 50.0, RADIO_PS, 150.0, 200.0, 300.0, 500.0)
    laps: int = 12
    """Rounds of the walking test."""
    fleet_sizes: tuple[int, ...] = (1, 10, 100, 1_000, 10_000)
    rate_s: float = 10.0
    """Simulated seconds over which updates are counted."""
    draws: int = 2_000_000
    """Monte Carlo draws per anchor and kind of noise."""


def plan_of(seed: int, *, quick: bool) -> Plan:
    """Amounts of the whole report, or of a quick one, which scatters more."""
    if not quick:
        return Plan(seed)
    return Plan(
        seed,
        quick,
        fixes=1_200,
        fewer_fixes=1_200,
        noises_ps=(PAPER_PS, 50.0, RADIO_PS, 200.0, 500.0),
        laps=2,
        fleet_sizes=(1, 10, 100),
        rate_s=3.0,
        draws=50_000,
    )


class Verdict(StrEnum):
    """Whether a statement of the paper holds."""

    HOLDS = "holds"
    CORRECTED = "holds with a correction"
    FAILS = "does not hold"


class Panel(Struct, frozen=True):
    """One picture."""

    name: str
    """Name of its files, without the ending."""
    caption: str
    figure: Figure


class Section(Struct, frozen=True):
    """A section of the report: a figure and the statement that it tests."""

    key: str
    title: str
    label: str
    """The paper's label of the figure or section."""
    claim: str
    """The paper's statement in other words."""
    simulated: str
    verdict: Verdict
    reason: str
    panels: tuple[Panel, ...]
    table: tuple[tuple[str, ...], ...]
    numbers: dict[str, object]
    """The same and more for programs, SI units in the names."""
    command: str
    """A command that reproduces the central number."""


Figures = dict[str, Any]
"""Figures that the rules and texts of a claim refer to."""
Table = list[tuple[str, ...]]
"""Rows of cells, the first one the heads."""


class Found(NamedTuple):
    """Evaluation of the results of a claim's cells."""

    figures: Figures
    table: Table
    panels: list[Panel]
    numbers: dict[str, object]


def grouped(count: int) -> str:
    """A whole number with thousands separated."""
    return f"{count:,}".replace(",", "\u00a0")


# The report as one HTML page.

_CLASSES: Final = {Verdict.HOLDS: "good", Verdict.CORRECTED: "mixed", Verdict.FAILS: "bad"}


def report_page(command: str, sections: Sequence[Section], pictures: dict[str, bytes], *, quick: bool) -> str:
    """The whole page; ``pictures`` are the panels' SVG files by their names."""
    parts = [_introduction(command, quick=quick), _summary(sections)]
    parts += [_section(number, section, pictures) for number, section in enumerate(sections, start=1)]
    return page("The paper, reproduced and corrected", parts)


def _introduction(command: str, *, quick: bool) -> str:
    note = (
        "<p><strong>This is the quick report</strong>: it simulates a fraction of what the full one does, so its "
        "numbers scatter more and its largest errors are smaller. Leave out <code>--quick</code> for the full "
        "one.</p>"
        if quick
        else ""
    )
    return (
        "<header>\n<p class='label'>Skyless " + escape(version("skyless")) + "</p>\n"
        "<h1>The paper, reproduced and corrected</h1>\n<p>Every figure and claim of L. Santoro, M. Nardello, D. "
        "Brunelli and D. Fontanelli, <cite>Scale up to infinity: the UWB Indoor Global Positioning System</cite> "
        "(ROSE 2021), reproduced in a simulated radio world and by Monte Carlo, each with the statement that it "
        "tests. Anchors and tags run the programs that would run on radios; clocks, noise, air and motion are "
        "simulated, and no radio was measured. Claims are in other words, with the paper’s labels.</p>\n<p>Made by "
        f"<code>{escape(command)}</code>. The same seed gives the same numbers, times measured on this "
        f"machine apart.</p>\n{note}\n</header>"
    )


def _summary(sections: Sequence[Section]) -> str:
    rows = "\n".join(
        f"<tr><td>{number}</td><td><a href='#{section.key}'>{escape(section.title)}</a></td>"
        f"<td>{_verdict(section.verdict)}</td></tr>"
        for number, section in enumerate(sections, start=1)
    )
    return f"<nav aria-label='Figures'><table class='summary'>\n{rows}\n</table></nav>"


def _section(number: int, section: Section, pictures: dict[str, bytes]) -> str:
    facts = (
        ("The paper", f"{text(section.claim)} <span class='label'>({escape(section.label)})</span>"),
        ("Simulated", text(section.simulated)),
        ("Verdict", f"{_verdict(section.verdict)}. {text(section.reason)}"),
        ("Again", f"<code>{escape(section.command)}</code>"),
    )
    listed = "\n".join(f"<dt>{name}</dt><dd>{fact}</dd>" for name, fact in facts)
    panels = "\n".join(svg_figure(pictures[panel.name], panel.name, panel.caption) for panel in section.panels)
    return (
        f"<section id='{section.key}'>\n<h2>{number} · {escape(section.title)}</h2>\n<dl>\n{listed}\n</dl>\n"
        f"<div class='panels'>\n{panels}\n</div>\n{table(section.table[0], section.table[1:])}\n</section>"
    )


def _verdict(verdict: Verdict) -> str:
    return f"<span class='verdict {_CLASSES[verdict]}'>{escape(verdict.capitalize())}</span>"


# Monte Carlo of the paper's chain: means, variances and covariances of any number of draws, in constant memory.
#
# One draw is one synchronisation of n anchors and one DTDoA of each, with noise on every stamp. The chain's functions
# are the program's own, of ``core/protocol1/snapshots.py``. Errors are taken against the same chain without noise.
# Ideal readings are float ticks; a hundred-thousandth of a tick is lost where clocks stand a second from their
# origins.
#
# The noise of a chunk of draws comes from NumPy's Philox generator, whose key is the seed and the chunk's number. So
# the draws depend on the seed alone, and sums have the same bits for any number of threads.

CHUNK_DRAWS: Final = 1 << 14
"""Draws with one key, which one thread sums up at a time."""
_BATCH_DRAWS: Final = 1 << 10
"""Draws that are computed at a time, few enough for the processor's cache."""

_SHARED_NOISES: Final = 4
"""Noises of a draw: the master's two synchronisation messages, its reference message, the tag's reception of it."""
_ANCHOR_NOISES: Final = 6
"""Noises of each anchor in a draw: its two receptions, its two transmissions, the tag's receptions of these."""


class Quantity(IntEnum):
    """Quantities of a draw for each anchor: the rows of ``errors``."""

    BETA = 0
    GAMMA_FIRST = 1
    GAMMA_DELAYED = 2
    GAMMA_AVERAGED = 3
    EPSILON_FIRST = 4
    EPSILON_DELAYED = 5
    XI = 6
    PHI = 7
    LAMBDA = 8


_UNITS: Final = np.array([1.0, *[TICK_S] * 5, 1.0, TICK_S, TICK_M])[:, None]
"""From ticks to what ``ChainMoments`` gives, by ``Quantity``."""


def run_chain(chain: Chain, noise: Array) -> Array:
    """Every quantity of the chain in ticks, shape (quantities, draws, n), for stamps with ``noise`` of unit variance.

    ``noise``: shape (draws, numbers of a draw).
    """
    c, n = chain, len(chain.anchor_rate)
    shared, own = noise[:, :_SHARED_NOISES, None], noise[:, _SHARED_NOISES:].reshape(-1, n, _ANCHOR_NOISES)

    def master(true_s: float, noise: Array) -> Any:  # noqa: ANN401 - arrays, for functions of numbers
        return (c.master_offset_s + c.master_rate * true_s + c.sigma_master_s * noise) / TICK_S

    def anchor(true_s: Array, noise: Array) -> Any:  # noqa: ANN401
        return (c.anchor_offset_s + c.anchor_rate * true_s + c.sigma_anchor_s * noise) / TICK_S

    def tag(true_s: float | Array, noise: Array) -> Any:  # noqa: ANN401
        return (c.tag_offset_s + c.tag_rate * true_s + c.sigma_tag_s * noise) / TICK_S

    second_s, sent_s = c.sync_s + c.sync_spacing_s, c.reference_s + c.delay_s
    m1, m2 = master(c.sync_s, shared[:, 0]), master(second_s, shared[:, 1])
    tm = master(c.reference_s, shared[:, {c.sync_s: 0, second_s: 1}.get(c.reference_s, 2)])
    rm = tag(c.reference_s + c.tag_master_tof_s, shared[:, 3])
    s1, s2 = anchor(c.sync_s + c.anchor_tof_s, own[..., 0]), anchor(second_s + c.anchor_tof_s, own[..., 1])
    a1, a2 = anchor(sent_s, own[..., 2]), anchor(sent_s + c.spacing_s, own[..., 3])
    r1, r2 = tag(sent_s + c.tag_tof_s, own[..., 4]), tag(sent_s + c.spacing_s + c.tag_tof_s, own[..., 5])
    tof: Any = c.anchor_tof_s / TICK_S
    rate = relative_rate(s2 - s1, m2 - m1)
    first, delayed = relative_offset(s1, m1, rate, tof), relative_offset(s2, m2, rate, tof)
    offset = averaged_offset(first, delayed)
    sent1, sent2 = to_master(a1, rate, offset), to_master(a2, rate, offset)
    tags_rate = tag_rate(r2 - r1, sent2 - sent1)
    interval = protocol_interval(tags_rate, sent1, tm)
    return np.array([rate, first, delayed, offset, sent1, sent2, tags_rate, interval, (r1 - rm) - interval])


def ideal_values(chain: Chain) -> Array:
    """Every quantity of the chain without noise, shape (quantities, n)."""
    return run_chain(chain, np.zeros((1, noise_size(chain))))[:, 0]


def noise_size(chain: Chain) -> int:
    """Numbers of one draw."""
    return _SHARED_NOISES + _ANCHOR_NOISES * len(chain.anchor_rate)


def noise_batches(seed: int, chunk: int, draws: int, size: int, *, uniform: bool) -> Iterator[Array]:
    """Noise of the first draws of a chunk, of mean 0 and variance 1, shape (up to ``_BATCH_DRAWS``, ``size``) each."""
    generator = np.random.Generator(np.random.Philox(key=np.array([seed, chunk], np.uint64)))
    bound = math.sqrt(3.0)
    for first in range(0, draws, _BATCH_DRAWS):
        shape = min(_BATCH_DRAWS, draws - first), size
        yield generator.uniform(-bound, bound, shape) if uniform else generator.standard_normal(shape)


class ChainMoments(Struct, frozen=True):
    """Results of the draws of a chain; rows in the order of ``Quantity``, one column for each anchor.

    Rates are pure numbers, λ is in metres, all else in seconds.
    """

    draws: int
    mean: Array
    """Shape (quantities, n); zero to first order."""
    variance: Array
    """Shape (quantities, n), about the mean."""
    fourth: Array
    """Mean fourth power, shape (quantities, n); about zero, from which the mean differs by very little."""
    epsilon_covariance_s2: Array
    """E[ε(t_i)·ε(t_i + Δ_i)], shape (n,)."""
    lambda_covariance_m2: Array
    """Covariance of the TDoAs of all anchors, shape (n, n)."""

    @property
    def std(self) -> Array:
        """Standard deviations, shape (quantities, n)."""
        return np.sqrt(self.variance)

    @property
    def std_relative_error(self) -> Array:
        """Standard error of the standard deviations over themselves: 1/√(2·draws) for Gaussian errors."""
        excess: Array = np.maximum(self.fourth / self.variance**2 - 1.0, 0.0)
        error: Array = np.sqrt(excess / self.draws) / 2.0
        return error


def draw_moments(
    chain: Chain, seed: int, draws: int, *, uniform: bool = False, threads: int | None = None
) -> ChainMoments:
    """Moments of every quantity of the chain over ``draws`` (at least 2) draws.

    ``uniform``: noise uniform within ±√3·σ instead of Gaussian. ``threads``: as many as the machine has unless given.
    """

    def sums_of(chunk: tuple[int, int]) -> tuple[Array, ...]:
        return _total(_sums(errors) for errors in _errors(chain, seed, chunk, uniform=uniform))

    with ThreadPoolExecutor(threads or cores()) as pool:
        sums = _total(pool.map(sums_of, _chunks(draws)))
    first, second, fourth, epsilon, lambdas = (one / draws for one in sums)
    return ChainMoments(
        draws=draws,
        mean=first * _UNITS,
        variance=(second - first**2) * (draws / (draws - 1)) * _UNITS**2,
        fourth=fourth * _UNITS**4,
        epsilon_covariance_s2=(epsilon - first[Quantity.EPSILON_FIRST] * first[Quantity.EPSILON_DELAYED]) * TICK_S**2,
        lambda_covariance_m2=(lambdas - np.outer(first[Quantity.LAMBDA], first[Quantity.LAMBDA])) * TICK_M**2,
    )


def draw_lambdas(chain: Chain, seed: int, draws: int, *, uniform: bool = False) -> Iterator[Array]:
    """Errors of the DTDoAs of the draws that ``draw_moments`` makes, in metres, shape (up to a batch, n) each."""
    for chunk in _chunks(draws):
        for errors in _errors(chain, seed, chunk, uniform=uniform):
            yield errors[Quantity.LAMBDA] * TICK_M


def _chunks(draws: int) -> Iterator[tuple[int, int]]:
    """Number and draws of every chunk."""
    for chunk in range(-(-draws // CHUNK_DRAWS)):
        yield chunk, min(CHUNK_DRAWS, draws - chunk * CHUNK_DRAWS)


def _errors(chain: Chain, seed: int, chunk: tuple[int, int], *, uniform: bool) -> Iterator[Array]:
    """Errors of every quantity of a chunk's draws, shape (quantities, up to a batch, n) each."""
    ideal = ideal_values(chain)[:, None]
    for noise in noise_batches(seed, *chunk, noise_size(chain), uniform=uniform):
        yield run_chain(chain, noise) - ideal


def _sums(errors: Array) -> tuple[Array, ...]:
    """First, second and fourth powers, products of both ε, and products of all λ, over the draws."""
    squares, of_lambda = errors**2, errors[Quantity.LAMBDA]
    products = errors[Quantity.EPSILON_FIRST] * errors[Quantity.EPSILON_DELAYED]
    powers = (errors.sum(axis=1), squares.sum(axis=1), (squares**2).sum(axis=1))
    return *powers, products.sum(axis=0), of_lambda.T @ of_lambda


def _total(parts: Iterable[tuple[Array, ...]]) -> tuple[Array, ...]:
    """Element-wise sums of all parts, in order."""
    return reduce(lambda whole, part: tuple(map(np.add, whole, part)), parts)


# Tags in the lab's world that compute with several methods from the same receptions.

_WARMUP_S: Final = 2.0
"""Fixes before this true time are not judged: the filters settle."""


class Track(Struct, frozen=True):
    """Fixes of one tag by one method, one per superframe, and the truth."""

    time_s: Array
    """Shape (n,): true time at which the fix was made."""
    position_m: Array
    """Shape (n, 2)."""
    truth_m: Array
    """Shape (n, 2): where the tag was at the emission of the last message."""

    @property
    def error_m(self) -> Array:
        """Position less truth, shape (n, 2)."""
        return self.position_m - self.truth_m


def listen(
    site: Site,
    tags: Sequence[tuple[Trajectory, Mapping[str, int]]],
    impairments: Impairments,
    seed: int,
    until_s: float | None = None,
) -> list[dict[str, Track]]:
    """Run a world for so long that every method of every tag can have its fixes, or until ``until_s``.

    ``tags``: how each moves, the methods with which it computes, and how many fixes each of them makes.

    Returns for each tag its track by each method. A world gives its first tag the same stamps with and without
    other tags, so ``skyless simulate`` with the same seed reproduces the first tag's figures.
    """
    world = world_of(site, [trajectory for trajectory, _ in tags], impairments, seed)
    superframe_s = 1.0 / schedule_of(site).superframe_rate_hz
    listeners = [
        [
            (AnyReceiver(method), FirstFixes(site, 1), list[tuple[float, ...]](), most)
            for method, most in methods.items()
        ]
        for _, methods in tags
    ]
    most_fixes = max(most for _, methods in tags for most in methods.values())
    end_s = until_s if until_s is not None else _WARMUP_S + 1.02 * most_fixes * superframe_s + 1.0
    for broadcast in world.run(end_s):
        for tag, reception, truth_m in broadcast.receptions():
            for receiver, first_fixes, rows, most in listeners[tag]:
                at_s, fix = broadcast.end_s, receiver.hear(reception) if len(rows) < most else None
                if fix is not None and at_s >= _WARMUP_S and first_fixes.is_first(0, at_s):
                    rows.append((at_s, *fix.position_m[:2].tolist(), *truth_m[:2].tolist()))
    return [
        {
            method: Track(columns[:, 0], columns[:, 1:3], columns[:, 3:])
            for method, (_, _, rows, _) in zip(methods, own, strict=True)
            for columns in [np.array(rows).reshape(-1, 5)]
        }
        for (_, methods), own in zip(tags, listeners, strict=True)
    ]


class TimedReception(Struct, frozen=True):
    """One reception of one tag, by one method."""

    tag: int
    method: str
    anchor: int
    arrival_s: float
    """True time at which the frame's RMARKER arrived."""
    end_s: float
    """True time at which the frame ended."""
    fixed: bool
    processing_s: float
    """CPU time of the reception, measured on this machine."""


def receptions(
    site: Site, tags: Sequence[TagSpec], methods: Sequence[str], seed: int, until_s: float
) -> list[TimedReception]:
    """All receptions of tags until a true time, and by which methods they gave a fix."""
    world = World(site, lambda anchor: Anchor(site, anchor), tags, lab_impairments(RADIO_PS), seed)
    receivers = [{method: AnyReceiver(method) for method in methods} for _ in tags]
    anchors_m = dict(zip((anchor.id for anchor in site.anchors), anchor_positions(site), strict=True))
    heard = []
    for broadcast in world.run(until_s):
        for tag, reception, truth_m in broadcast.receptions():
            flight_s = float(np.linalg.norm(truth_m - anchors_m[broadcast.anchor])) / SPEED_OF_LIGHT_MPS
            at_s = broadcast.emission_s + flight_s, broadcast.end_s
            for method, receiver in receivers[tag].items():
                begun_s = time.perf_counter()
                has_fix = receiver.hear(reception) is not None
                spent_s = time.perf_counter() - begun_s
                heard.append(TimedReception(tag, method, broadcast.anchor, *at_s, has_fix, spent_s))
    return heard
