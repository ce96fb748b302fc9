"""Figures into files: whole or not at all, without a screen."""

import io
from pathlib import Path

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure


def save_figure(figure: Figure, path: Path) -> None:
    """Write a figure in the format of the file's ending (PNG where it has none).

    Raises:
        OSError, ValueError: the file cannot be written, or its ending names no kind of picture.
    """
    path.write_bytes(picture(figure, path.suffix.removeprefix(".") or "png"))


def picture(figure: Figure, kind: str, dpi: float = 130.0) -> bytes:
    """A figure as the bytes of a file of that kind; the same figure gives the same bytes at any time.

    Raises:
        ValueError: there is no such kind.
    """
    FigureCanvasAgg(figure)
    file = io.BytesIO()
    undated = {"Date": None} if kind == "svg" else None
    figure.savefig(file, format=kind, dpi=dpi, metadata=undated)
    return file.getvalue()
