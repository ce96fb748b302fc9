"""Which anchors a filter's position rests on at the moment."""

from typing import Final

import numpy as np
from msgspec import Struct

from skyless.constants import TICK_S
from skyless.kernels.arrays import Array
from skyless.positioning.observation import Observation

IN_USE_S: Final = 0.1
"""An anchor counts as in use while its last accepted message is younger, or a superframe and a half."""


class AnchorsInUseState(Struct, frozen=True):
    """What an ``AnchorsInUse`` remembers."""

    used: tuple[Observation, ...]
    checked_ticks: int
    anchors_m: tuple[tuple[float, float, float], ...]
    extent_m: float


class AnchorsInUse:
    """The anchors whose messages were accepted of late; their list is made anew only when it changes."""

    def __init__(self, superframe_s: float) -> None:
        self._in_use_s = max(IN_USE_S, 1.5 * superframe_s)
        self._used: dict[int, Observation] = {}
        self._checked_ticks = 0
        self.anchors: tuple[int, ...] = ()
        self.anchors_m: Array = np.empty((0, 3))
        """Their positions, shape (len(anchors), 3)."""
        self.extent_m = 0.0
        """The largest span in x, y or z that anchors in use have had since the start."""

    def state(self) -> AnchorsInUseState:
        """What it remembers."""
        anchors_m = tuple((x, y, z) for x, y, z in self.anchors_m.tolist())
        return AnchorsInUseState(tuple(self._used.values()), self._checked_ticks, anchors_m, self.extent_m)

    def restore(self, state: AnchorsInUseState) -> None:
        """Continue from a state."""
        self._used = {observation.anchor: observation for observation in state.used}
        self._checked_ticks, self.extent_m = state.checked_ticks, state.extent_m
        self.anchors, self.anchors_m = tuple(self._used), np.array(state.anchors_m).reshape(len(self._used), 3)

    def begin(self, observations: tuple[Observation, ...]) -> None:
        """Forget all anchors but those of these observations."""
        self._used.clear()
        self.extent_m = 0.0
        for observation in observations:
            self.use(observation)

    def use(self, observation: Observation) -> None:
        """Take an accepted message."""
        now = observation.rx_ticks_tag
        changed = observation.anchor not in self._used
        self._used[observation.anchor] = observation
        if (now - self._checked_ticks) * TICK_S > self._in_use_s:
            self._checked_ticks = now
            stale = [a for a, o in self._used.items() if (now - o.rx_ticks_tag) * TICK_S > self._in_use_s]
            changed = changed or bool(stale)
            for anchor in stale:
                del self._used[anchor]
        if changed:
            self.anchors = tuple(self._used)
            self.anchors_m = np.array([o.anchor_m for o in self._used.values()])
            self.extent_m = max(self.extent_m, float(np.ptp(self.anchors_m, axis=0).max()))

    def mean_range_m(self, position_m: Array) -> float:
        """From a position, shape (2,) or (3,), to the anchors."""
        away = self.anchors_m[:, : len(position_m)] - position_m
        return float(np.linalg.norm(away, axis=1).mean())
