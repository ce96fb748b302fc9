"""The picture of a survey, from above: anchors with their ellipses, ranges, those left out, and other solutions."""

from typing import Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Ellipse

from skyless.core.arrays import Integers, Vector
from skyless.site.report import BLUE, GRID, INK, MUTED, ORANGE, RED, panel, report_style
from skyless.site.survey.facts import Survey, SurveyedAnchor

_SIGMAS: Final = 3.0
_SMALLEST_SHARE: Final = 0.01
"""Least size of the median ellipse, as a share of the picture: ellipses are magnified by 10, 100 … for it."""


def survey_figure(survey: Survey) -> Figure:
    """A survey from above."""
    at_m = {one.id: (one.x_m, one.y_m) for one in survey.anchors if one.x_m is not None and one.y_m is not None}
    with report_style():
        figure, axes = panel("survey, from above", 4.2)
        _ranges(axes, survey, at_m)
        scale = _magnification(survey, at_m)
        for one in survey.anchors:
            if one.id in at_m:
                _anchor(axes, one, at_m[one.id], scale)
        for ambiguity in survey.ambiguities:
            for anchor, (x_m, y_m, _) in ambiguity.positions_m.items():
                if anchor in at_m:
                    axes.plot([at_m[anchor][0], x_m], [at_m[anchor][1], y_m], ":", color=ORANGE, linewidth=1.0)
                axes.plot(x_m, y_m, "s", color=ORANGE, markerfacecolor="none")
        axes.set(xlabel="x in m", ylabel="y in m", aspect="equal")
        axes.set_title(_legend(survey, at_m, scale), loc="right", fontsize=7.0, color=MUTED)
    return figure


def bias_figure(name: str, anchors: Integers, bias_m: Vector, std_m: Vector) -> Figure:
    """Constants of anchors with their standard errors, one bar an anchor."""
    with report_style():
        figure, axes = panel(f"{name}: constants of the anchors, zero is their mean")
        at = np.arange(len(anchors))
        axes.bar(at, 100.0 * bias_m, yerr=100.0 * std_m, color=BLUE, capsize=3.0)
        axes.set_xticks(at, [str(anchor) for anchor in anchors])
        axes.set(xlabel="anchor", ylabel="signals seem late by, in cm")
    return figure


def _ranges(axes: Axes, survey: Survey, at_m: dict[int, tuple[float, float]]) -> None:
    for pair in survey.pairs:
        if pair.a in at_m and pair.b in at_m:
            (xa, ya), (xb, yb) = at_m[pair.a], at_m[pair.b]
            colour, line = (RED, "--") if pair.excluded else (GRID, "-")
            axes.plot([xa, xb], [ya, yb], line, color=colour, linewidth=0.8, zorder=2 if pair.excluded else 1)


def _anchor(axes: Axes, one: SurveyedAnchor, at_m: tuple[float, float], scale: float) -> None:
    axes.plot(*at_m, "s", color=INK if one.determined else RED, markersize=4, zorder=4)
    axes.annotate(str(one.id), at_m, (4, 4), textcoords="offset points", fontsize=8.0, color=INK, zorder=5)
    if one.covariance_m2 is None:
        return
    values, vectors = np.linalg.eigh(np.array(one.covariance_m2)[:2, :2])
    width, height = 2.0 * scale * _SIGMAS * np.sqrt(np.maximum(values, 0.0))
    angle = float(np.degrees(np.arctan2(vectors[1, 0], vectors[0, 0])))
    axes.add_patch(Ellipse(at_m, width, height, angle=angle, facecolor=BLUE, alpha=0.35, edgecolor=BLUE, zorder=3))


def _magnification(survey: Survey, at_m: dict[int, tuple[float, float]]) -> float:
    """A power of ten with which the median ellipse can be seen."""
    std_m = [one.std_m for one in survey.anchors if one.id in at_m and one.std_m]
    if not std_m:
        return 1.0
    points_m = np.array(list(at_m.values()))
    size_m = float(np.ptp(points_m, axis=0).max())
    needed = _SMALLEST_SHARE * size_m / (_SIGMAS * float(np.median(std_m)))
    return float(10.0 ** np.ceil(np.log10(needed))) if needed > 1.0 else 1.0


def _legend(survey: Survey, at_m: dict[int, tuple[float, float]], scale: float) -> str:
    magnified = "" if scale == 1.0 else f", {scale:g} × magnified"
    parts = [f"ellipses {_SIGMAS:g} σ{magnified}"]
    if any(pair.excluded for pair in survey.pairs):
        parts.append("red: left out as late")
    if survey.ambiguities:
        parts.append("orange: another solution")
    missing = ", ".join(str(one.id) for one in survey.anchors if one.id not in at_m)
    if missing:
        parts.append(f"not determined: {missing}")
    return "\n".join(parts)
