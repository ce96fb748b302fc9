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
    FigureCanvasAgg(figure)
    picture = io.BytesIO()
    figure.savefig(picture, format=path.suffix.removeprefix(".") or "png", dpi=130)
    path.write_bytes(picture.getvalue())
