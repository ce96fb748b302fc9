"""The plan as one HTML page: pictures, numbers in a table, warnings and assumptions."""

from collections.abc import Iterable, Mapping, Sequence
from html import escape

from matplotlib.figure import Figure

from skyless.evaluation import report_page
from skyless.evaluation.figures import picture


def page(
    title: str,
    described: str,
    numbers: Mapping[str, str],
    warnings: Sequence[str],
    sections: Iterable[tuple[str, Figure]],
    notes: Sequence[str],
) -> str:
    """The page: what was planned, its numbers and warnings, one picture a section, and what is assumed."""
    parts = [f"<h1>{escape(title)}</h1>", f"<p>{escape(described)}</p>", report_page.table((), numbers.items())]
    parts += ["<h2>Warnings</h2>", report_page.bullets(warnings, "warning") if warnings else "<p>None.</p>"]
    for heading, figure in sections:
        parts += [f"<h2>{escape(heading)}</h2>", report_page.png_figure(picture(figure, "png", 110.0), heading)]
    parts += ["<h2>What is assumed</h2>", report_page.bullets(notes, "note")]
    return report_page.page(title, parts)
