"""Hours of simulated time: wraps of all counters, and no jump in any of them.

Half an hour by default, ``SKYLESS_LONG=1`` for a whole day.
"""

import math
import os

import pytest
from msgspec.structs import replace

from skyless.core.any_receiver import AnyReceiver
from skyless.core.protocol1.anchor import Anchor
from skyless.core.ticks import WRAP_TICKS
from skyless.sim.evaluation.fleet import Fleet, FleetSettings
from skyless.sim.evaluation.scenarios import Request, impairments_of
from skyless.sim.oscillator import OscillatorModel
from skyless.sim.trajectory import Static
from support.bench import LAB

pytestmark = pytest.mark.statistical

HOURS = 24.0 if os.environ.get("SKYLESS_LONG") == "1" else 0.5
SLOW = replace(
    LAB, schedule=replace(LAB.schedule, slot_s=60e-3), noise=replace(LAB.noise, white_fm=1e-11, random_walk_fm=1e-10)
)
"""Six slots of 60 ms, with better crystals: between two messages of an anchor lie 0.36 s."""


def normalised_squared(error_m, covariance_m2):
    """The squared error of x and y in units of its covariance."""
    (x, y), ((a, b), (_, d)) = error_m[:2].tolist(), covariance_m2[:2, :2].tolist()
    return (d * x * x - 2.0 * b * x * y + a * y * y) / (a * d - b * b)


def test_no_jump_in_hours():
    """Innovations beyond 4 sigma are gated; an error of 6.5 of the fixes' own sigmas has a chance below 1e-8 each.

    A wrap of any counter that was taken wrongly would be 5 million kilometres, a lost tick 4.7 mm for ever.
    """
    impairments = replace(
        impairments_of(Request(SLOW), SLOW), oscillator=OscillatorModel(white_fm=1e-11, random_walk_fm=1e-10)
    )
    fleet = Fleet(SLOW, [Static(3.0, 4.0)], impairments, 1, FleetSettings(new_receiver=lambda: AnyReceiver(qa=1e-3)))
    restarts, largest_sigmas, squares, fixes, last_s = 0, 0.0, 0.0, 0, -1.0
    for judged in fleet.run(HOURS * 3600.0):
        if judged.time_s < 10.0:
            continue
        fix = judged.fix
        error_m = math.hypot(judged.error_m[0], judged.error_m[1])
        normalised = normalised_squared(judged.error_m, fix.covariance_m2)
        largest_sigmas = max(largest_sigmas, normalised**0.5)
        assert largest_sigmas < 6.5, f"{error_m:.3f} m at {judged.time_s:.1f} s"
        squares += normalised
        fixes += 1
        assert fix.time_s > last_s
        last_s = fix.time_s
    for machine in filter(None, fleet.world._machines):
        assert isinstance(machine, Anchor)
        restarts += machine.counters["clock-restart"]
    wraps = [clock.local_ticks // WRAP_TICKS for clock in fleet.world.medium.clocks]
    assert min(wraps) >= int(HOURS * 3600.0 / 17.21) - 1
    assert restarts == 0
    assert fleet.receivers[0].counters["anchor-restart"] == 0
    assert sum(fleet.drops.values()) < 1e-3 * fixes + 5
    assert fixes > 0.99 * HOURS * 3600.0 / 60e-3 - 200
    assert 0.7 < squares / fixes / 2 < 1.3
