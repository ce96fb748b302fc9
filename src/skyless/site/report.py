"""Self-contained HTML reports, and the style of their pictures."""

import base64
import io
import re
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from html import escape
from typing import Any, Final

from cycler import cycler
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

# Figures: one style, with sizes for a phone's width and colours for a bright and a dark page.

INK: Final = "#1f2933"
MUTED: Final = "#5f6b7a"
GRID: Final = "#d9dee5"
PAPER: Final = "#ffffff"
"""These four are replaced on a dark page; the others are visible on both."""

MAP_WHITE: Final = "#fdfdfd"
"""White of maps, the same on both pages."""

BLUE: Final = "#2f86d0"
ORANGE: Final = "#dd7a1f"
GREEN: Final = "#1f9d73"
PURPLE: Final = "#a56bc4"
RED: Final = "#d1495b"

METHOD_COLOURS: Final = {"literal": ORANGE, "weighted": PURPLE, "bracketed": GREEN, "joint": BLUE}
MAP: Final = "viridis"

_RC: Final[dict[Any, Any]] = {
    "font.family": "sans-serif",
    "font.size": 9.0,
    "axes.titlesize": 9.5,
    "axes.titleweight": "bold",
    "axes.labelsize": 9.0,
    "legend.fontsize": 8.0,
    "xtick.labelsize": 8.0,
    "ytick.labelsize": 8.0,
    "text.color": INK,
    "axes.titlecolor": INK,
    "axes.labelcolor": INK,
    "axes.edgecolor": MUTED,
    "xtick.color": MUTED,
    "ytick.color": MUTED,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "axes.facecolor": PAPER,
    "figure.facecolor": PAPER,
    "legend.facecolor": PAPER,
    "legend.edgecolor": GRID,
    "legend.framealpha": 0.9,
    "axes.grid": True,
    "grid.color": GRID,
    "grid.linewidth": 0.6,
    "axes.axisbelow": True,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.prop_cycle": cycler(color=[BLUE, ORANGE, GREEN, PURPLE, RED]),
    "axes.unicode_minus": True,
    "lines.linewidth": 1.4,
    "svg.fonttype": "none",
    "svg.hashsalt": "skyless",
}


@contextmanager
def report_style() -> Iterator[None]:
    """Draw and save everything within the block in the style of the reports."""
    with rc_context(_RC):
        yield


def panel(title: str, height_in: float = 3.5) -> tuple[Figure, Axes]:
    """Create an empty figure of the report's width with one pair of axes."""
    figure = Figure(figsize=(4.7, height_in), layout="constrained")
    axes = figure.subplots()
    axes.set_title(title, loc="left")
    return figure, axes


def draw_floor_plan(axes: Axes, anchors_m: list[tuple[float, float]], *, labels: bool = True) -> None:
    """Draw the lab's walls and anchors, of which the first is the master, in metres."""
    x, y = zip(*anchors_m, strict=True)
    left, right, low, high = min(x), max(x), min(y), max(y)
    axes.plot([left, right, right, left, left], [low, low, high, high, low], color=MUTED, linewidth=1.0, zorder=1)
    axes.plot(x[1:], y[1:], "s", color=INK, markersize=6, clip_on=False, zorder=5)
    axes.plot(x[:1], y[:1], "D", color=RED, markersize=7, clip_on=False, zorder=5)
    if labels:
        for number, (at_x, at_y) in enumerate(anchors_m, start=1):
            inwards = (9 if at_x < (left + right) / 2 else -9, 8 if at_y < high else -8)
            name = "1 (master)" if number == 1 else str(number)
            side = "left" if inwards[0] > 0 else "right"
            axes.annotate(
                name,
                (at_x, at_y),
                inwards,
                ha=side,
                va="center",
                textcoords="offset points",
                fontsize=8.0,
                color=INK,
                zorder=6,
            )
    axes.set(xlabel="x in m", ylabel="y in m", aspect="equal")
    axes.grid(visible=False)


def picture(figure: Figure, kind: str, dpi: float = 130.0) -> bytes:
    """Render a figure to a file of this kind; the same figure always gives the same bytes.

    Raises ValueError: there is no such kind.
    """
    FigureCanvasAgg(figure)
    file = io.BytesIO()
    undated = {"Date": None} if kind == "svg" else None
    figure.savefig(file, format=kind, dpi=dpi, metadata=undated)
    return file.getvalue()


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
h2 { font-size: 1.3rem; line-height: 1.3; margin: 1.4rem 0 0.4rem; } section h2 { margin-top: 0; }
p { margin: 0.5rem 0; max-width: 46rem; }
a { color: var(--link); }
code { font: 0.86em ui-monospace, "DejaVu Sans Mono", monospace; background: var(--soft); padding: 0.1em 0.35em;
  border-radius: 0.25em; }
