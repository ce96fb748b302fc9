"""The watch of the lab's anchors through simulated air: real machines' stamps, ranges in windows of 0.1 s, moves."""

from typing import Final

import numpy as np
from msgspec import Struct

from skyless.anchors.factory import new_anchor
from skyless.evaluation.anchor_stamps import RecordedAnchor
from skyless.evaluation.watch.drawn import WatchResult
from skyless.simulation.impairments import AnchorDisplacement, Impairments
from skyless.simulation.world import World
from skyless.site.lab import lab_site
from skyless.survey.stamps.pair_ranger import PairRanger
from skyless.survey.watch.finding import Finding
from skyless.survey.watch.monitor import FAST_SETTINGS, AnchorWatch

_LEARNING_S: Final = 11.5
_LASTS_S: Final = 1.0
_PERIOD_S: Final = 2.0
_FOUND_WITHIN_S: Final = 0.15
_STEP_S: Final = FAST_SETTINGS.window_s / FAST_SETTINGS.steps


class AirRun(Struct, frozen=True):
    """Anchors of the lab that are moved one after another, and back again a second later."""

    size_m: float
    events: int
    seed: int


class _Move(Struct, frozen=True):
    anchor: int
    from_s: float
    to_s: float


def run_air_watch(run: AirRun) -> WatchResult:
    """Run the site with its moves, and count what the watch finds within 0.15 s of each."""
    draw = np.random.default_rng(run.seed)
    site = lab_site()
    moves, displacements = _moves(run, [anchor.id for anchor in site.anchors], draw)
    watch = AnchorWatch({one.id: (one.x_m, one.y_m, one.z_m) for one in site.anchors}, 2, None, FAST_SETTINGS)
    ranger = PairRanger(block_s=_STEP_S, on_block=watch.add)
    seen: list[tuple[float, tuple[Finding, ...]]] = []
    watched_s = [0.0]

    def on_leg(sender: int, receiver: int, tx_ticks: int, rx_ticks: int, t_s: float) -> None:
        ranger.add(sender, receiver, tx_ticks, rx_ticks, t_s)
        if t_s >= watched_s[-1] + _STEP_S:
            watch.advance(t_s)
            watched_s.append(t_s - t_s % _STEP_S)
            if not seen or seen[-1][1] != watch.findings:
                seen.append((t_s, watch.findings))

    impairments = Impairments(anchor_displacements=displacements)
    world = World(
        site, lambda anchor: RecordedAnchor(new_anchor(site, anchor), site.id, on_leg), (), impairments, run.seed
    )
    until_s = _LEARNING_S + run.events * _PERIOD_S
    for _ in world.run(until_s):
        pass
    return _judged(moves, seen, until_s)


def _moves(
    run: AirRun, anchors: list[int], draw: np.random.Generator
) -> tuple[list[_Move], tuple[AnchorDisplacement, ...]]:
    moves, displacements = [], []
    for number in range(run.events):
        anchor, angle = int(draw.choice(anchors)), float(draw.uniform(0.0, 2.0 * np.pi))
        from_s = _LEARNING_S + number * _PERIOD_S + float(draw.uniform(0.0, 0.5))
        x_m, y_m = run.size_m * float(np.cos(angle)), run.size_m * float(np.sin(angle))
        displacements.append(AnchorDisplacement(anchor, x_m, y_m, from_s=from_s))
        displacements.append(AnchorDisplacement(anchor, from_s=from_s + _LASTS_S))
        moves.append(_Move(anchor, from_s, from_s + _LASTS_S))
    return moves, tuple(displacements)


def _judged(moves: list[_Move], seen: list[tuple[float, tuple[Finding, ...]]], until_s: float) -> WatchResult:
    found_s: list[float] = []
    named = kind = wrong = ended = alarms = alarms_moved = 0
    for number, move in enumerate(moves):
        before = _state(seen, move.from_s)
        alarms += len(before)
        alarms_moved += sum(one.kind in {"moved", "delay"} for one in before)
        first_s = next((t_s for t_s, findings in seen if t_s > move.from_s and findings), np.inf)
        if first_s < move.to_s:
            found_s.append(first_s - move.from_s)
        then = _state(seen, move.from_s + _FOUND_WITHIN_S)
        named += bool(then) and all(one.anchors == (move.anchor,) for one in then)
        kind += bool(then) and all((one.kind, one.anchors) == ("moved", (move.anchor,)) for one in then)
        wrong += any(one.kind in {"moved", "delay"} and one.anchors != (move.anchor,) for one in then)
        end_s = moves[number + 1].from_s if number + 1 < len(moves) else until_s
        ended += not _state(seen, end_s)
    windows = round(until_s / _STEP_S)
    return WatchResult(
        len(moves), len(found_s), named, kind, wrong, ended, tuple(found_s), alarms, alarms_moved, windows
    )


def _state(seen: list[tuple[float, tuple[Finding, ...]]], t_s: float) -> tuple[Finding, ...]:
    """Findings that stood at a time."""
    return next((findings for since_s, findings in reversed(seen) if since_s <= t_s), ())
