"""The report as one HTML page."""

from collections.abc import Sequence
from html import escape
from typing import Final

from msgspec import Struct

from skyless.research.paper.plan import Section, Verdict
from skyless.site.report import page, svg_figure, table, text

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
