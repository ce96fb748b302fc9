"""A fleet run to its end: until a time, or until its tags have their fixes."""

import math
from collections.abc import Callable
from typing import Final

from skyless.evaluation.fleet import JudgedFix, TagFleet
from skyless.evaluation.scenarios import Request

USUAL_DURATION_S: Final = 60.0
"""Duration of a run without a goal."""

_LONGEST_WAIT_S: Final = 60.0
"""Simulated time for which a run whose goal is fixes waits for one."""


def end_s(duration_s: float | None, fixes: int | None) -> float:
    """When a run ends, unless it reaches its goal before; infinite where only the fixes end it."""
    return duration_s or (USUAL_DURATION_S if fixes is None else math.inf)


def run_fleet(
    fleet: TagFleet,
    request: Request,
    until_s: float,
    on_fix: Callable[[JudgedFix], None] | None,
    on_progress: Callable[[float], None],
) -> None:
    """Run the world in steps; ``on_fix`` gets every fix, ``on_progress`` now and then the share done."""
    fixes, now_s = request.most_fixes, 0.0
    while now_s < until_s and not _is_enough(fleet, request, now_s):
        now_s = min(now_s + fleet.step_s, until_s)
        for judged in fleet.run(now_s):
            if on_fix is not None:
                on_fix(judged)
        on_progress(now_s / until_s if fixes is None else fleet.errors.count / len(fleet.records) / fixes)


def _is_enough(fleet: TagFleet, request: Request, now_s: float) -> bool:
    """Whether all tags have their fixes, or those that have not wait too long, with nothing planned to come back."""
    fixes = request.most_fixes
    if fixes is None:
        return False
    returns_s = [planned.outage.on_s for planned in request.outages] + [silence.on_s for silence in request.silences]
    planned_s = max(filter(math.isfinite, returns_s), default=0.0)
    last_s = (0.0 if tag.last is None else tag.last.time_s for tag in fleet.records if tag.judged < fixes)
    return all(now_s - max(tag_s, planned_s) > _LONGEST_WAIT_S for tag_s in last_s)
