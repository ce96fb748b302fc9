"""Figure 6: the PDoP map of the lab (fig:Pdopmap), and the map of the predicted deviation next to it."""

from typing import Final

import numpy as np

from skyless.core.arrays import Array
from skyless.core.geometry import dops_at
from skyless.core.protocol1.snapshots import literal_covariance
from skyless.core.ticks import SPEED_OF_LIGHT_MPS
from skyless.research.paper.plan import P1, P2, RADIO_PS, Panel, Plan, Results, Section, Verdict
from skyless.research.studies.runner import Cell
from skyless.sim.lab import paper_lab_site
from skyless.site.report import MAP, MAP_WHITE, draw_floor_plan, panel

LAB_ANCHORS_M: Final = np.array([(anchor.x_m, anchor.y_m) for anchor in paper_lab_site().anchors])
"""The lab's anchors, shape (6, 2), the master first, in the order in which they send."""

_STEP_M: Final = 0.1
EXPLAINING_CORRELATION: Final = 0.8
"""Correlation above which one thing explains another."""


def cells(plan: Plan) -> list[Cell]:  # noqa: ARG001 - nothing to simulate
    """None: the maps are computed."""
    return []


def literal_covariance_m2(position_m: Array) -> Array:
    """Covariance of one fix of ``literal`` at a position, shape (2, 2).

    G Σ Gᵀ with G = (JᵀJ)⁻¹Jᵀ of the unweighted least squares and Σ the full covariance of its TDoAs. Anchor i sends
    i slots after the master, so κ is i over the slots of the superframe.
    """
    variance_m2 = (RADIO_PS * 1e-12 * SPEED_OF_LIGHT_MPS) ** 2
    kappa = np.arange(1, len(LAB_ANCHORS_M)) / len(LAB_ANCHORS_M)
    away = position_m - LAB_ANCHORS_M
    units = away / np.linalg.norm(away, axis=1)[:, None]
    gain = np.linalg.pinv(units[1:] - units[0])
    return np.asarray(gain @ literal_covariance(kappa, variance_m2, variance_m2) @ gain.T)


def grid() -> tuple[Array, Array, Array]:
    """Centres of the cells inside the walls: x (m,), y (n,), positions (n·m, 2)."""
    low, high = LAB_ANCHORS_M.min(axis=0), LAB_ANCHORS_M.max(axis=0)
    x, y = (np.arange(low[k] + _STEP_M / 2, high[k], _STEP_M) for k in range(2))
    return x, y, np.stack([axis.ravel() for axis in np.meshgrid(x, y)], axis=1)


def pdop_at(positions_m: Array) -> Array:
    """PDoP for a known height at positions of shape (n, 2)."""
    return dops_at(np.pad(LAB_ANCHORS_M, ((0, 0), (0, 1))), np.pad(positions_m, ((0, 0), (0, 1))), height_known=True)[
        :, 1
    ]


def judge(correlation: float, asymmetry: float) -> tuple[Verdict, str]:
    """Whether PDoP ranks the positions on the floor as the predicted deviation of the paper's method does."""
    comparison = (
        "over the floor the PDoP and the predicted deviation of the paper's method correlate with "
        f"{correlation:.2f}; mirrored positions differ by up to {100 * asymmetry:.0f} % in deviation, and by nothing "
        "in PDoP"
    )
    if correlation >= EXPLAINING_CORRELATION and asymmetry < 0.1:
        return Verdict.HOLDS, f"The PDoP is a fair measure: {comparison}."
    if correlation > 0.0:
        return Verdict.CORRECTED, (
            "At first sight the PDoP distinguishes good geometry from bad. But it assumes equal, independent ranges, "
            f"and the paper's TDoAs are neither: {comparison}."
        )
    return Verdict.FAILS, f"The PDoP misleads: {comparison}."


