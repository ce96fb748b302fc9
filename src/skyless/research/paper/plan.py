"""What the figures of the report share: amounts, positions, noises, and the pieces that a figure consists of."""

from collections.abc import Mapping, Sequence
from enum import StrEnum
from html import escape
from typing import Any, Final

import numpy as np
from matplotlib.figure import Figure
from msgspec import Struct

from skyless.core.arrays import Array
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
"""What the tag at P1 computes with: figure 4 shows some of them, figure 9 all."""

Results = Mapping[str, Any]
"""What the tasks returned, by their names."""


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
    """The whole report, or one that is ready in seconds and scatters more."""
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
    """A figure and the statement that it tests."""

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
    """Rows of cells, the first one the heads."""
    numbers: dict[str, object]
    """The same and more for programs, SI units in the names."""
    command: str
    """A command that reproduces the central number."""


def gaussian(values: Array, std: float, mean: float = 0.0) -> Array:
    """Density of a Gaussian at some values."""
    density: Array = np.exp(-0.5 * ((values - mean) / std) ** 2) / (std * np.sqrt(2.0 * np.pi))
    return density


def grouped(count: int) -> str:
    """A whole number with thousands separated."""
    return f"{count:,}".replace(",", "\u00a0")


# The report as one HTML page.

_CLASSES: Final = {Verdict.HOLDS: "good", Verdict.CORRECTED: "mixed", Verdict.FAILS: "bad"}


class Heading(Struct, frozen=True):
    """What stands above the figures."""

    seed: int
    quick: bool
    version: str
    command: str


def report_page(heading: Heading, sections: Sequence[Section], pictures: dict[str, bytes]) -> str:
    """The whole page; ``pictures`` are the panels' SVG files by their names."""
    parts = [_introduction(heading), _summary(sections)]
    parts += [_section(number, section, pictures) for number, section in enumerate(sections, start=1)]
    return page("The paper, reproduced and corrected", parts)


def _introduction(heading: Heading) -> str:
    quick = (
        "<p><strong>This is the quick report</strong>: it simulates a fraction of what the full one does, so its "
        "numbers scatter more and its largest errors are smaller. Leave out <code>--quick</code> for the full "
        "one.</p>"
        if heading.quick
        else ""
    )
    return (
        "<header>\n<p class='label'>Skyless " + escape(heading.version) + "</p>\n"
        "<h1>The paper, reproduced and corrected</h1>\n<p>Every figure and claim of L. Santoro, M. Nardello, D. "
        "Brunelli and D. Fontanelli, <cite>Scale up to infinity: the UWB Indoor Global Positioning System</cite> "
        "(ROSE 2021), reproduced in a simulated radio world and by Monte Carlo, each with the statement that it "
        "tests. Anchors and tags run the programs that would run on radios; clocks, noise, air and motion are "
        "simulated, and no radio was measured. Claims are in other words, with the paper’s labels.</p>\n<p>Made by "
        f"<code>{escape(heading.command)}</code>. The same seed gives the same numbers, times measured on this "
        f"machine apart.</p>\n{quick}\n</header>"
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
