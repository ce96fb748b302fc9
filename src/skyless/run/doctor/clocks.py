"""How steady counters are, from stamps of the same frames by two of them: a check of the site's noise figures."""

import math
from typing import Final

from skyless.core.site import NoiseSite
from skyless.core.ticks import TICK_S, continued
from skyless.run.doctor.check import Check

_TIMES_S: Final = (0.5, 4.0)
_MIN_SAMPLES: Final = 30
_STEP_TICKS: Final = round(0.05 / TICK_S)
"""Stamps of a pair that follow sooner are not needed."""
_MAX_PAIRS: Final = 1000
_MAX_GAP_S: Final = 8.0  # half a turn of the counters
_TOO_NOISY: Final = 1.5
"""Measured over assumed. Pairs share counters, so that six anchors and 25 s give a ratio with a deviation of 0.15."""


class CounterPairs:
    """Stamps of frames by their sender's counter and by a receiver's, for each pair of them."""

    def __init__(self) -> None:
        self._pairs: dict[tuple[str, int], list[tuple[int, int]]] = {}
        self._added_s: dict[tuple[str, int], float] = {}

    def add(self, receiver: str, sender: int, tx_ticks: int, rx_ticks: int, now_s: float) -> None:
        """Add a frame, in order. After a restart of either counter, or a long gap, the pair begins again."""
        pair = receiver, sender
        if pair not in self._pairs and len(self._pairs) >= _MAX_PAIRS:
            return
        stamps = self._pairs.setdefault(pair, [])
        gap_s, self._added_s[pair] = now_s - self._added_s.get(pair, now_s), now_s
        if gap_s > _MAX_GAP_S:
            stamps.clear()
        if stamps:
            last_tx, last_rx = stamps[-1]
            elapsed = (rx_ticks - last_rx) % (1 << 40)
            if elapsed < _STEP_TICKS:
                return
            sent_ticks = continued(tx_ticks, last_tx, elapsed)
            if sent_ticks is None:
                stamps.clear()
            else:
                tx_ticks, rx_ticks = sent_ticks, last_rx + elapsed
        stamps.append((tx_ticks, rx_ticks))

    def deviation(self, tau_s: float) -> tuple[float, int]:
        """Allan deviation of the two counters of a pair against each other, of all pairs; and number of samples.

        From differences of mean frequencies over neighbouring times of at least ``tau_s``: σ² = ⟨(y₂ − y₁)²⟩ / 2.
        """
        total, count = 0.0, 0
        for stamps in self._pairs.values():
            start, before = stamps[0], None
            for stamp in stamps:
                elapsed = stamp[1] - start[1]
                if elapsed * TICK_S >= tau_s:
                    rate = (stamp[0] - start[0] - elapsed) / elapsed
                    if before is not None:
                        total, count = total + (rate - before) ** 2, count + 1
                    start, before = stamp, rate
        return (math.sqrt(total / (2.0 * count)) if count else math.nan), count


def assumed_deviation(noise: NoiseSite, tau_s: float) -> float:
    """The same of two counters as the site's filters assume them, stamps included: 2·(w²/τ + r²·τ/3) + 3·s²/τ²."""
    stamp2 = (noise.tx_stamp_ps**2 + noise.rx_stamp_ps**2) * 1e-24
    crystals = noise.white_fm**2 / tau_s + noise.random_walk_fm**2 * tau_s / 3.0
    return math.sqrt(2.0 * crystals + 3.0 * stamp2 / tau_s**2)


def counters_check(pairs: CounterPairs, noise: NoiseSite, name: str) -> Check:
    """Whether the counters are as steady as the filters assume, at a short and at a long time."""
    measured = [pairs.deviation(tau_s) for tau_s in _TIMES_S]
    samples = min(count for _, count in measured)
    if samples < _MIN_SAMPLES:
        finding = f"Too few stamps: {samples} samples of the {_MIN_SAMPLES} needed."
        return Check(name, "not checked", finding, "Listen for longer with --duration.")
    short, long_ = (one / assumed_deviation(noise, tau_s) for (one, _), tau_s in zip(measured, _TIMES_S, strict=True))
    finding = "Counters differ by {:.2f} of what the site's noise figures allow over {:g} s, and by {:.2f} over {:g} s."
    finding = finding.format(short, _TIMES_S[0], long_, _TIMES_S[1])
    if max(short, long_) <= _TOO_NOISY:
        return Check(name, "ok", finding)
    if long_ >= short:
        advice = f"Set random_walk_fm in [noise] of the site file to {noise.random_walk_fm * long_:.1g}"
    else:
        advice = f"Set tx_stamp_ps and rx_stamp_ps in [noise] of the site file {short:.1f} times as large"
    return Check(name, "warning", finding, f"{advice}, unless a board was moved or is warming up.")
