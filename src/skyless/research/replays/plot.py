"""The picture of a replay: track and height against truth, errors and stated σ over time, histograms of the errors."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from skyless.core.arrays import Matrix, Vector


def track_figure(rows: Matrix, title: str) -> Figure:
    """Draw rows of time, position, truth (NaN if unknown) and σ of each axis, shape (n, 10); no rows: the title."""
    figure = Figure(figsize=(15, 8), layout="constrained")
    figure.suptitle(title)
    if len(rows):
        _fill(figure, rows)
    return figure


def _fill(figure: Figure, rows: Matrix) -> None:
    axes = figure.subplots(2, 3)
    judged = rows[np.isfinite(rows[:, 4])]
    known = len(judged) > 0
    label = "error in m" if known else "deviation from the median in m"
    drawn = judged if known else rows
    errors = judged[:, 1:4] - judged[:, 4:7] if known else rows[:, 1:4] - np.median(rows[:, 1:4], axis=0)
    time_s, std_m = drawn[:, 0] - drawn[:1, 0], drawn[:, 7:10]
    _track(axes[0, 0], rows[:, [1, 2]], judged[:, [4, 5]])
    axes[0, 0].set(xlabel="x in m", ylabel="y in m", title="track", aspect="equal")
    _over_time(axes[0, 1], time_s, errors[:, :2], std_m[:, :2], label)
    _over_time(axes[0, 2], time_s, errors[:, 2:], std_m[:, 2:], label)
    _histogram(axes[1, 0], errors, label)
    radial_m = np.linalg.norm(errors[:, :2], axis=1)
    axes[1, 1].plot(np.sort(radial_m), np.linspace(0.0, 100.0, len(radial_m)))
    axes[1, 1].set(xlabel=f"horizontal {label}", ylabel="per cent of the fixes below", title="distribution")
    axes[1, 1].grid(visible=True, linewidth=0.3)
    begin = np.array([rows[0, 0], 0.0])
    _track(axes[1, 2], rows[:, [0, 3]] - begin, judged[:, [0, 6]] - begin)
    axes[1, 2].set(xlabel="time in s", ylabel="z in m", title="height")


def _track(axes: Axes, fixes: Matrix, truth: Matrix) -> None:
    if len(truth):
        axes.plot(*truth.T, color="black", linewidth=0.8, label="truth")
    axes.plot(*fixes.T, ".", markersize=2, label="fixes")
    axes.legend()


def _over_time(axes: Axes, time_s: Vector, errors: Matrix, std_m: Matrix, label: str) -> None:
    """Errors of x and y, or of z, and their largest σ."""
    names = "xy" if errors.shape[1] == 2 else "z"
    for axis, name in enumerate(names):
        axes.plot(time_s, errors[:, axis], linewidth=0.7, label=name)
    for sign in (1.0, -1.0):
        axes.plot(
            time_s, sign * std_m.max(axis=1), color="black", linewidth=0.8, label="± stated σ" if sign > 0 else None
        )
    axes.set(xlabel="time in s", ylabel=label, title=f"{' and '.join(names)} over time")
    axes.legend()


def _histogram(axes: Axes, errors: Matrix, label: str) -> None:
    span = np.percentile(np.abs(errors), 99.5) if len(errors) else 1.0
    for axis, name in enumerate("xyz"):
        axes.hist(errors[:, axis], bins=80, range=(-span, span), histtype="step", label=name)
    axes.set(xlabel=label, ylabel="fixes", title="histogram")
    axes.legend()
