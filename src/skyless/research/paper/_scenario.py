"""Figure 1: uplink and downlink, and the lab (fig:Scenario)."""

from functools import partial
from typing import Final

import numpy as np
from matplotlib.axes import Axes

from skyless.research.paper._dop_map import LAB_ANCHORS_M
from skyless.research.paper.plan import P1, P2, Panel, Plan, Results, Section, Verdict
from skyless.research.studies.runner import Cell
from skyless.sim.evaluation.scenarios import Request, fleet_of
from skyless.sim.lab import paper_lab_site
from skyless.site.report import BLUE, GREEN, ORANGE, PAPER, RED, draw_floor_plan, panel

_TAGS_M: Final = ((2.0, 2.4), (4.1, 5.9), (1.6, 5.6))
_SECONDS: Final = 1.0
_MANY: Final = 50


def cells(plan: Plan) -> list[Cell]:
    """The lab with one tag and with many, to count who sends."""
    return [
        Cell(f"scenario/{tags}", partial(count_frames, tags=tags, seed=plan.seed), 0.2 + tags * 0.02)
        for tags in (1, _MANY)
    ]


def count_frames(tags: int, seed: int) -> dict[str, int]:
    """Frames on the air by sender, and frames that tags received."""
    fleet = fleet_of(Request(site=paper_lab_site(), tags=tags, seed=seed))
    senders: set[int] = set()
    for broadcast in fleet.world.run(_SECONDS):
        senders.add(broadcast.anchor)
    tally = fleet.world.tally
    return {"sent": tally.transmissions, "senders": len(senders), "heard_by_tags": tally.at_tags["heard"]}


def judge(alone: dict[str, int], many: dict[str, int], tags: int) -> tuple[Verdict, str]:
    """Whether only the infrastructure sends, and tags cost no frame."""
    counts = f"{alone['sent']} frames in {_SECONDS:g} s with one tag, {many['sent']} with {tags}"
    if alone["sent"] == many["sent"] and many["heard_by_tags"] == tags * alone["heard_by_tags"]:
        return Verdict.HOLDS, f"Only the {alone['senders']} anchors send; tags cost no air time ({counts})."
    return Verdict.FAILS, f"The load of the air depends on the tags ({counts})."


def section(plan: Plan, results: Results) -> Section:
    """The figure with its verdict."""
    alone, many = results["scenario/1"], results[f"scenario/{_MANY}"]
    verdict, reason = judge(alone, many, _MANY)
    return Section(
        key="scenario",
        title="The scenario: uplink and downlink",
        label="fig:Scenario",
        claim=(
            "With uplink TDoA the tag sends, so that more tags share the air; with the paper's downlink the "
            "anchors send and tags only listen."
        ),
        simulated=(
            "The lab of all figures: six anchors on the walls of 6 m × 8 m, the first one the master, slots of 2.5 "
            f"ms (the paper does not give its coordinates). Frames on the air are counted for {_SECONDS:g} s with "
            f"one tag and with {_MANY}."
        ),
        verdict=verdict,
        reason=reason,
        panels=(_uplink(), _downlink()),
        table=(
            ("tags", "frames sent", "senders", "frames heard by tags"),
            ("1", str(alone["sent"]), str(alone["senders"]), str(alone["heard_by_tags"])),
            (str(_MANY), str(many["sent"]), str(many["senders"]), str(many["heard_by_tags"])),
        ),
        numbers={"one_tag": alone, "many_tags": many, "tags": _MANY, "anchors_m": LAB_ANCHORS_M},
        command=f"skyless simulate --tags {_MANY} --duration {_SECONDS:g} --seed {plan.seed}",
    )


def _uplink() -> Panel:
    figure, axes = panel("Uplink: the tag sends", 4.4)
    tag = _TAGS_M[0]
    for anchor in LAB_ANCHORS_M:
        _arrow(axes, tag, (anchor[0], anchor[1]), ORANGE)
    _finish(axes)
    caption = "Uplink TDoA: one tag sends, all anchors stamp; each further tag needs a turn of its own."
    return Panel("01-uplink", caption, figure)


def _downlink() -> Panel:
    figure, axes = panel("Downlink: the anchors send", 4.4)
    for anchor in LAB_ANCHORS_M:
        for tag in _TAGS_M:
            _arrow(axes, (anchor[0], anchor[1]), tag, BLUE)
    _finish(axes)
    for name, position_m in (("P1", P1), ("P2", P2)):
        axes.plot(*position_m, "+", color=GREEN, markersize=10, markeredgewidth=1.6, zorder=6)
        axes.annotate(name, position_m, (6, -10), textcoords="offset points", fontsize=8.5, color=GREEN)
    caption = "Downlink TDoA: anchors take turns (1 is the master), tags only listen. P1, P2: the static positions."
    return Panel("01-downlink", caption, figure)


def _finish(axes: Axes) -> None:
    draw_floor_plan(axes, [(x, y) for x, y in LAB_ANCHORS_M.tolist()])
    axes.plot(*np.array(_TAGS_M).T, "o", color=RED, markersize=7, zorder=6)
    backed = {"facecolor": PAPER, "edgecolor": "none", "pad": 1.0, "alpha": 0.85}
    axes.annotate("tags", _TAGS_M[1], (8, 8), textcoords="offset points", fontsize=8.5, color=RED, bbox=backed)
    axes.set(xlim=(-0.5, 6.5), ylim=(-0.5, 8.5))


def _arrow(axes: Axes, start: tuple[float, float], end: tuple[float, float], colour: str) -> None:
    style = {"arrowstyle": "-|>", "color": colour, "alpha": 0.55, "linewidth": 0.9, "shrinkA": 6, "shrinkB": 6}
    axes.annotate("", end, start, arrowprops=style)
