"""Claim 10, which none of the paper's figures shows: one tag to ten thousand (sec:Intro, sec:conclusion)."""

import hashlib
import time
from functools import partial
from typing import Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter
from msgspec import Struct
from msgspec.structs import replace

from skyless.core.air.frame import Reception
from skyless.core.any_receiver import AnyReceiver
from skyless.core.arrays import Array, Integers
from skyless.research.paper.plan import P1, RADIO_PS, Figures, Found, Panel, Plan, Results, Table, grouped
from skyless.research.studies.runner import Cell
from skyless.sim.evaluation.fleet import world_of
from skyless.sim.impairments import lab_impairments
from skyless.sim.lab import paper_lab_site
from skyless.sim.trajectory import Static
from skyless.site.report import BLUE, GREEN, INK, MUTED, ORANGE, panel

_JUDGED_FROM_S: Final = 0.6
_JUDGED_UNTIL_S: Final = 1.2
"""The stretch of true time in which all fleets are judged: the anchors' noise in it is the same for all of them."""

_MOST_COMPUTING: Final = 500
"""Tags of a fleet that compute positions: of more, evenly spread ones, the first among them. All receive."""

_NOT_RECEIVED: Final = -1

_RANGINGS_OF_TWR: Final = 6
_MESSAGES_PER_RANGING: Final = 4
"""Double-sided two-way ranging with each of six anchors, as the paper counts its messages."""


class FleetResult(Struct, frozen=True):
    """A fleet of tags in the stretch of time that is judged."""

    tags: int
    """That receive."""
    computing: int
    """That make fixes of what they receive."""
    rmse_m: float
    """Over all fixes."""
    rmse_standard_error_m: float | None
    """From tag to tag."""
    tag_rmse_m: tuple[float, float]
    """5 % and 95 % of the single tags' RMSE."""
    fixes_per_s: float
    """Mean per tag that computes."""
    fewest_fixes_per_s: float
    frames_per_s: float
    """On the air, from all nodes together."""
    fewest_heard_per_s: float
    """Frames that the tag with the fewest received."""
    first_tag: str
    """Digest of all positions of the first tag."""
    cpu_s_per_tag_s: float
    """CPU time of one tag per second of true time, measured on this machine."""


def cells(plan: Plan) -> list[Cell]:
    """One world for each size."""
    return [
        Cell(f"scale/{tags}", partial(run_world, tags=tags, seed=plan.seed), 2.0 + min(tags, _MOST_COMPUTING) * 16e-3)
        for tags in plan.fleet_sizes
    ]


def run_world(tags: int, seed: int) -> FleetResult:
    """Tags at P1 with radios and clocks of their own; other positions would only mix geometry into the comparison.

    The tags compute one after the other, from what they have received: so there is one filter in memory at a time.
    """
    site, path = paper_lab_site(RADIO_PS), Static(*P1)
    world = world_of(site, [path] * tags, lab_impairments(RADIO_PS), seed)
    computing = np.linspace(0, tags - 1, min(tags, _MOST_COMPUTING)).round().astype(np.int64)
    received: list[tuple[bytes, float]] = []
    stamps: list[Integers] = []
    heard, frames = np.zeros(tags, np.int64), 0
    for broadcast in world.run(_JUDGED_UNTIL_S):
        rx_ticks = np.full(tags, _NOT_RECEIVED)
        rx_ticks[broadcast.tags] = broadcast.rx_ticks
        received.append((broadcast.frame, broadcast.end_s))
        stamps.append(rx_ticks[computing])
        if broadcast.end_s >= _JUDGED_FROM_S:
            heard[broadcast.tags] += 1
            frames += 1
    squares_m2, fixes = np.zeros(len(computing)), np.zeros(len(computing), np.int64)
    digest, cpu_s, truth_m = hashlib.sha256(), 0.0, path.position(0.0)
    del world
    for row, own in enumerate(np.array(stamps).T.tolist()):
        receiver, begun_s = AnyReceiver(), 0.0
        for (frame, end_s), rx_ticks in zip(received, own, strict=True):
            judged = end_s >= _JUDGED_FROM_S
            begun_s = begun_s or (time.process_time() if judged else 0.0)
            fix = None if rx_ticks == _NOT_RECEIVED else receiver.hear(Reception(frame, rx_ticks, end_s))
            if fix is None:
                continue
            if row == 0:
                digest.update(fix.position_m.tobytes())
            if judged:
                error_m = fix.position_m - truth_m
                squares_m2[row] += float(error_m @ error_m)
                fixes[row] += 1
        cpu_s += time.process_time() - begun_s
    found = summarise(squares_m2, fixes, frames, digest.hexdigest()[:16], cpu_s)
    return replace(found, tags=tags, fewest_heard_per_s=float(heard.min()) / (_JUDGED_UNTIL_S - _JUDGED_FROM_S))


def summarise(squares_m2: Array, fixes: Integers, frames: int, digest: str, cpu_s: float) -> FleetResult:
    """Sum a fleet up that hears everything: squared errors and fixes of each tag, shape (tags,)."""
    tags, span_s = len(fixes), _JUDGED_UNTIL_S - _JUDGED_FROM_S
    own = np.sqrt(squares_m2 / np.maximum(fixes, 1))
    rmse = float(np.sqrt(squares_m2.sum() / max(int(fixes.sum()), 1)))
    mean_square_error = float((own**2).std(ddof=1)) / tags**0.5 if tags > 1 else None
    low, high = np.percentile(own, (5, 95)).tolist()
    return FleetResult(
        tags=tags,
        computing=tags,
        rmse_m=rmse,
        rmse_standard_error_m=None if mean_square_error is None else mean_square_error / (2.0 * rmse),
        tag_rmse_m=(low, high),
        fixes_per_s=float(fixes.mean()) / span_s,
        fewest_fixes_per_s=float(fixes.min()) / span_s,
        frames_per_s=frames / span_s,
        fewest_heard_per_s=frames / span_s,
        first_tag=digest,
        cpu_s_per_tag_s=cpu_s / tags / span_s,
    )


