"""The report as one HTML page that needs nothing else: pictures inline, no script, bright and dark, paper and phone."""

import re
from collections.abc import Sequence
from html import escape
from typing import Final

from msgspec import Struct

from skyless.evaluation.figures import GRID, INK, MUTED, PAPER
from skyless.paper.section import Panel, Section, Verdict

_STYLE: Final = """
:root { color-scheme: light dark; --paper: #ffffff; --ink: #1f2933; --muted: #5f6b7a; --grid: #d9dee5; --soft: #f3f5f8;
  --good: #14724f; --mixed: #8a5600; --bad: #b02a3c; --link: #1d66a8; }
@media (prefers-color-scheme: dark) { :root { --paper: #14181d; --ink: #e4e9ef; --muted: #9aa7b5; --grid: #333c47;
  --soft: #1c2229; --good: #4cc296; --mixed: #e3a74a; --bad: #f0808e; --link: #7db8ee; } }
@media print { :root { --paper: #ffffff; --ink: #1f2933; --muted: #5f6b7a; --grid: #d9dee5; --soft: #f3f5f8;
  --good: #14724f; --mixed: #8a5600; --bad: #b02a3c; --link: #1f2933; }
  figure, tr, dl { break-inside: avoid; } h2 { break-after: avoid; } body { font-size: 10pt; padding: 0; } }
* { box-sizing: border-box; }
body { margin: 0 auto; padding: 1.2rem clamp(0.9rem, 4vw, 2.5rem) 4rem; max-width: 68rem; overflow-wrap: break-word;
  background: var(--paper); color: var(--ink); font: 1rem/1.55 system-ui, "Segoe UI", "DejaVu Sans", sans-serif; }
h1 { font-size: clamp(1.5rem, 5vw, 2.1rem); line-height: 1.2; margin: 0.6rem 0; }
h2 { font-size: 1.3rem; line-height: 1.3; margin: 0 0 0.4rem; }
p { margin: 0.5rem 0; max-width: 46rem; }
a { color: var(--link); }
code { font: 0.86em ui-monospace, "DejaVu Sans Mono", monospace; background: var(--soft); padding: 0.1em 0.35em;
  border-radius: 0.25em; }
section { border-top: 1px solid var(--grid); margin-top: 2.2rem; padding-top: 1.4rem; }
dl { display: grid; grid-template-columns: 6rem minmax(0, 1fr); gap: 0.35rem 1rem; margin: 0.8rem 0; max-width: 56rem; }
dt { color: var(--muted); } dd { margin: 0; }
@media (max-width: 34rem) { dl { grid-template-columns: 1fr; gap: 0.1rem; } dd { margin-bottom: 0.5rem; } }
.label { color: var(--muted); font-size: 0.88rem; }
.verdict { font-weight: 650; }
.holds { color: var(--good); } .corrected { color: var(--mixed); } .fails { color: var(--bad); }
.panels { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(100%, 21rem), 1fr)); gap: 1rem 1.6rem;
  margin: 1.1rem 0; }
figure { margin: 0; } figure svg { display: block; width: 100%; max-width: 34rem; height: auto; }
figcaption { color: var(--muted); font-size: 0.88rem; line-height: 1.4; margin-top: 0.3rem; max-width: 34rem; }
.scroll { overflow-x: auto; } .scroll td { white-space: nowrap; }
table { border-collapse: collapse; font-size: 0.88rem; font-variant-numeric: tabular-nums; }
th, td { text-align: left; padding: 0.25rem 0.9rem 0.25rem 0; vertical-align: top; }
th, td { border-bottom: 1px solid var(--grid); }
th { color: var(--muted); font-weight: 500; } .summary td { padding: 0.4rem 0.9rem 0.4rem 0; }
@media print { .panels { grid-template-columns: 1fr 1fr; } .scroll td { white-space: normal; } }
"""

_THEMED: Final = {INK: "var(--ink)", MUTED: "var(--muted)", GRID: "var(--grid)", PAPER: "var(--paper)"}
_CLASSES: Final = {Verdict.HOLDS: "holds", Verdict.CORRECTED: "corrected", Verdict.FAILS: "fails"}


