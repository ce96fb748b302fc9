"""Figure 4: error histograms at two static positions, and what biased stamps leave (fig:HistogramErrorXY)."""

from functools import partial
from typing import Final

import numpy as np
from matplotlib.lines import Line2D
from msgspec import Struct
from msgspec.structs import replace

from skyless.core.arrays import Array
from skyless.core.ticks import TICK_M
from skyless.research.paper.plan import (
    CLAIM_M,
    P1,
    P1_METHODS,
    P2,
    RADIO_PS,
    Panel,
    Plan,
    Point,
    Results,
    Section,
    Track,
    Verdict,
    gaussian,
    grouped,
    listen,
)
from skyless.research.studies.runner import Cell
from skyless.sim.impairments import DelayError, Impairments, lab_impairments
from skyless.sim.lab import paper_lab_site
from skyless.sim.trajectory import Static
from skyless.site.channel import ChannelModel, power_bias_m, received_power_dbm
from skyless.site.report import INK, METHOD_COLOURS, MUTED, RED, panel

_METHODS: Final = ("literal", "joint")
_POSITIONS: Final = {"P1": P1, "P2": P2}

_BATCHES: Final = 30

_WORLDS: Final = {
    "noise": "stamp noise only",
    "power": "power-dependent bias",
    "delay": "antenna-delay errors",
}


_MARKERS: Final = {"noise": "o", "power": "^", "delay": "s"}

_DELAY_STD_M: Final = 0.05
"""Standard deviation of the errors of antenna delays in the biased world, TX and RX each (assumed)."""


class Moments(Struct, frozen=True):
    """One axis of the errors at one position."""

    count: int

    mean_m: float
    mean_standard_error_m: float
    std_m: float
    skewness: float
    excess_kurtosis: float


def cells(plan: Plan) -> list[Cell]:
    """One world for each kind of stamp error, a tag at each position."""
    fixes, few = {name: plan.fixes if name == "noise" else plan.fewer_fixes for name in _WORLDS}, plan.fewer_fixes
    return [
        Cell(f"static/{name}", partial(run_world, name, plan.seed, count, few), count * 2e-3)
        for name, count in fixes.items()
    ]


def run_world(name: str, seed: int, fixes: int, fewer_fixes: int) -> list[dict[str, Track]]:
    """Two tags at rest that compute with ``_METHODS``.

    Without biases the first one also computes ``fewer_fixes`` by the other methods of figure 9.
    """
    usual = dict.fromkeys(_METHODS, fixes)
    methods = dict.fromkeys(P1_METHODS, fewer_fixes) | usual if name == "noise" else usual
    tags = [(Static(*P1), methods), (Static(*P2), usual)]
    return listen(paper_lab_site(RADIO_PS), tags, biased_impairments(name, seed), seed)


def biased_impairments(name: str, seed: int) -> Impairments:
    """The lab, with one kind of systematic stamp error or none."""
    lab = lab_impairments(RADIO_PS)
    if name == "power":
        return replace(lab, channel=ChannelModel(power_bias=True))
    return replace(lab, delay_errors=delay_errors(seed)) if name == "delay" else lab


def delay_errors(seed: int) -> tuple[DelayError, ...]:
    """Antenna delays that nobody calibrated: normal, ``_DELAY_STD_M`` for TX and for RX of every anchor."""
    anchors = paper_lab_site().anchors
    errors = np.random.default_rng([seed, 4]).normal(0.0, _DELAY_STD_M / TICK_M, (len(anchors), 2)).tolist()
    return tuple(DelayError(anchor.id, tx, rx) for anchor, (tx, rx) in zip(anchors, errors, strict=True))


def expected_bias_m(name: str, position_m: Point, seed: int) -> Array:
    """Mean position error of ``literal`` to first order, shape (2,).

    A DTDoA is late by what its RX stamps at the tag are late, less the master's, plus what the anchor's stamp of the
    master is late (its offset carries that on), plus the anchor's own TX delay; the master's TX delay cancels. The
    unweighted least squares make (JᵀJ)⁻¹Jᵀ of it.
    """
    anchors_m = np.array([(anchor.x_m, anchor.y_m) for anchor in paper_lab_site().anchors])
    away = np.array(position_m) - anchors_m
    ranges_m = np.linalg.norm(away, axis=1)
    late_m = np.zeros(len(anchors_m))
    if name == "power":
        at_tag, at_anchors = _power_bias_m(ranges_m), _power_bias_m(np.linalg.norm(anchors_m - anchors_m[0], axis=1))
        late_m = at_tag - at_tag[0] + at_anchors
    elif name == "delay":
        late_m = np.array([error.tx_ticks + error.rx_ticks for error in delay_errors(seed)]) * TICK_M
    units = away / ranges_m[:, None]
    bias, *_ = np.linalg.lstsq(units[1:] - units[0], late_m[1:], rcond=None)
    return np.asarray(bias)