def figures_of(fleets: list[FleetResult]) -> Figures:
    """Whether the first tag's fixes, the rate per tag and the load of the air are the same for all sizes."""
    first = fleets[0]
    return {
        "same_fixes": len({fleet.first_tag for fleet in fleets}) == 1,
        "same_rate": all(fleet.fewest_fixes_per_s > 0.99 * first.fixes_per_s for fleet in fleets),
        "same_air": len({one for fleet in fleets for one in (fleet.frames_per_s, fleet.fewest_heard_per_s)}) == 1,
        "first": first,
        "sizes": ", ".join(grouped(fleet.tags) for fleet in fleets),
        "most": grouped(fleets[-1].tags),
    }


def evaluated(plan: Plan, results: Results) -> Found:
    """The figures of the claim, its table and its pictures."""
    fleets: list[FleetResult] = [results[f"scale/{tags}"] for tags in plan.fleet_sizes]
    heads = ("tags", "that compute", "RMSE in cm", "single tags, 5–95 %", "fixes per s and tag", "frames per s on air")
    rows: Table = [(*heads, "CPU per tag, measured here")]
    for fleet in fleets:
        error = "" if fleet.rmse_standard_error_m is None else f" ± {100 * fleet.rmse_standard_error_m:.2f}"
        low, high = fleet.tag_rmse_m
        rows.append(
            (
                grouped(fleet.tags),
                grouped(fleet.computing),
                f"{100 * fleet.rmse_m:.2f}{error}",
                f"{100 * low:.2f}–{100 * high:.2f}" if fleet.tags > 1 else "",
                f"{fleet.fixes_per_s:.1f}",
                f"{fleet.frames_per_s:.0f}",
                f"{1e3 * fleet.cpu_s_per_tag_s:.1f} ms per s",
            )
        )
    return Found(figures_of(fleets), rows, [_accuracy(fleets), _rates(fleets), _cpu(fleets)], {"fleets": fleets})


def _logarithmic(title: str, fleets: list[FleetResult]) -> tuple[Figure, Axes, Array]:
    """A figure, its axes over the numbers of tags, and these."""
    figure, axes = panel(title, 3.2)
    tags = np.array([fleet.tags for fleet in fleets], dtype=float)
    axes.set_xscale("log")
    axes.set_xticks(tags)
    axes.xaxis.set_major_formatter(FuncFormatter(lambda tags, _: grouped(round(tags))))
    axes.minorticks_off()
    axes.set_xlabel("tags")
    return figure, axes, tags


def _accuracy(fleets: list[FleetResult]) -> Panel:
    figure, axes, tags = _logarithmic("Accuracy of a tag", fleets)
    low, high = (100 * np.array([fleet.tag_rmse_m[k] for fleet in fleets]) for k in (0, 1))
    axes.fill_between(tags, low, high, color=BLUE, alpha=0.2, linewidth=0, label="single tags, 5 to 95 %")
    axes.plot(tags, [100 * fleet.rmse_m for fleet in fleets], "o-", color=BLUE, label="all tags together")
    axes.set(ylabel="RMSE in cm", ylim=(0, 1.5 * float(high.max())))
    axes.legend(loc="upper left")
    return Panel("10-accuracy", "RMSE of joint by the number of tags, over the same 0.6 s.", figure)


def _rates(fleets: list[FleetResult]) -> Panel:
    figure, axes, tags = _logarithmic("Updates of each tag", fleets)
    slots_hz = 1.0 / (paper_lab_site().schedule.slot_s)
    axes.set_yscale("log")
    axes.plot(tags, [fleet.fixes_per_s for fleet in fleets], "o-", color=BLUE, label="downlink: simulated")
    axes.plot(tags, slots_hz / tags, "--", color=ORANGE, label="uplink, one slot per blink")
    ranging = slots_hz / (_RANGINGS_OF_TWR * _MESSAGES_PER_RANGING)
    axes.plot(tags, ranging / tags, ":", color=MUTED, label="two-way ranging, 24 messages")
    axes.set(ylabel="updates per second and tag", ylim=(None, 3 * slots_hz))
    axes.legend(loc="lower left")
    caption = f"Updates per tag. Downlink simulated; the other lines share the same {slots_hz:.0f} slots a second."
    return Panel("10-rate", caption, figure)


def _cpu(fleets: list[FleetResult]) -> Panel:
    figure, axes, tags = _logarithmic("What a tag computes, what the air carries", fleets)
    cpu_ms = [1e3 * fleet.cpu_s_per_tag_s for fleet in fleets]
    axes.plot(tags, cpu_ms, "s-", color=GREEN, label="CPU time of a tag (left), measured here")
    axes.set(ylabel="CPU time in ms per s", ylim=(0, 1.7 * max(cpu_ms)))
    right, frames = axes.twinx(), [fleet.frames_per_s for fleet in fleets]
    (line,) = right.plot(tags, frames, "o--", color=INK, label="frames on the air (right)")
    right.set(ylabel="frames per second", ylim=(0, 1.3 * max(frames)))
    right.grid(visible=False)
    axes.legend(handles=[*axes.lines, line], loc="upper left")
    return Panel("10-load", "CPU time of one tag per second (measured on this machine) and frames on the air.", figure)
