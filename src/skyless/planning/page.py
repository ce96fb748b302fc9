"""The plan as one HTML file: pictures embedded, numbers in tables, nothing to load from elsewhere."""

import base64
import html
import io
from collections.abc import Iterable, Mapping, Sequence
from typing import Final

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

_STYLE: Final = """
body { font: 16px/1.5 system-ui, sans-serif; max-width: 70rem; margin: 2rem auto; padding: 0 1rem; color: #1a1a1a; }
img { max-width: 100%; height: auto; border: 1px solid #ccc; margin: .5rem 0 1.5rem; }
table { border-collapse: collapse; margin: 1rem 0; }
td, th { border: 1px solid #ccc; padding: .3rem .7rem; text-align: left; vertical-align: top; }
th { background: #f2f2f2; } .warning { color: #8a4b00; } .note { color: #555; }
"""

_HEAD: Final = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">
<title>{title}</title><style>{style}</style></head><body>
<h1>{title}</h1>
"""


def page(
    title: str,
    described: str,
    numbers: Mapping[str, str],
    warnings: Sequence[str],
    sections: Iterable[tuple[str, Figure]],
    notes: Sequence[str],
) -> str:
    """The page: what was planned, its numbers and warnings, one picture a section, and what is assumed."""
    parts = [_HEAD.format(title=html.escape(title), style=_STYLE), f"<p>{html.escape(described)}</p>\n"]
    rows = "".join(f"<tr><th>{html.escape(k)}</th><td>{html.escape(v)}</td></tr>\n" for k, v in numbers.items())
    parts.append(f"<table>{rows}</table>\n<h2>Warnings</h2>\n")
    parts.append(_list(warnings, "warning") if warnings else "<p>None.</p>\n")
    for heading, figure in sections:
        text = html.escape(heading)
        parts.append(f'<h2>{text}</h2>\n<img alt="{text}" src="{data_uri(figure)}">\n')
    parts.append("<h2>What is assumed</h2>\n" + _list(notes, "note") + "</body></html>\n")
    return "".join(parts)


def data_uri(figure: Figure) -> str:
    """A figure as a PNG within an address."""
    FigureCanvasAgg(figure)
    picture = io.BytesIO()
    figure.savefig(picture, format="png", dpi=110)
    return "data:image/png;base64," + base64.b64encode(picture.getvalue()).decode()


def _list(entries: Sequence[str], kind: str) -> str:
    return "<ul>" + "".join(f'<li class="{kind}">{html.escape(entry)}</li>\n' for entry in entries) + "</ul>\n"
