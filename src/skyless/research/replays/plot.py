"""The picture of a replay: track over truth, error over time, histograms of the errors."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from skyless.core.arrays import Matrix


def track_figure(rows: Matrix, title: str) -> Figure:
    """Draw rows of time, position (3) and true position (3, NaN where unknown), shape (n, 7); of none, the title."""
    figure = Figure(figsize=(11, 8), layout="constrained")
    figure.suptitle(title)
    if len(rows):
        _fill(figure, rows)
    return figure


def _fill(figure: Figure, rows: Matrix) -> None:
    axes = figure.subplots(2, 2)
    judged = rows[np.isfinite(rows[:, 4])]
    known = len(judged) > 0
    errors = judged[:, 1:4] - judged[:, 4:7] if known else rows[:, 1:4] - np.median(rows[:, 1:4], axis=0)
    _track(axes[0, 0], rows, judged)
    _over_time(axes[0, 1], (judged if known else rows)[:, 0], errors, known=known)
    _histogram(axes[1, 0], errors[:, :2], ("x", "y"), known=known)
    _distribution(axes[1, 1], np.linalg.norm(errors[:, :2], axis=1), known=known)


def _track(axes: Axes, rows: Matrix, judged: Matrix) -> None:
    if len(judged):
        axes.plot(judged[:, 4], judged[:, 5], color="black", linewidth=0.8, label="truth")
    axes.plot(rows[:, 1], rows[:, 2], ".", markersize=2, label="fixes")
    axes.set(xlabel="x in m", ylabel="y in m", title="track", aspect="equal")
    axes.legend()


def _over_time(axes: Axes, time_s: Matrix, errors: Matrix, *, known: bool) -> None:
    for axis, name in enumerate("xyz"):
        axes.plot(time_s - time_s[:1], errors[:, axis], linewidth=0.7, label=name)
    axes.set(xlabel="time in s", ylabel=_label(known=known), title="over time")
    axes.legend()


def _histogram(axes: Axes, errors: Matrix, names: tuple[str, ...], *, known: bool) -> None:
    span = np.percentile(np.abs(errors), 99.5) if len(errors) else 1.0
    for axis, name in enumerate(names):
        axes.hist(errors[:, axis], bins=80, range=(-span, span), histtype="step", label=name)
    axes.set(xlabel=_label(known=known), ylabel="fixes", title="histogram")
    axes.legend()


def _distribution(axes: Axes, radial_m: Matrix, *, known: bool) -> None:
    axes.plot(np.sort(radial_m), np.linspace(0.0, 100.0, len(radial_m)))
    axes.set(xlabel=f"horizontal {_label(known=known)}", ylabel="per cent of the fixes below", title="distribution")
    axes.grid(visible=True, linewidth=0.3)


def _label(*, known: bool) -> str:
    return "error in m" if known else "deviation from the median in m"