section { border-top: 1px solid var(--grid); margin-top: 2.2rem; padding-top: 1.4rem; }
dl { display: grid; grid-template-columns: 6rem minmax(0, 1fr); gap: 0.35rem 1rem; margin: 0.8rem 0; max-width: 56rem; }
dt { color: var(--muted); } dd { margin: 0; }
@media (max-width: 34rem) { dl { grid-template-columns: 1fr; gap: 0.1rem; } dd { margin-bottom: 0.5rem; } }
.warning { color: var(--mixed); } .note { color: var(--muted); }
.label { color: var(--muted); font-size: 0.88rem; }
.verdict { font-weight: 650; }
.good { color: var(--good); } .mixed { color: var(--mixed); } .bad { color: var(--bad); }
.panels { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(100%, 21rem), 1fr)); gap: 1rem 1.6rem;
  margin: 1.1rem 0; }
figure { margin: 0; } figure svg { display: block; width: 100%; max-width: 34rem; height: auto; }
figure img { display: block; max-width: 100%; height: auto; border: 1px solid var(--grid); }
figcaption { color: var(--muted); font-size: 0.88rem; line-height: 1.4; margin-top: 0.3rem; max-width: 34rem; }
.scroll { overflow-x: auto; } .scroll td { white-space: nowrap; }
table { border-collapse: collapse; font-size: 0.88rem; font-variant-numeric: tabular-nums; }
th, td { text-align: left; padding: 0.25rem 0.9rem 0.25rem 0; vertical-align: top; }
th, td { border-bottom: 1px solid var(--grid); }
th { color: var(--muted); font-weight: 500; } .summary td { padding: 0.4rem 0.9rem 0.4rem 0; }
@media print { .panels { grid-template-columns: 1fr 1fr; } .scroll td { white-space: normal; } }
"""

_THEMED: Final = {INK: "var(--ink)", MUTED: "var(--muted)", GRID: "var(--grid)", PAPER: "var(--paper)"}


def page(title: str, parts: Iterable[str]) -> str:
    """The whole HTML page from parts that are HTML."""
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(title)}</title>\n<style>{_STYLE}</style>\n</head>\n<body>\n"
        + "\n".join(parts)
        + "\n</body>\n</html>\n"
    )


def text(words: str) -> str:
    """Escape words for HTML, with true minus signs and no line breaks between a number and its unit."""
    words = re.sub(r"(?<![\w-])-(?=\d)", "−", words)
    return escape(re.sub(r"(?<=\d) (?=(%|mm|cm|m|ps|µs|ms|s|Hz|ppm|m/s)\b|%)", "\u00a0", words))


def table(heads: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """An HTML table that scrolls on narrow pages; ``heads`` may be empty."""
    head = "".join(f"<th scope='col'>{escape(cell)}</th>" for cell in heads)
    body = "\n".join("<tr>" + "".join(f"<td>{text(cell)}</td>" for cell in row) + "</tr>" for row in rows)
    table_head = f"<thead><tr>{head}</tr></thead>\n" if head else ""
    return f"<div class='scroll' tabindex='0'><table>\n{table_head}<tbody>\n{body}\n</tbody>\n</table></div>"


def bullets(entries: Iterable[str], kind: str) -> str:
    """An HTML list; ``kind``: class in the page's style."""
    return "<ul>" + "".join(f'<li class="{kind}">{text(entry)}</li>\n' for entry in entries) + "</ul>"


def png_figure(png: bytes, description: str) -> str:
    """An HTML figure with an embedded PNG file."""
    data = base64.b64encode(png).decode()
    return f'<figure><img alt="{escape(description)}" src="data:image/png;base64,{data}"></figure>'


def svg_figure(svg: bytes, name: str, caption: str) -> str:
    """An HTML figure with an SVG file and a caption below."""
    return f"<figure>\n{inline_svg(svg, name, caption)}\n<figcaption>{text(caption)}</figcaption>\n</figure>"


def inline_svg(svg: bytes, name: str, description: str) -> str:
    """An SVG file as inline markup, with unique identifiers, the page's colours and no metadata."""
    markup = svg.decode()
    markup = markup[markup.index("<svg") :].strip()
    markup = re.sub(r"<metadata>.*?</metadata>", "", markup, flags=re.DOTALL)
    markup = re.sub(r' xmlns(:\w+)?="[^"]*"', "", markup)
    markup = re.sub(r'(<svg[^>]*?) width="[^"]*" height="[^"]*"', r"\1", markup, count=1)
    markup = re.sub(r'(<svg[^>]*?) height="[^"]*"([^>]*?) width="[^"]*"', r"\1\2", markup, count=1)
    markup = re.sub(r'\bid="([^"]*)"', rf'id="{name}-\1"', markup)
    markup = re.sub(r"url\(#([^)]*)\)", rf"url(#{name}-\1)", markup)
    markup = re.sub(r'(xlink:)?href="#([^"]*)"', rf'href="#{name}-\2"', markup)
    markup = markup.replace('xlink:href="data:', 'href="data:')
    for colour, variable in _THEMED.items():
        markup = markup.replace(colour, variable)
    label = escape(description, quote=True)
    return markup.replace("<svg", f'<svg role="img" aria-label="{label}"', 1)
