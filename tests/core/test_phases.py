"""Phases of the carrier: what they must not depend on, what they must not harm, and what they buy."""

from functools import partial

import numpy as np
import pytest
from msgspec.structs import replace

from skyless.core.any_receiver import AnyReceiver
from skyless.research.studies.runner import Plan
from skyless.research.studies.worlds import Heard, Run, beacons_of, box, run_world, worlds
from skyless.sim.evaluation.scenarios import Request, Room, impairments_of, trajectories_of, wanderer
from skyless.sim.impairments import Body, CarrierModel, RangeErrorModel
from skyless.sim.lab import lab_site

SITE = lab_site()
USUAL = CarrierModel()


def heard(seed, seconds=4.0, tags=1, carrier=USUAL):
    """What tags of a room receive."""
    request = Request(SITE, seed=seed, tags=tags, room=Room())
    impairments = replace(impairments_of(request, SITE), carrier=carrier)
    paths = tuple(trajectories_of(request))
    return list(beacons_of(Run(SITE, paths, impairments, seed, "joint", 0.0, seconds)))


@pytest.fixture(scope="module")
def beacons():
    return heard(3)


def with_phases(beacons: list[Heard], change):
    """The receptions of the first tag, with other phases."""
    return [
        (replace(reception, carrier_phase_cycles=change(beacon, reception)), truth_m)
        for beacon in beacons
        for tag, reception, truth_m in beacon.receptions
        if tag == 0
    ]


def fixes_of(receptions, receiver=None):
    """Positions after each reception, NaN without a fix, and the state at the end."""
    receiver = receiver or AnyReceiver()
    fixes = [receiver.hear(reception) for reception, _ in receptions]
    positions = [np.full(2, np.nan) if fix is None else fix.position_m[:2] for fix in fixes]
    return np.array(positions), receiver.receiver.method.estimator.state


def test_constants_of_the_radios_do_not_matter(beacons):
    """Any constant may be in the phases of an anchor: a fraction of a cycle that is not known."""
    as_they_are, state = fixes_of(with_phases(beacons, lambda _, one: one.carrier_phase_cycles))
    shifts = np.random.default_rng(1).random(256)
    shifted, _ = fixes_of(
        with_phases(beacons, lambda _, one: float((one.carrier_phase_cycles + shifts[one.frame[9]]) % 1.0))
    )
    assert state.status.phases_used > 300
    assert np.nanmax(np.abs(shifted - as_they_are)) < 1e-6


def test_noise_instead_of_phases_does_no_harm(beacons):
    """Phases that have nothing to do with the receptions are opened and refused, and stamps decide."""
    draw = np.random.default_rng(2)
    truths = [truth_m for _, truth_m in with_phases(beacons, lambda _, one: None)]
    stamps, _ = fixes_of(with_phases(beacons, lambda _, one: None))
    noise, state = fixes_of(with_phases(beacons, lambda _, one: float(draw.random())))
    truth = np.array(truths)[:, :2]
    rmse_m = [np.sqrt(np.nanmean(np.sum((found - truth) ** 2, axis=1))) for found in (stamps, noise)]
    assert state.status.phases_opened > 5 * state.status.phases_used
    assert rmse_m[1] < 1.3 * rmse_m[0]


def test_a_reset_of_a_radio_is_found(beacons):
    """All phases of an anchor change at once: its ambiguity begins again, and the fixes hardly move."""
    half = len(beacons) // 2
    numbers = {id(beacon): number for number, beacon in enumerate(beacons)}

    def reset(beacon, one):
        late = numbers[id(beacon)] >= half and one.frame[9] == beacons[half].receptions[0][1].frame[9]
        return float((one.carrier_phase_cycles + 0.5 * late) % 1.0)

    as_they_are, before = fixes_of(with_phases(beacons, lambda _, one: one.carrier_phase_cycles))
    after, state = fixes_of(with_phases(beacons, reset))
    assert state.status.phases_opened > before.status.phases_opened
    assert np.nanmax(np.abs(after - as_they_are)) < 0.03


@pytest.mark.statistical
@pytest.mark.parametrize(
    ("carrier", "most"),
    [
        (CarrierModel(), 0.9),
        (CarrierModel(slips=0.01), 1.05),
        (CarrierModel(wild=0.1), 1.05),
        (CarrierModel(reflections=RangeErrorModel(changing_m=0.008, correlation_m=0.05)), 1.05),
    ],
)
def test_the_room_with_phases_against_the_room_by_stamps(carrier, most):
    """Squared errors of the same tags, whose stamps are the same: fewer with phases, never more."""
    squares = np.zeros(2)
    for seed in range(1, 7):
        beacons = heard(100 + seed, 12.0, carrier=carrier)
        for place, change in enumerate((lambda _, one: None, lambda _, one: one.carrier_phase_cycles)):
            receptions = with_phases(beacons, change)
            found, _ = fixes_of(receptions)
            errors = np.sum((found - np.array([truth_m[:2] for _, truth_m in receptions])) ** 2, axis=1)
            squares[place] += np.nanmean(errors[len(errors) // 5 :])
    assert np.sqrt(squares[1] / squares[0]) < most


@pytest.mark.statistical
@pytest.mark.parametrize(
    ("rate_hz", "random_walk_fm", "carrier", "body", "most"),
    [
        (67.0, 5e-9, USUAL, None, 0.7),
        (10.0, 5e-9, USUAL, None, 1.05),
        (67.0, 5e-9, CarrierModel(wild=0.1), None, 1.05),
        (67.0, 5e-9, CarrierModel(slips=0.01), None, 1.0),
        (67.0, 5e-9, USUAL, Body(), 1.15),
    ],
)
def test_hands_with_phases_against_hands_by_stamps(rate_hz, random_walk_fm, carrier, body, most):
    """The same receptions of tags in hands, plain crystals; levels are exceeded as often, but for 10⁻³ of the fixes."""
    noise, schedule = replace(SITE.noise, random_walk_fm=random_walk_fm), replace(SITE.schedule, rate_hz=rate_hz)
    site, (low_m, high_m) = replace(SITE, noise=noise, schedule=schedule), box(SITE)
    plan = Plan(worlds=4, seed=5, seconds=10.0, conditions="phase", tags=4)

    def paths(seed):
        return [wanderer(low_m, high_m, seed, tag, 3.0) for tag in range(plan.tags)]

    def tallies(of):
        change = partial(replace, carrier=of)
        runs = worlds(plan, site, paths, room=Room(), warmup_s=2.5, change=change, **({"body": body} if body else {}))
        return [run_world(run) for run in runs]

    stamps, phases = tallies(None), tallies(carrier)
    assert sum(one.squared_m2 for one in phases) < most**2 * sum(one.squared_m2 for one in stamps)
    exceeded = [sum(one.levels.exceeded.sum() for one in found) for found in (stamps, phases)]
    assert exceeded[1] <= exceeded[0] + 1e-3 * sum(one.fixes for one in phases)
