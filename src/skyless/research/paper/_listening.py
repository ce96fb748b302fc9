"""Tags in the lab's world that compute with several methods from the same receptions."""

from collections.abc import Sequence
from typing import Final

import numpy as np
from msgspec import Struct

from skyless.core.arrays import Array
from skyless.core.fix import Fix
from skyless.core.protocol1.receiver import Receiver
from skyless.core.protocol1.schedule import schedule_of
from skyless.core.site import Site
from skyless.sim.evaluation.fleet import world_of
from skyless.sim.evaluation.statistics import FirstFixes
from skyless.sim.impairments import Impairments
from skyless.sim.trajectory import Trajectory

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
        self.rows: list[tuple[float, ...]] = []

    def add(self, time_s: float, fix: Fix, truth_m: Array) -> None:
        if self._first_fixes.is_first(0, time_s):
            self.rows.append((time_s, *fix.position_m[:2].tolist(), *truth_m[:2].tolist()))

    def track(self, most: int | None) -> Track:
        rows = np.array(self.rows[:most]).reshape(-1, 5)
        return Track(rows[:, 0], rows[:, 1:3], rows[:, 3:5])


def listen(
    site: Site,
    trajectories: Sequence[Trajectory],
    methods: Sequence[str],
    impairments: Impairments,
    seed: int,
    *,
    fixes: int | None = None,
    until_s: float | None = None,
) -> list[dict[str, Track]]:
    """Run a world until every method of every tag has ``fixes`` fixes, or until ``until_s``.

    Returns for each tag its track by each method. A world gives its first tag the same stamps with and without
    other tags, so ``skyless simulate`` with the same seed reproduces the first tag's figures.
    """
    world = world_of(site, trajectories, impairments, seed)
    superframe_s = 1.0 / schedule_of(site).superframe_rate_hz
    listeners = [[(Receiver(method), _Log(site)) for method in methods] for _ in trajectories]
    end_s = until_s if until_s is not None else _WARMUP_S + 1.02 * (fixes or 0) * superframe_s + 1.0
    now_s = 0.0
    while now_s < end_s and (fixes is None or any(len(log.rows) < fixes for pairs in listeners for _, log in pairs)):
        now_s = min(now_s + 0.5, end_s)
        for broadcast in world.run(now_s):
            for tag, reception, truth_m in broadcast.receptions():
                for receiver, log in listeners[tag]:
                    fix = receiver.hear(reception)
                    if fix is not None and broadcast.end_s >= _WARMUP_S:
                        log.add(broadcast.end_s, fix, truth_m)
    return [{method: log.track(fixes) for method, (_, log) in zip(methods, pairs, strict=True)} for pairs in listeners]
