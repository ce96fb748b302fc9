"""Signs of carrier phases: what a receiver measures goes with its own clock and against the sender's.

One function closes two loops of phases, over simulated chips behind the driver and over a recording of real ones:

    φ(o₁) − φ(o₂) of the same packets      =  constant − (clock of o₁ less clock of o₂) · f
    φ(i at j) + φ(j at i), one then other  =  constant + (rate of j less rate of i) · time from one to the other · f

Clocks and rates are those of the stamps, smoothed over windows, because a stamp's noise is half a wavelength.
"""

from collections import Counter
from collections.abc import Iterable, Iterator
from itertools import combinations

import numpy as np
import pytest
from chip_stage import ChipAnchor
from msgspec.structs import replace

from skyless.core.air.masterless_packets import Packet
from skyless.core.protocol1.anchor import Anchor
from skyless.core.protocol1.beacon import decode
from skyless.core.ticks import CARRIER_CYCLES, TICK_M, TICK_RATE_HZ
from skyless.research.foreign import datasets as muloc
from skyless.sim.evaluation.scenarios import Request, impairments_of
from skyless.sim.impairments import PERIOD_TICKS
from skyless.sim.lab import paper_lab_site
from skyless.sim.listening import TagSpec
from skyless.sim.oscillator import OscillatorModel
from skyless.sim.trajectory import Static
from skyless.sim.world import World

WINDOW_TICKS = round(0.5 * TICK_RATE_HZ)
"""A parabola over twice this follows the clocks of DW1000s."""
FEWEST = 20
"""Packets for a parabola."""
LONGEST_TICKS = round(20e-3 * TICK_RATE_HZ)
"""Receptions that are further apart are not compared: clocks wander."""
STALE_TICKS = 1e-5 * TICK_RATE_HZ
"""By so much clocks do not leave a straight line within a minute; packets are 60 times as far from each other."""
BOUND_M = 1.5e-3

Heard = tuple[int, int, int, int, int, float]
"""Sender, its packet's number, TX stamp, receiver, RX stamp, phase in cycles."""


# Closures


def closures_m(heard: Iterable[Heard], cycles: int, sign: int = 1) -> tuple[float, float]:
    """How far both loops are open for each reception, robust standard deviations over all pairs of nodes.

    ``cycles``: of the carrier in 128 ticks; ``sign`` −1 takes all phases the other way round.
    """
    links: dict[tuple[int, int], list] = {}
    for sender, number, tx_ticks, receiver, rx_ticks, phase in heard:
        links.setdefault((sender, receiver), []).append((number, tx_ticks, rx_ticks, sign * phase))
    columns = {link: plausible([np.array(column) for column in zip(*links[link], strict=True)]) for link in links}
    pairs = list(combinations(sorted(columns), 2))
    differences = [differences_of(columns[a], columns[b], cycles) for a, b in pairs if a[0] == b[0]]
    sums = [sums_of(columns[a], columns[b], cycles) for a, b in pairs if a == b[::-1]]
    wavelength_m = PERIOD_TICKS * TICK_M / cycles
    return deviation(differences) * wavelength_m / 2.0, deviation(sums) * wavelength_m / np.sqrt(2.0)


def differences_of(one, other, cycles):
    """What two receivers' difference changes by from packet to packet, besides their clocks: of four phases."""
    _, at, but_at = np.intersect1d(one[0], other[0], return_indices=True)
    phase, clock_ticks = one[3][at] - other[3][but_at], since(one[2][at] - other[2][but_at])
    t_ticks = since(other[2][but_at])
    steps = np.diff(phase) + np.diff(smoothed(t_ticks, clock_ticks)[0]) * cycles / PERIOD_TICKS
    return wrapped(steps[np.diff(t_ticks) < LONGEST_TICKS])


def sums_of(there, back, cycles):
    """Of each packet there with the one back after it and the one before, less their mean: of two phases."""
    t_ticks, back_ticks = since(there[1]), since(back[2], first=there[1][0])
    rates = smoothed(t_ticks, since(there[2] - there[1]))[1]
    following = np.searchsorted(back_ticks, t_ticks)
    sums = []
    for partner in (following - 1, following):
        to = partner.clip(0, len(back_ticks) - 1)
        between_ticks = back_ticks[to] - t_ticks
        turns = there[3] + back[3][to] - rates * between_ticks * cycles / PERIOD_TICKS
        sums.append(turns[(np.abs(between_ticks) < LONGEST_TICKS) & np.isfinite(turns)])
    turns = np.concatenate(sums)
    return wrapped(turns - np.angle(np.mean(np.exp(2j * np.pi * turns))) / (2.0 * np.pi))


