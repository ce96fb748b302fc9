"""Cold start of ``joint``: where the tag is, from raw stamps alone.

Wherever anchor i tells when it heard a packet of anchor j that the tag heard as well, the difference of their clocks
at that moment is known but for noise. Along such links all clocks lead to that of one anchor, which serves as the
master does in ``acquisition.py``; the rest is the same.
"""

from collections import deque
from typing import Final

import msgspec
import numpy as np
from msgspec import Struct

from skyless.constants import TICK_M, TICK_S
from skyless.positioning.acquisition import PATIENCE_S, Acquisition, Start
from skyless.positioning.fix import NoFixReason
from skyless.positioning.observation import Observation

MAX_LINK_AGE_S: Final = 1.0
"""Older links are forgotten."""


class _Link(Struct, frozen=True):
    """Reading of one anchor's clock less that of another's, when the tag's read ``rx_ticks_tag``."""

    rx_ticks_tag: int
    ticks: int
    fraction_ticks: float


class _Scale(Struct, frozen=True):
    """How an anchor's TX times become those of the reference: the sum of links on the way to it."""

    ticks: int
    fraction_ticks: float
    rates_at: tuple[tuple[float, int], ...]
    """What each link lacks: a rate, and since which reading of the tag."""
    links: int


class JointStart(Acquisition):
    """Gathers packets until a start is possible."""

    def __init__(
        self,
        height_m: float | None,
        stamp_variance_m2: float,
        z_bounds_m: tuple[float, float] | None,
        max_age_s: float,
        speed_std_mps: float,
    ) -> None:
        super().__init__(height_m, stamp_variance_m2, z_bounds_m, max_age_s, speed_std_mps)
        self._links: dict[tuple[int, int], _Link] = {}
        self._contradicted_ticks: int | None = None
        """When packets first contradicted each other."""

    def packets(self) -> list[Observation]:
        """The last two packets of each anchor, in the order of their receptions."""
        kept = [observation for pair in self._heard.values() for observation in pair]
        return sorted(kept, key=lambda observation: observation.rx_ticks_tag)

    def _solve_without_one(self, pairs: list[list[Observation]], now: int) -> Start | NoFixReason:
        """Where no single anchor contradicts all others, for half a second, start from all of them as they are."""
        result = super()._solve_without_one(pairs, now)
        if self._contradicted_ticks is None:
            self._contradicted_ticks = now
        if isinstance(result, Start) or (now - self._contradicted_ticks) * TICK_S < PATIENCE_S:
            return result
        result = self._solve(pairs, now, residual_tail=0.0)
        return msgspec.structs.replace(result, is_contradicted=True) if isinstance(result, Start) else result

    def learn(self, observation: Observation) -> None:
        """Keep what an anchor relays; to be called before ``hear``."""
        for anchor, sequence, rx_ticks in observation.all_relays():
            for packet in self._heard.get(anchor, ()):
                if packet.sequence == sequence:
                    range_ticks = float(np.linalg.norm(observation.anchor_m - packet.anchor_m)) / TICK_M
                    link = _Link(packet.rx_ticks_tag, rx_ticks - packet.tx_ticks_anchor, -range_ticks)
                    self._links[observation.anchor, anchor] = link

    def _on_one_scale(self, pairs: list[list[Observation]]) -> list[list[Observation]]:
        """The packets on the scale of the anchor that reaches most others, or on the master's if that is more."""
        with_master = [pair for pair in pairs if all(packet.tx_ticks_master is not None for packet in pair)]
        if not pairs:
            return with_master
        now = pairs[-1][-1].rx_ticks_tag
        self._links = {
            ends: link
            for ends, link in self._links.items()
            if (now - link.rx_ticks_tag) * TICK_S < max(MAX_LINK_AGE_S, self._max_age_s)
        }
        by_anchor = {pair[0].anchor: pair for pair in pairs}
        rates = {anchor: _rate(*pair) for anchor, pair in by_anchor.items()}
        best: dict[int, _Scale] = {}
        for reference in rates:
            if reference not in best:  # it would reach the same anchors as before
                reached = self._reach(reference, rates)
                if len(reached) > len(best):
                    best = reached
        if len(best) < len(with_master):
            return with_master
        return [
            [self._convert(packet, best[anchor]) for packet in by_anchor[anchor]] for anchor in rates if anchor in best
        ]

    def _reach(self, reference: int, rates: dict[int, float]) -> dict[int, _Scale]:
        """The scale of every anchor to which links lead, by as few of them as can be."""
        reached = {reference: _Scale(0, 0.0, (), 0)}
        queue = deque([reference])
        while queue:
            known = queue.popleft()
            for (listener, sender), link in self._links.items():
                if known not in (listener, sender):
                    continue
                other, sign = (sender, 1) if known == listener else (listener, -1)
                if other in reached or other not in rates:
                    continue
                scale = reached[known]
                reached[other] = _Scale(
                    scale.ticks + sign * link.ticks,
                    scale.fraction_ticks + sign * link.fraction_ticks,
                    (*scale.rates_at, (rates[known] - rates[other], link.rx_ticks_tag)),
                    scale.links + 1,
                )
                queue.append(other)
        return reached

    def _convert(self, packet: Observation, scale: _Scale) -> Observation:
        fraction = scale.fraction_ticks
        variance = 2.0 * scale.links * self._variance_m2
        for rate, rx_ticks in scale.rates_at:
            fraction += rate * (packet.rx_ticks_tag - rx_ticks)
        whole = int(np.floor(fraction))
        return msgspec.structs.replace(
            packet,
            tx_ticks_master=packet.tx_ticks_anchor + scale.ticks + whole,
            tx_fraction_ticks=fraction - whole,
            tx_variance_m2=variance,
        )


def _rate(first: Observation, second: Observation) -> float:
    """How much faster an anchor's clock runs than the tag's, as a fraction."""
    elapsed = second.rx_ticks_tag - first.rx_ticks_tag
    return (second.tx_ticks_anchor - first.tx_ticks_anchor - elapsed) / elapsed if elapsed > 0 else 0.0