class Heading(Struct, frozen=True):
    """What stands above the figures."""

    seed: int
    quick: bool
    version: str
    command: str


def page(heading: Heading, sections: Sequence[Section], pictures: dict[str, bytes]) -> str:
    """The whole page; ``pictures`` are the panels' SVG files by their names."""
    parts = [_introduction(heading), _summary(sections)]
    parts += [_section(number, section, pictures) for number, section in enumerate(sections, start=1)]
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>The paper, reproduced and corrected</title>\n<style>{_STYLE}</style>\n</head>\n<body>\n"
        + "\n".join(parts)
        + "\n</body>\n</html>\n"
    )


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
        "(ROSE 2021), made again in a simulated radio world and by Monte Carlo, each beside the statement that it "
        "tests. Anchors and tags run the programs that would run on radios; clocks, noise, air and motion are "
        "simulated, and no radio was measured. Claims are retold, with the paper’s labels.</p>\n<p>Made by "
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
        ("The paper", f"{_text(section.claim)} <span class='label'>({escape(section.label)})</span>"),
        ("Simulated", _text(section.simulated)),
        ("Verdict", f"{_verdict(section.verdict)}. {_text(section.reason)}"),
        ("Again", f"<code>{escape(section.command)}</code>"),
    )
    listed = "\n".join(f"<dt>{name}</dt><dd>{text}</dd>" for name, text in facts)
    panels = "\n".join(_figure(panel, pictures[panel.name]) for panel in section.panels)
    return (
        f"<section id='{section.key}'>\n<h2>{number} · {escape(section.title)}</h2>\n<dl>\n{listed}\n</dl>\n"
        f"<div class='panels'>\n{panels}\n</div>\n{_table(section.table)}\n</section>"
    )


def _text(words: str) -> str:
    """Words for the page: true minus signs, and no line ends between a number and its unit."""
    words = re.sub(r"(?<![\w-])-(?=\d)", "−", words)
    return escape(re.sub(r"(?<=\d) (?=(%|mm|cm|m|ps|µs|ms|s|Hz|ppm|m/s)\b|%)", "\u00a0", words))


def _verdict(verdict: Verdict) -> str:
    return f"<span class='verdict {_CLASSES[verdict]}'>{escape(verdict.capitalize())}</span>"


def _figure(panel: Panel, svg: bytes) -> str:
    drawing = inline_svg(svg, panel.name, panel.caption)
    return f"<figure>\n{drawing}\n<figcaption>{_text(panel.caption)}</figcaption>\n</figure>"


def _table(rows: Sequence[Sequence[str]]) -> str:
    heads = "".join(f"<th scope='col'>{escape(cell)}</th>" for cell in rows[0])
    body = "\n".join("<tr>" + "".join(f"<td>{_text(cell)}</td>" for cell in row) + "</tr>" for row in rows[1:])
    table = f"<table>\n<thead><tr>{heads}</tr></thead>\n<tbody>\n{body}\n</tbody>\n</table>"
    return f"<div class='scroll' tabindex='0'>{table}</div>"


def inline_svg(svg: bytes, name: str, description: str) -> str:
    """An SVG file as an element of the page: identifiers of its own, the page's colours, no metadata."""
    text = svg.decode()
    text = text[text.index("<svg") :].strip()
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    text = re.sub(r' xmlns(:\w+)?="[^"]*"', "", text)
    text = re.sub(r'(<svg[^>]*?) width="[^"]*" height="[^"]*"', r"\1", text, count=1)
    text = re.sub(r'(<svg[^>]*?) height="[^"]*"([^>]*?) width="[^"]*"', r"\1\2", text, count=1)
    text = re.sub(r'\bid="([^"]*)"', rf'id="{name}-\1"', text)
    text = re.sub(r"url\(#([^)]*)\)", rf"url(#{name}-\1)", text)
    text = re.sub(r'(xlink:)?href="#([^"]*)"', rf'href="#{name}-\2"', text)
    text = text.replace('xlink:href="data:', 'href="data:')
    for colour, variable in _THEMED.items():
        text = text.replace(colour, variable)
    label = escape(description, quote=True)
    return text.replace("<svg", f'<svg role="img" aria-label="{label}"', 1)