def _power_bias_m(ranges_m: Array) -> Array:
    power_dbm = ChannelModel().tx_power_dbm
    return np.array([power_bias_m(received_power_dbm(power_dbm, float(range_m), 0.0)) for range_m in ranges_m])


def moments_of(error_m: Array) -> Moments:
    """Moments of a run of errors, shape (n,); the mean's standard error is from batches, as neighbours correlate."""
    batches = error_m[: len(error_m) // _BATCHES * _BATCHES].reshape(_BATCHES, -1).mean(axis=1)
    standard_error_m = float(batches.std(ddof=1)) / _BATCHES**0.5
    mean_m, std_m = float(error_m.mean()), float(error_m.std())
    scaled = (error_m - mean_m) / std_m
    return Moments(
        len(error_m),
        mean_m,
        standard_error_m,
        std_m,
        float((scaled**3).mean()),
        float((scaled**4).mean()) - 3.0,
    )


def judge(noise_only: list[Moments], biased: list[Moments]) -> tuple[Verdict, str]:
    """Whether noise alone leaves no mean and a Gaussian, and biased stamps leave a mean.

    A Gaussian's moments scatter by √(6/n) and √(24/n); less than a tenth does not matter.
    """
    gaussian = all(
        abs(axis.skewness) < 0.1 + 4.0 * (6.0 / axis.count) ** 0.5
        and abs(axis.excess_kurtosis) < 0.1 + 4.0 * (24.0 / axis.count) ** 0.5
        for axis in noise_only
    )
    unbiased = all(abs(axis.mean_m) < 4.0 * axis.mean_standard_error_m for axis in noise_only)
    shifted = any(abs(axis.mean_m) > 6.0 * axis.mean_standard_error_m for axis in biased)
    if gaussian and shifted and unbiased:
        return Verdict.CORRECTED, (
            "The errors are Gaussian, and systematic stamp errors shift their means as observed. Stamp noise alone "
            "leaves none, so the means are calibration errors and can be taken away; pulse distortion by angle is "
            "not simulated, but power-dependent delay and antenna delays suffice. For the 20 cm see figure 9."
        )
    if gaussian and shifted:
        return Verdict.HOLDS, "The errors are Gaussian about a mean that is not zero, even without systematic errors."
    return Verdict.FAILS, "The errors are not Gaussian, or biased stamps do not shift their means."


def section(plan: Plan, results: Results) -> Section:
    """The figure with its verdict."""
    worlds: dict[str, list[dict[str, Track]]] = {name: results[f"static/{name}"] for name in _WORLDS}
    moments = {
        (name, point, method): [moments_of(axis) for axis in tracks[method].error_m.T]
        for name, world in worlds.items()
        for point, tracks in zip(_POSITIONS, world, strict=True)
        for method in _METHODS
    }
    literal = {name: [m for point in _POSITIONS for m in moments[name, point, "literal"]] for name in _WORLDS}
    verdict, reason = judge(literal["noise"], literal["power"] + literal["delay"])
    panels = [
        _histogram(point, axis, {method: tracks[method] for method in _METHODS})
        for point, tracks in zip(_POSITIONS, worlds["noise"], strict=True)
        for axis in range(2)
    ]
    expected = {
        (name, point): expected_bias_m(name, at, plan.seed) for name in _WORLDS for point, at in _POSITIONS.items()
    }
    panels += [_means(point, moments, expected, worlds) for point in _POSITIONS]
    rows = [("stamps", "position", "method", "mean x, y in cm", "expected", "σ x, y in cm", "largest in cm")]
    numbers: list[dict[str, object]] = []
    for (name, point, method), (x, y) in moments.items():
        error_m = worlds[name][list(_POSITIONS).index(point)][method].error_m
        largest_m = float(np.linalg.norm(error_m, axis=1).max())
        foreseen = expected[name, point] if method == "literal" else None
        rows.append(
            (
                _WORLDS[name],
                point,
                method,
                f"{100 * x.mean_m:+.2f}, {100 * y.mean_m:+.2f}",
                "" if foreseen is None else f"{100 * foreseen[0]:+.2f}, {100 * foreseen[1]:+.2f}",
                f"{100 * x.std_m:.2f}, {100 * y.std_m:.2f}",
                f"{100 * largest_m:.1f}",
            )
        )
        numbers.append(
            {
                "stamps": name,
                "position": point,
                "position_m": _POSITIONS[point],
                "method": method,
                "fixes": len(error_m),
                "rmse_m": float(np.sqrt((error_m**2).sum(axis=1).mean())),
                "max_m": largest_m,
                "below_20_cm": largest_m < CLAIM_M,
                "expected_bias_m": None if foreseen is None else foreseen.tolist(),
                "x": x,
                "y": y,
            }
        )
    return Section(
        key="static-errors",
        title="Errors at two static positions",
        label="fig:HistogramErrorXY",
        claim=(
            "At two known positions the errors along X and Y, 30 000 each, look Gaussian with means that are not "
            "zero; the paper puts these down to pulse distortion by angle, overlapping paths and reflections, and "
            "finds the precision within 20 cm."
        ),
        simulated=(
            f"{grouped(plan.fixes)} fixes at P1 (3, 4) and at P2 (1.2, 1.6), one per superframe, stamp noise "
            f"{RADIO_PS:g} ps with nothing but noise; {grouped(plan.fewer_fixes)} with the DW1000's range bias by "
            f"received power on every RX stamp (APS011), and as many with antenna delays wrong by "
            f"{100 * _DELAY_STD_M:g} cm (standard deviation, assumed) for TX and RX of every anchor. Both methods "
            "compute from the same receptions."
        ),
        verdict=verdict,
        reason=reason,
        panels=tuple(panels),
        table=tuple(rows),
        numbers={"rows": numbers},
        command=f"skyless simulate --method literal --noise-ps {RADIO_PS:g} --position 3,4 --fixes {plan.fixes} "
        f"--seed {plan.seed}",
    )


def _histogram(point: str, axis: int, tracks: dict[str, Track]) -> Panel:
    name = "xy"[axis]
    figure, axes = panel(f"{point}: error along {name.upper()}", 2.9)
    span = 100 * max(float(np.abs(track.error_m[:, axis]).max()) for track in tracks.values())
    edges = np.linspace(-span, span, 90)
    for method, track in tracks.items():
        error_cm = 100 * track.error_m[:, axis]
        colour = METHOD_COLOURS[method]
        axes.hist(error_cm, edges.tolist(), density=True, histtype="stepfilled", color=colour, alpha=0.35)
        label = f"{method}: mean {error_cm.mean():+.2f}, σ {error_cm.std():.2f} cm".replace("-", "−")
        axes.plot(edges, gaussian(edges, error_cm.std(), error_cm.mean()), color=colour, label=label)
    axes.set(xlabel=f"error along {name.upper()} in cm", ylabel="density in 1/cm")
    axes.set_ylim(0, 1.45 * axes.get_ylim()[1])
    axes.legend(loc="upper left")
    count = len(next(iter(tracks.values())).time_s)
    caption = (
        f"{grouped(count)} errors along {name.upper()} at {point}, stamp noise only; lines: Gaussians of that mean "
        "and σ."
    )
    return Panel(f"04-{point.lower()}-{name}", caption, figure)


def _means(
    point: str,
    moments: dict[tuple[str, str, str], list[Moments]],
    expected: dict[tuple[str, str], Array],
    worlds: dict[str, list[dict[str, Track]]],
) -> Panel:
    figure, axes = panel(f"{point}: where the mean fix lies", 4.6)
    index = list(_POSITIONS).index(point)
    cloud = 100 * worlds["noise"][index]["literal"].error_m[:400]
    axes.plot(cloud[:, 0], cloud[:, 1], ".", color=MUTED, markersize=2, alpha=0.35)
    for world, marker in _MARKERS.items():
        for method in _METHODS:
            x, y = moments[world, point, method]
            (mean,) = axes.plot([100 * x.mean_m], [100 * y.mean_m], marker, color=METHOD_COLOURS[method])
            mean.set(markeredgecolor=INK, markeredgewidth=0.5, markersize=6)
        if world != "noise":
            axes.plot(*(100 * expected[world, point]), "x", color=RED, markersize=7)
    axes.set(xlabel="X in cm", ylabel="Y in cm", xlim=(-10.5, 10.5), ylim=(-10.5, 10.5), aspect="equal")
    figure.legend(handles=_keys(), loc="outside lower center", ncols=2)
    caption = (
        f"Mean error at {point} by kind of stamp error, over single fixes of literal with stamp noise only. "
        "Crosses: what the stamps' errors make of literal to first order."
    )
    return Panel(f"04-{point.lower()}-means", caption, figure)


def _keys() -> list[Line2D]:
    """Legend: colours are methods, shapes kinds of stamp error."""
    methods = [Line2D([], [], color=METHOD_COLOURS[name], linewidth=5, label=name) for name in _METHODS]
    shapes = [
        Line2D([], [], linestyle="", marker=marker, color=MUTED, label=_WORLDS[world])
        for world, marker in _MARKERS.items()
    ]
    return [*methods, Line2D([], [], linestyle="", marker="x", color=RED, label="expected, literal"), *shapes]