def plausible(link):
    """Without packets that have a stamp of another one, as registers hold that were read late."""
    t_ticks, clock_ticks = since(link[1]), since(link[2] - link[1])
    off_ticks = clock_ticks - np.median(np.diff(clock_ticks) / np.diff(t_ticks).clip(1)) * t_ticks
    near = np.abs(off_ticks - np.median(off_ticks)) < STALE_TICKS
    return [column[near] for column in link]


def smoothed(t_ticks, ticks):
    """Values and slopes of a parabola for each window, not numbers where there are few packets."""
    values, slopes = np.full(len(ticks), np.nan), np.full(len(ticks), np.nan)
    for begin in range(0, int(t_ticks[-1]) + 1, WINDOW_TICKS):
        inside = np.flatnonzero((t_ticks >= begin) & (t_ticks < begin + WINDOW_TICKS))
        wide = np.flatnonzero(np.abs(t_ticks - begin - WINDOW_TICKS / 2) < WINDOW_TICKS)
        if len(inside) < FEWEST:
            continue
        for _ in range(3):  # stamps that are far off are left out
            fit = np.polynomial.Polynomial.fit(t_ticks[wide], ticks[wide], 2)
            off_ticks = np.abs(fit(t_ticks[wide]) - ticks[wide])
            wide = wide[off_ticks <= 6.0 * np.median(off_ticks)]
        values[inside], slopes[inside] = fit(t_ticks[inside]), fit.deriv()(t_ticks[inside])
    return values, slopes


def since(ticks, first=None):
    """Ticks since the first, without wraps."""
    steps = np.diff(ticks, prepend=ticks[0] if first is None else first)
    return np.cumsum((steps + (1 << 39)) % (1 << 40) - (1 << 39))


def wrapped(turns):
    return (turns + 0.5) % 1.0 - 0.5


def deviation(parts):
    """Robust standard deviation about zero."""
    turns = np.concatenate(parts)
    turns = turns[np.isfinite(turns)]
    assert len(turns) > 5000
    return float(1.4826 * np.median(np.abs(turns)))


def check_signs(heard: Iterable[Heard], cycles: int) -> None:
    """Both are open by 0.6 to 0.7 mm simulated, 0.8 to 1.1 mm recorded; with the wrong sign by over 3 mm."""
    heard = list(heard)
    assert max(closures_m(heard, cycles)) < BOUND_M
    assert min(closures_m(heard, cycles, sign=-1)) > 2.0 * BOUND_M


# What chips have measured


@pytest.mark.site
def test_phases_of_simulated_chips_close():
    """Crystals are as quiet as a TCXO, up to 20 ppm apart; the usual ones wander by millimetres within a superframe."""
    lab = paper_lab_site()
    quiet = OscillatorModel(random_walk_fm=1e-10)
    faults = replace(impairments_of(Request(lab, carrier=True), lab), diagnostics=True, oscillator=quiet)
    heard: list[Heard] = []

    class Noting(Anchor):
        """An anchor that keeps what its driver gives it."""

        def hear(self, reception):
            beacon = decode(reception.frame)
            sent, phase = (beacon.anchor, beacon.superframe, beacon.tx_ticks), reception.carrier_phase_cycles
            heard.append((*sent, self.id, reception.rx_ticks, phase))
            super().hear(reception)

    def on_chip(number):
        return ChipAnchor(Noting(lab, number), world.medium)

    world = World(lab, on_chip, [TagSpec(Static(2.0, 3.0, 0.0))], faults, 5)
    for _ in world.run(6.0):
        pass
    check_signs(heard, CARRIER_CYCLES[5])


@pytest.mark.site
@pytest.mark.parametrize("channel", [1, 3])
def test_phases_of_recorded_chips_close(recordings, channel):
    path = recordings / "muloc" / "location1_2.npz"
    if not path.is_file():
        pytest.skip(f"no recording at {path}")
    with path.open("rb") as stream:
        check_signs(relayed(muloc.read_muloc(stream, Counter(), channel)), CARRIER_CYCLES[channel])


def relayed(packets: Iterable[Packet]) -> Iterator[Heard]:
    """What anchors heard of each other."""
    tx_ticks: dict[tuple[int, int], int] = {}
    for packet in packets:
        tx_ticks[packet.anchor, packet.sequence] = packet.tx_ticks
        for one in packet.relays:
            if (one.anchor, one.sequence) in tx_ticks:
                sent_ticks = tx_ticks[one.anchor, one.sequence]
                yield one.anchor, one.sequence, sent_ticks, packet.anchor, one.rx_ticks, one.carrier_phase_cycles