def section(plan: Plan, results: Results) -> Section:  # noqa: ARG001 - computed, not simulated
    """The figure with its verdict."""
    x, y, positions_m = grid()
    pdop = pdop_at(positions_m)
    sigma_m = np.array([float(np.trace(literal_covariance_m2(at)) ** 0.5) for at in positions_m])
    correlation = float(np.corrcoef(pdop, sigma_m)[0, 1])
    field = sigma_m.reshape(len(y), len(x))
    ratios = np.stack([field / field[:, ::-1], field / field[::-1, :]])
    verdict, reason = judge(correlation, float(ratios.max() - 1.0))
    spots = np.array([P1, P2])
    pdop_spots = pdop_at(spots).tolist()
    sigma_spots = [float(np.trace(literal_covariance_m2(spot)) ** 0.5) for spot in spots]
    rows = (
        ("", "smallest", "median", "largest", "P1", "P2"),
        ("PDoP", *_three(pdop, "{:.2f}"), *(f"{value:.2f}" for value in pdop_spots)),
        ("literal, predicted σ in cm", *_three(100 * sigma_m, "{:.1f}"), *(f"{100 * v:.2f}" for v in sigma_spots)),
    )
    return Section(
        key="pdop-map",
        title="The PDoP map of the lab",
        label="fig:Pdopmap",
        claim="The PDoP is a simple, valid measure of how accurate positions are, obstacles apart.",
        simulated=(
            f"Computed, not simulated: cells of {100 * _STEP_M:g} cm, tags at the anchors' height. All anchors lie "
            "in one plane, so with the height unknown the PDoP is unbounded in that plane. The second map: the "
            f"deviation of the paper's method at {RADIO_PS:g} ps from the full covariance of its TDoAs; figures 4 "
            "and 5 confirm it."
        ),
        verdict=verdict,
        reason=reason,
        panels=(
            _map("06-pdop-map", "PDoP", (x, y, pdop), "PDoP for a known height; darker is better."),
            _map(
                "06-sigma-map",
                "σ of literal in cm",
                (x, y, 100 * sigma_m),
                "Predicted standard deviation of one fix of literal.",
            ),
        ),
        table=rows,
        numbers={
            "pdop": _summary(pdop, pdop_spots),
            "literal_sigma_m": _summary(sigma_m, sigma_spots),
            "correlation": correlation,
            "sigma_asymmetry": float(ratios.max() - 1.0),
        },
        command="skyless paper --out DIR",
    )


def _summary(values: Array, spots: list[float]) -> dict[str, float]:
    return {"min": values.min(), "median": np.median(values), "max": values.max(), "p1": spots[0], "p2": spots[1]}


def _three(values: Array, form: str) -> tuple[str, str, str]:
    low, middle, high = (form.format(value) for value in (values.min(), np.median(values), values.max()))
    return low, middle, high


def _map(name: str, title: str, field: tuple[Array, ...], caption: str) -> Panel:
    figure, axes = panel(title, 4.6)
    x, y, values = field
    grid_values = values.reshape(len(y), len(x))
    low, high = float(values.min()), float(np.percentile(values, 98))
    extent = (0.0, float(x[-1] + _STEP_M / 2), 0.0, float(y[-1] + _STEP_M / 2))
    image = axes.imshow(grid_values, MAP, origin="lower", extent=extent, vmin=low, vmax=high, interpolation="bilinear")
    lines = axes.contour(x, y, grid_values, 7, colors=MAP_WHITE, linewidths=0.7)
    axes.clabel(lines, fontsize=7.5)
    figure.colorbar(image, ax=axes, shrink=0.75, label=title, extend="max")
    draw_floor_plan(axes, [(x, y) for x, y in LAB_ANCHORS_M.tolist()], labels=False)
    for label, spot in (("P1", P1), ("P2", P2)):
        axes.plot(*spot, "+", color=MAP_WHITE, markersize=9)
        axes.annotate(label, spot, (5, 5), textcoords="offset points", color=MAP_WHITE, fontsize=8.5)
    axes.set(xlim=(-0.4, 6.4), ylim=(-0.4, 8.4))
    return Panel(name, caption, figure)
