"""Tags in the lab's world that compute with several methods from the same receptions."""

from array import array
from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np
from msgspec import Struct

from skyless.core.arrays import Array
from skyless.core.fix import Fix
from skyless.core.protocol1.beacon import schedule_of
from skyless.core.protocol1.receiver import Receiver
from skyless.core.site import Site
from skyless.sim.evaluation.figures import FirstFixes
from skyless.sim.evaluation.fleet import world_of
from skyless.sim.impairments import Impairments
from skyless.sim.trajectory import Trajectory

_COLUMNS: Final = 5
_WARMUP_S: Final = 2.0
"""Fixes before this true time are not judged: the filters settle."""


class Track(Struct, frozen=True):
    """Fixes of one tag by one method, one per superframe, and the truth."""

    time_s: Array
    """Shape (n,): true time at which the fix was made."""
    position_m: Array
    """Shape (n, 2)."""
    truth_m: Array
    """Shape (n, 2): where the tag was at the emission of the last message."""

    @property
    def error_m(self) -> Array:
        """Position less truth, shape (n, 2)."""
        return self.position_m - self.truth_m


class _Log:
    """Keeps the first fix of every superframe."""

    def __init__(self, site: Site) -> None:
        self._first_fixes = FirstFixes(site, 1)
        self._numbers = array("d")

    def __len__(self) -> int:
        return len(self._numbers) // _COLUMNS

    def add(self, time_s: float, fix: Fix, truth_m: Array) -> None:
        if self._first_fixes.is_first(0, time_s):
            self._numbers.extend((time_s, *fix.position_m[:2].tolist(), *truth_m[:2].tolist()))

    def track(self) -> Track:
        rows = np.array(self._numbers).reshape(-1, _COLUMNS)
        return Track(rows[:, 0], rows[:, 1:3], rows[:, 3:5])


def listen(
    site: Site,
    tags: Sequence[tuple[Trajectory, Mapping[str, int]]],
    impairments: Impairments,
    seed: int,
    until_s: float | None = None,
) -> list[dict[str, Track]]:
    """Run a world until every method of every tag has its fixes, or until ``until_s``.

    ``tags``: how each moves, the methods with which it computes, and how many fixes each of them makes.

    Returns for each tag its track by each method. A world gives its first tag the same stamps with and without
    other tags, so ``skyless simulate`` with the same seed reproduces the first tag's figures.
    """
    world = world_of(site, [trajectory for trajectory, _ in tags], impairments, seed)
    superframe_s = 1.0 / schedule_of(site).superframe_rate_hz
    listeners = [[(Receiver(method), _Log(site), most) for method, most in methods.items()] for _, methods in tags]
    most_fixes = max(most for _, methods in tags for most in methods.values())
    end_s = until_s if until_s is not None else _WARMUP_S + 1.02 * most_fixes * superframe_s + 1.0
    now_s = 0.0
    while now_s < end_s and any(len(log) < most for own in listeners for _, log, most in own):
        now_s = min(now_s + 0.5, end_s)
        for broadcast in world.run(now_s):
            for tag, reception, truth_m in broadcast.receptions():
                for receiver, log, most in listeners[tag]:
                    fix = receiver.hear(reception) if len(log) < most else None
                    if fix is not None and broadcast.end_s >= _WARMUP_S:
                        log.add(broadcast.end_s, fix, truth_m)
    return [
        {method: log.track() for method, (_, log, _) in zip(methods, own, strict=True)}
        for (_, methods), own in zip(tags, listeners, strict=True)
    ]
